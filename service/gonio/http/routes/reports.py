"""Reports: what an analysis found. A report has the id of its job."""

from pathlib import PurePath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Response

from gonio.errors import InputError
from gonio.http.dependencies import CurrentLab, Id, TheCaller, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.routes.files import send_content
from gonio.http.schemas import ListOf, ResultFileOut
from gonio.jobs.service import Service
from gonio.jobs.tables import CalibrationRow, ReportRow

router = APIRouter(prefix="/v1/reports", tags=["reports"], responses=fails(*GUARD))

SHOWN = {".html": "text/html; charset=utf-8", ".json": "application/json", ".svg": "image/svg+xml", ".png": "image/png"}
"""What a browser shows; everything else it saves. The answer's content policy lets none of it run anything."""


@router.get(
    "/{report_id}",
    response_class=Response,
    responses={
        200: {"description": "The report.", "content": {"application/json": {}}},
        **fails("not-found", "content-missing"),
    },
)
def read_report(report_id: Id, service: TheService, caller: TheCaller) -> Response:
    """Read a report: the JSON document, whose `schema` member names its version."""
    row = service.report(caller.lab, report_id)
    service.access.note_reading(caller, row.session_id, "report")
    file = next(file for file in row.files if file["kind"] == "document")
    return send_content(service, file["key"], file["name"], file["sha256"], media_type="application/json", inline=True)


@router.get("/{report_id}/files", responses=fails("not-found"))
def list_report_files(report_id: Id, service: TheService, lab: CurrentLab) -> ListOf[ResultFileOut]:
    """List the files of a report, all on one page."""
    return ListOf(items=ResultFileOut.list_of(service.report(lab, report_id)))


@router.get(
    "/{report_id}/files/{name}",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {"application/octet-stream": {}, "text/html": {}}},
        206: {"description": "The part of it that `Range` asked for.", "content": {"application/octet-stream": {}}},
        **fails("not-found", "range-not-satisfiable", "malformed-body", "content-missing"),
    },
)
def read_report_file(
    report_id: Id, name: Annotated[str, Path(max_length=255)], service: TheService, caller: TheCaller
) -> Response:
    """Read a file of a report; the page is shown, TRC and MOT are saved."""
    row = service.report(caller.lab, report_id)
    service.access.note_reading(caller, row.session_id, f"report {name}")
    return send_result(service, row, name)


def send_result(service: Service, row: ReportRow | CalibrationRow, name: str) -> Response:
    """Send a file of a result: shown if a browser can show it, else saved."""
    files: dict[str, Any] = {file["name"]: file for file in row.files}
    if name not in files:
        raise InputError("There is no such file.", hint="GET the list of the files.", code="not-found")
    media_type = SHOWN.get(PurePath(name).suffix.lower())
    return send_content(
        service,
        files[name]["key"],
        name,
        files[name]["sha256"],
        media_type=media_type or "application/octet-stream",
        inline=media_type is not None,
    )
