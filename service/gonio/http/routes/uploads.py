"""Uploads that can be gone on with after a cut: tus 1.0 (creation, termination, checksum, expiration)."""

import base64
import binascii
from collections.abc import AsyncGenerator
from email.utils import formatdate
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from gonio.errors import InputError
from gonio.http.dependencies import Id, TheService, TheSettings, Writer
from gonio.http.problems import GUARD, fails
from gonio.http.routes.files import ACCEPTING, UNLIMITED, check_fields
from gonio.http.uploads import body_of
from gonio.jobs.filenames import check_file_name
from gonio.jobs.partial import CHECKSUMS, Upload
from gonio.jobs.service import Service

TUS = "1.0.0"
LONGEST_HEADER = 4000
WRITE_BYTES = 1 << 20


def _speaks_tus(
    tus_resumable: Annotated[str, Header(description=f"The version of tus: {TUS}.")],
) -> None:
    if tus_resumable != TUS:
        raise InputError(
            f"This service speaks tus {TUS}.", hint=f"Send `Tus-Resumable: {TUS}`.", code="tus-version-unsupported"
        )


router = APIRouter(
    prefix="/v1",
    tags=["uploads"],
    dependencies=[Depends(_speaks_tus)],
    responses=fails(*GUARD, "tus-version-unsupported"),
)
discovery = APIRouter(prefix="/v1", tags=["uploads"])

_UPLOAD = {
    "Upload-Offset": {"description": "How many bytes are safely there.", "schema": {"type": "integer"}},
    "Upload-Expires": {"description": "When it is removed if nothing is added to it.", "schema": {"type": "string"}},
    "Content-Location": {"description": "The file that it became, when it is whole.", "schema": {"type": "string"}},
}


@discovery.options("/uploads", status_code=204, responses=fails())
def describe_uploads(response: Response, settings: TheSettings) -> None:
    """Tell what of tus this service speaks."""
    response.headers["Tus-Version"] = TUS
    response.headers["Tus-Extension"] = "creation,termination,checksum,expiration"
    response.headers["Tus-Checksum-Algorithm"] = ",".join(CHECKSUMS)
    response.headers["Tus-Max-Size"] = str(settings.max_upload_bytes)


@router.post(
    "/sessions/{session_id}/uploads",
    status_code=201,
    responses={
        201: {"headers": {"Location": {"schema": {"type": "string"}}, "Upload-Expires": _UPLOAD["Upload-Expires"]}},
        **fails(
            "not-found", "upload-header-wrong", "bad-file-name", "role-unknown", "role-wrong", "camera-missing",
            "file-too-large", "quota-exceeded", "disk-full", "body-too-large",
        ),
    },
)  # fmt: skip
def create_upload(
    session_id: Id,
    response: Response,
    service: TheService,
    caller: Writer,
    upload_length: Annotated[int, Header(ge=0, le=1 << 53, description="The size of the file in bytes.")],
    upload_metadata: Annotated[
        str,
        Header(
            max_length=LONGEST_HEADER,
            description="`filename`, and if need be `role` and `camera`, each with its value in base 64, divided by commas.",
        ),
    ],
) -> None:
    """Begin an upload; PATCH its `Location` until it is whole."""
    fields = _read_metadata(upload_metadata)
    name = fields.pop("filename", fields.pop("name", ""))
    check_file_name(name)
    told = check_fields({key: fields[key] for key in ("role", "camera") if key in fields})
    upload = service.begin_upload(caller.lab, session_id, name, told.role, told.camera, upload_length)
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    _describe(service, upload, response)


@router.head(
    "/uploads/{upload_id}",
    responses={200: {"headers": _UPLOAD}, **fails("not-found", "upload-locked", *ACCEPTING)},
)
def read_upload(upload_id: Id, response: Response, service: TheService, caller: Writer) -> None:
    """Tell how many bytes of an upload are safely there. One that is whole is accepted now, if it wasn't before."""
    upload = service.uploads.get(caller.lab, upload_id)
    if not service.uploads.is_receiving(upload):  # its server may have been killed in the middle of accepting it
        with service.uploads.locked(upload):
            upload = service.finish_upload(caller.lab, upload)
    response.headers["Cache-Control"] = "no-store"
    response.headers["Upload-Length"] = str(upload.length)
    _describe(service, upload, response)


