"""Calibrations: what the jobs of sessions of kind `calibration` found. A calibration has the id of its job."""

from pathlib import PurePath
from typing import Annotated

from fastapi import APIRouter, Path, Response

from gonio.http.dependencies import CurrentLab, Id, Page, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.routes.reports import send_result
from gonio.http.schemas import CalibrationOut, ListOf, ResultFileOut

router = APIRouter(prefix="/v1/calibrations", tags=["calibrations"], responses=fails(*GUARD))


@router.get("", responses=fails("bad-cursor"))
def list_calibrations(page: Page, service: TheService, lab: CurrentLab) -> ListOf[CalibrationOut]:
    """List calibrations, newest first."""
    rows = service.calibrations(lab, page.limit, page.after)
    return ListOf(items=[CalibrationOut.of(row) for row in rows], next_cursor=page.next_cursor(rows))


@router.get("/{calibration_id}", responses=fails("not-found"))
def read_calibration(calibration_id: Id, service: TheService, lab: CurrentLab) -> CalibrationOut:
    """Read a calibration: its verdict, what is uncertain and what to do about it, and where its files are.

    A session or an analysis names it by its id as `calibration`.
    """
    return CalibrationOut.of(service.calibration(lab, calibration_id))


@router.get("/{calibration_id}/files", responses=fails("not-found"))
def list_calibration_files(calibration_id: Id, service: TheService, lab: CurrentLab) -> ListOf[ResultFileOut]:
    """List the files of a calibration, all on one page."""
    return ListOf(items=ResultFileOut.list_of(service.calibration(lab, calibration_id)))


@router.get(
    "/{calibration_id}/files/{name}",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {"application/octet-stream": {}, "text/html": {}}},
        206: {"description": "The part of it that `Range` asked for.", "content": {"application/octet-stream": {}}},
        **fails("not-found", "range-not-satisfiable", "malformed-body", "content-missing"),
    },
)
def read_calibration_file(
    calibration_id: Id, name: Annotated[str, Path(max_length=255)], service: TheService, lab: CurrentLab
) -> Response:
    """Read a file of a calibration: the document, the page with its pictures, or that of another program."""
    return send_result(service, service.calibration(lab, calibration_id), PurePath(name).name)
