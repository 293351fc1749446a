"""The files of a session."""

from contextlib import ExitStack
from typing import Any, get_args

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse
from pydantic import TypeAdapter, ValidationError
from starlette.background import BackgroundTask

from gonio.http.dependencies import CurrentLab, Id, TheCaller, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import FileFields, FileOut, ListOf
from gonio.http.uploads import receive_form
from gonio.jobs.service import Service
from gonio.pipeline.run import Role

router = APIRouter(prefix="/v1/sessions/{session_id}/files", tags=["files"], responses=fails(*GUARD))

UNLIMITED = 1 << 62
"""The limit of a body is for JSON; that of a file is checked byte by byte in the spool."""

ACCEPTING = (
    "not-a-video",
    "no-video-stream",
    "video-truncated",
    "video-empty",
    "video-damaged",
    "video-codec-unsupported",
    "calibration-format-unknown",
    "calibration-unreadable",
    "calibration-incomplete",
    "image-empty",
    "image-unreadable",
    "board-card-unreadable",
    "floor-points-unreadable",
    "pressure-card-unreadable",
    "pressure-unreadable",
    "poses-unreadable",
    "pressure-clock",
    "pressure-too-long",
    "pressure-one-foot",
    "pressure-negative",
    "pressure-unit",
    "pressure-cop",
    "force-coefficients-invalid",
    "capture-file-unreadable",
    "plates-missing",
    "file-exists",
    "file-too-large",
    "file-too-nested",
    "disk-full",
    "quota-exceeded",
)
"""How a file may be refused that came whole."""

_FORM = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "additionalProperties": False,
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "The file, with its name."},
                        "role": {
                            "type": "string",
                            "enum": list(get_args(Role)),
                            "description": "What it is; without it, the suffix of its name tells.",
                        },
                        "camera": {
                            "type": "string",
                            "maxLength": 100,
                            "description": "A video's or a photograph's camera; without it, a video's name tells it.",
                        },
                    },
                }
            }
        },
    }
}


@router.post(
    "",
    status_code=201,
    openapi_extra=_FORM,
    max_body_size=UNLIMITED,
    responses={
        200: {"description": "The session has this very file already.", "model": FileOut},
        **fails(
            "not-found",
            "malformed-body",
            "upload-truncated",
            "unsupported-media-type",
            "bad-file-name",
            "role-unknown",
            "role-wrong",
            "camera-missing",
            "file-missing",
            *ACCEPTING,
        ),
    },
)
async def upload_file(
    session_id: Id, request: Request, response: Response, service: TheService, lab: CurrentLab
) -> FileOut:
    """Upload a file: `curl -F file=@cam01.mp4 …`.

    It is opened and looked into before it is accepted. What was accepted is not lost; of what wasn't, nothing is kept.
    The same file twice is one file; other content under the same name is refused.
    """
    await run_in_threadpool(service.session, lab, session_id)  # before 20 GB are sent to a session that doesn't exist
    async with receive_form(request, service.spool) as form:
        assert form.file is not None
        fields = check_fields(form.fields)
        row, new = await run_in_threadpool(service.accept_file, lab, session_id, form.file, fields.role, fields.camera)
    shown = FileOut.of(row)
    response.status_code = 201 if new else 200
    response.headers["Location"] = shown.content
    return shown


@router.get("", responses=fails("not-found"))
def list_files(session_id: Id, service: TheService, lab: CurrentLab) -> ListOf[FileOut]:
    """List the files of a session by name, all on one page."""
    return ListOf(items=[FileOut.of(row) for row in service.files(lab, session_id)])


@router.get(
    "/{file_id}",
    response_class=Response,
    responses={
        200: {"description": "The content.", "content": {"application/octet-stream": {}}},
        206: {"description": "The part of it that `Range` asked for.", "content": {"application/octet-stream": {}}},
        **fails("not-found", "range-not-satisfiable", "malformed-body", "content-missing"),
    },
)
def read_file(session_id: Id, file_id: Id, service: TheService, caller: TheCaller) -> Response:
    """Read the content of a file, or with `Range` a part of it."""
    row = service.file(caller.lab, session_id, file_id)
    service.access.note_reading(caller, session_id, f"file {row.name}")
    return send_content(service, row.key, row.name, row.sha256)


@router.delete("/{file_id}", status_code=204, responses=fails("not-found", "session-busy"))
def delete_file(session_id: Id, file_id: Id, service: TheService, lab: CurrentLab) -> None:
    """Delete a file."""
    service.delete_file(lab, session_id, file_id)


def send_content(
    service: Service,
    key: str,
    name: str,
    sha256: str,
    *,
    media_type: str = "application/octet-stream",
    inline: bool = False,
) -> Response:
    """Send an object of the store, with `Range` and an ETag."""
    with ExitStack() as stack:
        path = stack.enter_context(service.content(key))
        keep = stack.pop_all()
    return FileResponse(
        path,
        media_type=media_type,
        filename=name,
        content_disposition_type="inline" if inline else "attachment",
        headers={"ETag": f'"{sha256}"'},
        background=BackgroundTask(keep.close),  # a bucket's local copy lives as long as the answer
    )


def check_fields(fields: dict[str, str]) -> FileFields:
    """Check the text fields like any other input."""
    try:
        return TypeAdapter(FileFields).validate_python(fields)
    except ValidationError as error:
        errors: list[Any] = [{**item, "loc": ("body", *item["loc"])} for item in error.errors(include_url=False)]
        raise RequestValidationError(errors) from error
