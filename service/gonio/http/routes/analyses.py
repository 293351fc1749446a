"""Analyses of a session: each starts a job."""

from typing import Annotated

from fastapi import APIRouter, Header, Response

from gonio.http.dependencies import CurrentLab, Id, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.routes.jobs import RETRY_AFTER_S
from gonio.http.schemas import PRINTABLE, AnalysisIn, JobOut

router = APIRouter(prefix="/v1/sessions/{session_id}/analyses", tags=["analyses"], responses=fails(*GUARD))


@router.post(
    "",
    status_code=202,
    responses=fails(
        "not-found",
        "malformed-body",
        "body-too-large",
        "calibration-missing",
        "calibration-ambiguous",
        "too-few-videos",
        "too-few-cameras",
        "object-files-missing",
        "idempotency-key-reused",
        "too-many-jobs",
    )
    | {200: {"description": "The job that computes or computed the same from the same files.", "model": JobOut}},
)
def start_analysis(
    session_id: Id,
    response: Response,
    service: TheService,
    lab: CurrentLab,
    body: AnalysisIn | None = None,
    idempotency_key: Annotated[
        str | None,
        Header(min_length=1, max_length=200, pattern=PRINTABLE, description="The same key gives the same job again."),
    ] = None,
) -> JobOut:
    """Analyse the files that the session has now, or calibrate from them; `Location` is the job to ask for its end."""
    asked = body if body is not None else AnalysisIn()
    calibration = str(asked.calibration) if asked.calibration is not None else None
    row, new = service.enqueue(lab, session_id, asked.parameters, idempotency_key, calibration)
    response.status_code = 202 if new or idempotency_key is not None else 200
    response.headers["Location"] = f"/v1/jobs/{row.id}"
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobOut.of(service.job(lab, row.id))