@router.patch(
    "/uploads/{upload_id}",
    status_code=204,
    max_body_size=UNLIMITED,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/offset+octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
    responses={
        204: {"headers": _UPLOAD},
        **fails(
            "not-found", "upload-locked", "upload-offset-wrong", "upload-checksum-wrong", "upload-too-long",
            "upload-header-wrong", "upload-truncated", "unsupported-media-type", *ACCEPTING,
        ),
    },
)  # fmt: skip
async def extend_upload(
    upload_id: Id,
    request: Request,
    response: Response,
    service: TheService,
    caller: Writer,
    upload_offset: Annotated[int, Header(ge=0, le=1 << 53, description="Where this piece begins.")],
    content_type: Annotated[str, Header(max_length=200)] = "",
    upload_checksum: Annotated[
        str | None, Header(max_length=200, description="Its algorithm, a space, and the digest in base 64.")
    ] = None,
) -> None:
    """Add a piece to an upload. With the last one, the file is looked into and accepted, or refused and removed."""
    if content_type != "application/offset+octet-stream":
        raise InputError(
            "A piece has another type.",
            hint="Send `Content-Type: application/offset+octet-stream`.",
            code="unsupported-media-type",
        )
    upload = await run_in_threadpool(service.uploads.get, caller.lab, upload_id)
    with service.uploads.locked(upload):
        upload = await run_in_threadpool(service.uploads.get, caller.lab, upload_id)
        if not upload.file_id:
            await _receive(request, service, upload, upload_offset, upload_checksum)
            upload = await run_in_threadpool(service.finish_upload, caller.lab, upload)
    _describe(service, upload, response)


@router.delete("/uploads/{upload_id}", status_code=204, responses=fails("not-found", "upload-locked"))
def delete_upload(upload_id: Id, service: TheService, caller: Writer) -> None:
    """Give up an upload. A file that it became stays."""
    upload = service.uploads.get(caller.lab, upload_id)
    with service.uploads.locked(upload):
        service.uploads.delete(upload)


async def _receive(request: Request, service: Service, upload: Upload, offset: int, checksum: str | None) -> None:
    """Receive a piece of a locked upload; what came before a cut is kept."""
    piece = await run_in_threadpool(service.uploads.extend, upload, offset, checksum)
    try:
        async for content in _gathered(request):
            await run_in_threadpool(piece.write, content)
        await run_in_threadpool(piece.check)
    finally:
        await run_in_threadpool(piece.close)


async def _gathered(request: Request) -> AsyncGenerator[bytes]:
    """Give the body in pieces large enough to be worth a thread each, also what came before a cut."""
    content = bytearray()
    try:
        async for chunk in body_of(request):
            content += chunk
            if len(content) >= WRITE_BYTES:
                yield bytes(content)
                content.clear()
    except ClientDisconnect:
        yield bytes(content)
        raise
    yield bytes(content)


def _describe(service: Service, upload: Upload, response: Response) -> None:
    response.headers["Upload-Offset"] = str(service.uploads.offset(upload))
    response.headers["Upload-Expires"] = formatdate(service.uploads.expires_at_s(upload), usegmt=True)
    if upload.file_id:
        response.headers["Content-Location"] = f"/v1/sessions/{upload.session_id}/files/{upload.file_id}"


def _read_metadata(header: str) -> dict[str, str]:
    """Read ``Upload-Metadata``: pairs of a key and a value in base 64, divided by commas."""
    fields: dict[str, str] = {}
    for pair in header.split(","):
        key, _, value = pair.strip().partition(" ")
        try:
            fields[key] = base64.b64decode(value, validate=True).decode("utf-8", "surrogateescape")
        except binascii.Error:
            raise InputError(
                "Upload-Metadata can't be read.",
                hint="Send pairs of a key and a value in base 64, divided by commas.",
                code="upload-header-wrong",
            ) from None
    return fields
