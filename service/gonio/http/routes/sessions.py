"""Capture sessions."""

from fastapi import APIRouter, Response

from gonio.http.dependencies import CurrentLab, Id, Page, TheService
from gonio.http.problems import fails
from gonio.http.schemas import ListOf, SessionIn, SessionOut

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])


@router.post("", status_code=201, responses=fails("malformed-body", "body-too-large"))
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
def list_sessions(page: Page, service: TheService, lab: CurrentLab) -> ListOf[SessionOut]:
    """List sessions, newest first."""
    rows = service.sessions(lab, page.limit, page.after)
    return ListOf(items=[SessionOut.of(row) for row in rows], next_cursor=page.next_cursor(rows))


@router.get("/{session_id}", responses=fails("not-found"))
def read_session(session_id: Id, service: TheService, lab: CurrentLab) -> SessionOut:
    """Read a session."""
    return SessionOut.of(service.session(lab, session_id))


@router.delete("/{session_id}", status_code=204, responses=fails("not-found", "session-busy"))
def delete_session(session_id: Id, service: TheService, lab: CurrentLab) -> None:
    """Delete a session with its files, jobs and reports: nothing of it is kept."""
    service.delete_session(lab, session_id)
