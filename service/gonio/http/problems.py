"""What an error looks like over HTTP: ``application/problem+json`` (RFC 9457), from ONE table of codes.

The domain raises GonioErrors that know nothing of HTTP. A code that isn't in the table gets the status of its class; a
code that is has a page of its own, ``/problems/<code>``, which the problem's ``type`` points to.
"""

import errno
import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, NamedTuple
from uuid import uuid4

import psycopg
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import Request

from gonio import errors
from gonio.jobs.database import database_unreachable
from gonio.jobs.failure import describe
from gonio.jobs.store import disk_full, store_unreachable

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"


class Kind(NamedTuple):
    """A documented kind of problem."""

    status: int
    title: str
    meaning: str


KINDS: Mapping[str, Kind] = {
    # the classes of gonio.errors
    "invalid-input": Kind(422, "Invalid input", "A file or a value can't be used. The detail says which, and why."),
    "capture-insufficient": Kind(409, "Recording not sufficient", "The recording can't give the answer asked for."),
    "solver-failed": Kind(500, "Solver failed", "A numerical solver found no solution; the job's problem says where."),
    "resource-missing": Kind(503, "Something is missing", "A model or a tool isn't installed on the service."),
    "cancelled": Kind(409, "Cancelled", "The analysis was cancelled on request."),
    # requests
    "invalid-request": Kind(422, "Invalid request", "A parameter or a field has a wrong value; `errors` lists each."),
    "malformed-body": Kind(400, "Malformed body", "The body is no valid JSON or no valid form."),
    "body-too-large": Kind(413, "Body too large", "The body of a request without a file has at most 1 MB."),
    "unsupported-media-type": Kind(415, "Unsupported media type", "The body has another type than the page takes."),
    "method-not-allowed": Kind(405, "Method not allowed", "This address exists, but not for this method."),
    "range-not-satisfiable": Kind(416, "Range not satisfiable", "The file has no bytes in the range asked for."),
    "too-many-requests": Kind(429, "Too many requests", "A key sent more than GONIO_REQUESTS_PER_MINUTE."),
    "bad-cursor": Kind(422, "Bad cursor", "`cursor` must be the `next_cursor` of the page before."),
    "not-found": Kind(404, "Not found", "There is nothing under this address, or it belongs to another lab."),
    "http-error": Kind(400, "Request refused", "The request can't be answered; the status says why."),
    # keys
    "key-missing": Kind(401, "Key missing", "The request carries no key, and this service wants one."),
    "key-invalid": Kind(401, "Key invalid", "The key is unknown, has expired or was revoked."),
    "key-expired": Kind(409, "Key expired", "A key that is over can't be replaced by a new one like it."),
    "scope-missing": Kind(
        403, "Scope missing", "The key is valid, but not for this: it lacks `read`, `write` or `admin`."
    ),
    "foreign-page": Kind(403, "Foreign page", "A browser sent the request for a page of another site."),
    "webhook-address-wrong": Kind(422, "Webhook's address wrong", "It isn't https, unknown, or in a private network."),
    # files
    "bad-file-name": Kind(422, "Bad file name", "A name has at most 255 bytes, no path, no invisible characters."),
    "role-wrong": Kind(422, "Role wrong", "A session of this kind has no files of that role."),
    "camera-missing": Kind(422, "Camera missing", "A photograph's camera must be named."),
    "image-empty": Kind(422, "Picture empty", "The picture has no content."),
    "image-unreadable": Kind(422, "Picture unreadable", "The picture can't be decoded, or is smaller than 16 pixels."),
    "board-card-unreadable": Kind(422, "Board's card unreadable", "An entry of the card is missing, unknown or wrong."),
    "floor-points-unreadable": Kind(422, "Floor points unreadable", "The detail names the point and what is wrong."),
    "pressure-card-unreadable": Kind(
        422, "Pressure card unreadable", "An entry is missing, unknown, wrong or contradicted."
    ),
    "pressure-unreadable": Kind(422, "Pressure unreadable", "The file is no table with the columns that are needed."),
    "pressure-clock": Kind(422, "Pressure's clock wrong", "Times are missing, go back, stand still or miss the video."),
    "pressure-too-long": Kind(
        422, "Pressure too long", "The table has more samples beside the video than gonio keeps."
    ),
    "pressure-one-foot": Kind(422, "One foot only", "The force on the body is known from both feet only."),
    "pressure-negative": Kind(422, "Pressure negative", "More values are below zero than noise explains."),
    "pressure-unit": Kind(422, "Unit of pressure wrong", "Both feet together carry what no person weighs."),
    "pressure-cop": Kind(422, "Centre of pressure wrong", "It is missing, or lies off the sole."),
    "force-coefficients-invalid": Kind(
        422, "Force coefficients unreadable", "An entry is missing, or of the wrong kind."
    ),
    "capture-file-unreadable": Kind(
        422, "C3D unreadable", "The file is no C3D, is cut short, or holds plates of unknown type."
    ),
    "plates-missing": Kind(422, "No force plates", "The file holds no force plates."),
    "role-unknown": Kind(422, "Role unknown", "The file's name doesn't tell what it is."),
    "file-missing": Kind(422, "File missing", "The form has no part `file`."),
    "file-exists": Kind(409, "File exists", "The session has a file of this name with other content, role or camera."),
    "file-too-nested": Kind(422, "File too nested", "The file nests its values deeper than any program would."),
    "file-too-large": Kind(413, "File too large", "The file is larger than GONIO_MAX_UPLOAD_BYTES."),
    "upload-truncated": Kind(400, "Upload truncated", "The form ended before its last part did. Nothing was kept."),
    "quota-exceeded": Kind(507, "Quota exceeded", "The lab keeps as much as it may, GONIO_LAB_QUOTA_BYTES."),
    "upload-locked": Kind(423, "Upload locked", "Another request writes to this upload at the moment."),
    "upload-offset-wrong": Kind(409, "Offset wrong", "The piece begins elsewhere than the upload stands."),
    "upload-checksum-wrong": Kind(
        460, "Checksum mismatch", "The piece was damaged on its way; nothing of it was kept."
    ),
    "upload-too-long": Kind(413, "Upload too long", "More bytes came than were announced; the piece was not kept."),
    "upload-header-wrong": Kind(400, "Header wrong", "A header of the upload can't be read; the detail says which."),
    "tus-version-unsupported": Kind(412, "Version of tus unsupported", "This service speaks tus 1.0.0."),
    "disk-full": Kind(507, "Disk full", "The service has no room for the file."),
    "not-a-video": Kind(422, "Not a video", "The file is no video container that gonio opens."),
    "no-video-stream": Kind(422, "No video stream", "The file is a container without pictures."),
    "video-truncated": Kind(422, "Video truncated", "The video ends before its header says it does."),
    "video-empty": Kind(422, "Video empty", "The video has fewer than two frames."),
    "video-damaged": Kind(422, "Video damaged", "A frame of the video can't be decoded."),
    "video-codec-unsupported": Kind(422, "Codec unsupported", "The video's compression can't be decoded here."),
    "poses-unreadable": Kind(422, "Keypoints unreadable", "The file is no archive of OpenPose's files, one a frame."),
    "calibration-format-unknown": Kind(422, "Calibration format unknown", "No reader of gonio knows the file."),
    "calibration-unreadable": Kind(422, "Calibration unreadable", "The calibration is damaged."),
    "calibration-incomplete": Kind(422, "Calibration incomplete", "A camera of the calibration lacks a value."),
    # analyses and jobs
    "calibration-missing": Kind(409, "Calibration missing", "An analysis needs the calibration of its cameras."),
    "calibration-ambiguous": Kind(422, "Calibration ambiguous", "There are several calibrations; which one is meant?"),
    "too-few-cameras": Kind(409, "Too few cameras", "A rig is calibrated from the videos of two cameras or more."),
    "object-files-missing": Kind(
        409, "Object's files missing", "A joint tree, tracks, and what tells the cameras are needed, one of each."
    ),
    "too-few-videos": Kind(
        409, "Too few videos", "A point needs two cameras to be seen in space; a session of one camera needs that one."
    ),
    "too-many-jobs": Kind(429, "Too many jobs", "The lab has as many jobs waiting as it may, GONIO_JOBS_PER_LAB."),
    "session-busy": Kind(409, "Session busy", "What an analysis reads can't be deleted while it runs."),
    "idempotency-key-reused": Kind(422, "Idempotency key reused", "A key stands for one analysis, for ever."),
    "internal-error": Kind(500, "Internal error", "A fault of gonio's own; its log explains the `reference`."),
    "worker-crashed": Kind(500, "Worker crashed", "The analysis ended the process that computed it."),
    "artefact-damaged": Kind(500, "Artefact damaged", "An intermediate result is missing or has changed on the disk."),
    "content-missing": Kind(500, "Content missing", "A file that the database knows was removed from the store."),
    "database-unreachable": Kind(503, "Database unreachable", "The service can't use its database at the moment."),
    "store-unreachable": Kind(503, "Store unreachable", "The service can't use its store of files at the moment."),
    "not-ready": Kind(503, "Not ready", "The service runs but can't do its work at the moment."),
}

