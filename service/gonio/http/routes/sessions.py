"""Capture sessions."""

from typing import Annotated

from fastapi import APIRouter, Query, Response

from gonio.http.dependencies import CurrentLab, Id, Page, TheCaller, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import ListOf, SessionIn, SessionOut

router = APIRouter(prefix="/v1/sessions", tags=["sessions"], responses=fails(*GUARD))


@router.post("", status_code=201, responses=fails("malformed-body", "body-too-large", "not-found"))
def create_session(body: SessionIn, response: Response, service: TheService, lab: CurrentLab) -> SessionOut:
    """Create a session, to which the files of one capture are then uploaded."""
    row = service.create_session(
        lab,
        kind=body.kind,
        name=body.name,
        subject=body.subject.model_dump(exclude_none=True),
        calibration_id=str(body.calibration) if body.calibration is not None else None,
    )
    response.headers["Location"] = f"/v1/sessions/{row.id}"
    return SessionOut.of(row)


@router.get("", responses=fails("bad-cursor"))
def list_sessions(
    page: Page,
    service: TheService,
    caller: TheCaller,
    subject: Annotated[
        str | None, Query(max_length=100, description="Only those of the subject with this code.")
    ] = None,
) -> ListOf[SessionOut]:
    """List sessions, newest first."""
    rows = service.sessions(caller.lab, page.limit, page.after, subject)
    service.access.note_reading(caller, None, "sessions")
    return ListOf(items=[SessionOut.of(row) for row in rows], next_cursor=page.next_cursor(rows))


@router.get("/{session_id}", responses=fails("not-found"))
def read_session(session_id: Id, service: TheService, caller: TheCaller) -> SessionOut:
    """Read a session."""
    row = service.session(caller.lab, session_id)
    service.access.note_reading(caller, session_id, "session")
    return SessionOut.of(row)


@router.delete("/{session_id}", status_code=204, responses=fails("not-found", "session-busy"))
def delete_session(session_id: Id, service: TheService, lab: CurrentLab) -> None:
    """Delete a session with its files, jobs and reports: nothing of it is kept."""
    service.delete_session(lab, session_id)
