"""Jobs: analyses on their way."""

import hashlib
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Header, Query, Response

from gonio.http.dependencies import CurrentLab, Id, Page, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import JobOut, ListOf
from gonio.jobs.tables import ACTIVE

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=fails(*GUARD))

RETRY_AFTER_S = 1
"""Progress is news once a second."""


@router.get("", responses=fails("bad-cursor"))
def list_jobs(
    page: Page,
    service: TheService,
    lab: CurrentLab,
    session: Annotated[UUID | None, Query(description="Only those of this session.")] = None,
) -> ListOf[JobOut]:
    """List jobs, newest first."""
    views = service.jobs(lab, page.limit, page.after, session and str(session))
    return ListOf(items=[JobOut.of(view) for view in views], next_cursor=page.next_cursor([v.row for v in views]))


@router.get(
    "/{job_id}",
    response_model=JobOut,
    responses={304: {"description": "Nothing has changed since the `ETag` in `If-None-Match`."}, **fails("not-found")},
)
def read_job(
    job_id: Id,
    service: TheService,
    lab: CurrentLab,
    if_none_match: Annotated[str | None, Header(description="An `ETag` of an earlier answer.")] = None,
) -> Response:
    """Read a job: its state, its progress, and in the end its report or its problem."""
    job = JobOut.of(service.job(lab, job_id))
    content = job.model_dump_json()
    headers = {"ETag": f'"{hashlib.sha256(content.encode()).hexdigest()[:32]}"'}
    if job.state in ACTIVE:
        headers["Retry-After"] = str(RETRY_AFTER_S)
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(content, media_type="application/json", headers=headers)


@router.post("/{job_id}/cancel", status_code=202, responses=fails("not-found"))
def cancel_job(job_id: Id, service: TheService, lab: CurrentLab) -> JobOut:
    """Cancel a job; one that has ended stays as it is."""
    return JobOut.of(service.cancel(lab, job_id))