GUARD = ("key-missing", "key-invalid", "scope-missing", "foreign-page", "too-many-requests")
"""How every route may fail that belongs to a lab."""

ANYWHERE = ("internal-error", "database-unreachable", "store-unreachable")
"""How every route may fail."""

RETRY_AFTER_S = 5
"""When to ask again what is out of reach now."""

_SCHEMA = {"$ref": "#/components/schemas/Problem"}

_OF_STATUS = {
    400: "malformed-body",
    401: "key-invalid",
    404: "not-found",
    405: "method-not-allowed",
    413: "body-too-large",
    415: "unsupported-media-type",
    416: "range-not-satisfiable",
}


def entry_of(code: str, class_name: str = "") -> str:
    """Give the table's entry for a code: its own or, for a code that only the domain knows, that of its class."""
    if code in KINDS:
        return code
    of_class = getattr(getattr(errors, class_name, None), "code", "")
    return of_class if of_class in KINDS else "internal-error"


def fails(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Document for OpenAPI how a route may fail; every route may fail by an invalid request or a fault of ours."""
    responses: dict[int | str, dict[str, Any]] = {}
    for code in (*codes, "invalid-request", *ANYWHERE):
        kind = KINDS[code]
        entry = responses.setdefault(kind.status, {"description": "", "content": {MEDIA_TYPE: {"schema": _SCHEMA}}})
        entry["description"] += f"* `{code}`: {kind.meaning}\n"
    return responses


def problem(
    request: Request,
    code: str,
    detail: str,
    *,
    hint: str = "See /docs.",
    class_name: str = "",
    status: int | None = None,
    headers: Mapping[str, str] | None = None,
    members: Mapping[str, Any] | None = None,
) -> JSONResponse:
    """Make a problem response."""
    name = entry_of(code, class_name)
    content: dict[str, Any] = {
        **(members or {}),
        "type": f"/problems/{name}",
        "title": KINDS[name].title,
        "status": status or KINDS[name].status,
        "detail": detail,
        "instance": request.url.path,
        "code": code,
        "hint": hint,
    }
    return JSONResponse(content, content["status"], headers, MEDIA_TYPE)


def of_gonio_error(request: Request, error: Exception) -> JSONResponse:
    """Answer with an error of the domain."""
    told = describe(error)
    answer = problem(
        request, told["code"], told["message"], hint=told["hint"], class_name=told["kind"], members=told["details"]
    )
    if answer.status_code == HTTPStatus.SERVICE_UNAVAILABLE:
        log.warning("%s at %s %r: %s", told["code"], request.method, request.url.path, error.__cause__)
        answer.headers["Retry-After"] = str(RETRY_AFTER_S)
    if answer.status_code == HTTPStatus.TOO_MANY_REQUESTS:
        answer.headers["Retry-After"] = str(told["details"]["retry_after_s"])
    if answer.status_code == HTTPStatus.UNAUTHORIZED:
        # A browser that wants a page asks its user for the password; a script's request must not make it ask.
        wants_page = "text/html" in request.headers.get("accept", "")
        answer.headers["WWW-Authenticate"] = f'{"Basic" if wants_page else "Bearer"} realm="gonio"'
    return answer


def of_database_error(request: Request, error: Exception) -> JSONResponse:
    """Answer that the database is out of reach, or that its disk is full."""
    assert isinstance(error, OperationalError)
    full = "is full" in str(error.orig) or isinstance(error.orig, psycopg.errors.DiskFull)
    told = disk_full() if full else database_unreachable()
    told.__cause__ = error.orig
    return of_gonio_error(request, told)


def of_disk_error(request: Request, error: Exception) -> JSONResponse:
    """Answer that the disk is full, can't be written, or fails; any other error of the system is one of gonio's own."""
    assert isinstance(error, OSError)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        told = disk_full()
    elif error.errno in (errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE, errno.ENODEV):
        told = store_unreachable()
    else:
        return of_unforeseen_error(request, error)
    told.__cause__ = error
    return of_gonio_error(request, told)


def of_http_error(request: Request, error: Exception) -> JSONResponse:
    """Answer with an error of the framework: an unknown address, a method that isn't allowed, a body too large."""
    assert isinstance(error, HTTPException)
    return of_status(request, error.status_code, error.headers)


def of_status(request: Request, status: int, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Answer with no more than a status."""
    code = _OF_STATUS.get(status, "http-error")
    return problem(request, code, KINDS[code].meaning, status=status, headers=headers)


def of_invalid_request(request: Request, error: Exception) -> JSONResponse:
    """Answer with everything that is wrong in a request, but not with what was sent."""
    assert isinstance(error, RequestValidationError)
    found = [(".".join(str(part) for part in item["loc"]), str(item["msg"]), item["type"]) for item in error.errors()]
    if any(kind == "json_invalid" for _, _, kind in found):
        return problem(request, "malformed-body", "The body is no valid JSON.", hint="Check its syntax.")
    errors = [{"where": where, "message": message} for where, message, _ in found]
    detail = "; ".join(f"{item['where']}: {item['message']}" for item in errors[:3])
    hint = "See the page of this address in /docs."
    return problem(request, "invalid-request", detail, hint=hint, members={"errors": errors})


def of_disconnect(request: Request, error: Exception) -> JSONResponse:
    """Answer a sender who went away, for the log of a proxy in between."""
    return problem(request, "upload-truncated", KINDS["upload-truncated"].meaning, hint="Send it again.")


def of_unforeseen_error(request: Request, error: Exception) -> JSONResponse:
    """Answer with a reference; what happened is in the log and nowhere else."""
    reference = uuid4().hex[:12]
    log.error("Internal error %s at %s %r", reference, request.method, request.url.path, exc_info=error)
    return problem(
        request,
        "internal-error",
        "Something went wrong inside gonio.",
        hint=f"Tell whoever runs the service: its log explains the reference {reference}.",
        members={"reference": reference},
    )
