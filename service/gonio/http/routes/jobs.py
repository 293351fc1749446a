"""Jobs: analyses on their way."""

import asyncio
import hashlib
import re
import time
from collections.abc import AsyncIterable
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent

from gonio.errors import InputError
from gonio.http.dependencies import CurrentLab, Id, Page, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import JobOut, ListOf
from gonio.jobs.service import Service
from gonio.jobs.tables import ACTIVE

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=fails(*GUARD))

RETRY_AFTER_S = 1
"""Progress is news once a second."""

LOOK_S = 0.25
"""How often a request that waits looks at its job."""

LONGEST_WAIT_S = 30


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
async def read_job(
    job_id: Id,
    service: TheService,
    lab: CurrentLab,
    if_none_match: Annotated[str | None, Header(description="An `ETag` of an earlier answer.")] = None,
    prefer: Annotated[
        str | None,
        Header(
            max_length=200,
            description=f"`wait=N`: answer when the job ends, or with `If-None-Match` when it changes, but "
            f"after N seconds (at most {LONGEST_WAIT_S}) in any case.",
        ),
    ] = None,
) -> Response:
    """Read a job: its state, its progress, and in the end its report or its problem."""
    wait_s = _wanted_wait_s(prefer)
    job, tag = await _read(service, lab, job_id)
    end_s = time.monotonic() + wait_s
    while time.monotonic() < end_s and job.state in ACTIVE and if_none_match in (None, tag):
        await asyncio.sleep(LOOK_S)
        job, tag = await _read(service, lab, job_id)
    headers = {"ETag": tag}
    if wait_s:
        headers["Preference-Applied"] = f"wait={wait_s}"
    if job.state in ACTIVE:
        headers["Retry-After"] = str(RETRY_AFTER_S)
    if if_none_match == tag:
        return Response(status_code=304, headers=headers)
    return Response(job.model_dump_json(), media_type="application/json", headers=headers)


async def _known_job(job_id: Id, service: TheService, lab: CurrentLab) -> str:
    """Look for the job before the answer begins, which can't become a problem any more then."""
    await run_in_threadpool(service.job, lab, job_id)
    return job_id


@router.get("/{job_id}/events", response_class=EventSourceResponse, responses=fails("not-found"))
async def follow_job(
    job_id: Annotated[str, Depends(_known_job)],
    service: TheService,
    lab: CurrentLab,
    last_event_id: Annotated[str | None, Header(max_length=200, description="The last event that was seen.")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """Follow a job: each change is an event `job` with what GET gives, at most one a second; the last one is its end."""
    seen = last_event_id
    while True:
        try:
            job, tag = await _read(service, lab, job_id)
        except InputError:  # it was deleted
            return
        if tag != seen:
            yield ServerSentEvent(event="job", id=tag, data=job)
            seen = tag
        if job.state not in ACTIVE:
            return
        await asyncio.sleep(RETRY_AFTER_S)


@router.post("/{job_id}/cancel", status_code=202, responses=fails("not-found"))
def cancel_job(job_id: Id, service: TheService, lab: CurrentLab) -> JobOut:
    """Cancel a job; one that has ended stays as it is."""
    return JobOut.of(service.cancel(lab, job_id))


async def _read(service: Service, lab: str, job_id: str) -> tuple[JobOut, str]:
    """Give a job with its ETag."""
    job = JobOut.of(await run_in_threadpool(service.job, lab, job_id))
    return job, f'"{hashlib.sha256(job.model_dump_json().encode()).hexdigest()[:32]}"'


def _wanted_wait_s(prefer: str | None) -> int:
    match = re.search(r"(?:^|[,;\s])wait=(\d{1,6})(?:$|[,;\s])", prefer or "")
    return min(int(match[1]), LONGEST_WAIT_S) if match else 0
