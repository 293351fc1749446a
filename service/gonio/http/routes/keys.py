"""The keys of a lab, and who read what with them. Only a key with the scope `admin` gets in here."""

from datetime import timedelta
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query

from gonio.http.dependencies import Administrator, Id, Page, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import ErasureOut, KeyIn, KeyMade, KeyOut, ListOf, ReadingOut

router = APIRouter(prefix="/v1", tags=["access"], responses=fails(*GUARD))


@router.get("/keys", responses=fails())
def list_keys(service: TheService, caller: Administrator) -> ListOf[KeyOut]:
    """List the lab's keys, newest first, all on one page; also those that are over."""
    return ListOf(items=[KeyOut.of(row) for row in service.access.keys(caller.lab)])


@router.post("/keys", status_code=201, responses=fails("malformed-body", "body-too-large"))
def create_key(body: KeyIn, service: TheService, caller: Administrator) -> KeyMade:
    """Make a key. The answer is the only place where it stands: keep it there where a password would be kept."""
    lifetime = None if body.lifetime_days is None else timedelta(days=body.lifetime_days)
    return KeyMade.of_new(service.access.create_key(caller.lab, body.name, body.scopes, lifetime))


@router.post("/keys/{key_id}/rotate", status_code=201, responses=fails("not-found", "key-expired"))
def rotate_key(
    key_id: Id,
    service: TheService,
    caller: Administrator,
    grace_hours: Annotated[float, Query(ge=0, le=720, description="So long the old key stays valid.")] = 24.0,
) -> KeyMade:
    """Make a new key like this one, whose holder then has time to change over."""
    return KeyMade.of_new(service.access.rotate_key(caller.lab, key_id, timedelta(hours=grace_hours)))


@router.delete("/keys/{key_id}", status_code=204, responses=fails("not-found"))
def revoke_key(key_id: Id, service: TheService, caller: Administrator) -> None:
    """Revoke a key: it is refused from now on."""
    service.access.revoke_key(caller.lab, key_id)


@router.get("/audit", responses=fails("bad-cursor"))
def list_readings(
    page: Page,
    service: TheService,
    caller: Administrator,
    session: Annotated[UUID | None, Query(description="Of this session only.")] = None,
) -> ListOf[ReadingOut]:
    """List who read what of the lab's subjects, newest first."""
    rows = service.access.readings(caller.lab, str(session) if session else None, page.limit, page.after)
    return ListOf(items=[ReadingOut.of(row) for row in rows], next_cursor=page.next_cursor(rows))


@router.get("/erasures", responses=fails("bad-cursor"))
def list_erasures(page: Page, service: TheService, caller: Administrator) -> ListOf[ErasureOut]:
    """List the sessions that were deleted, newest first, and since when nothing is left of each."""
    rows = service.erasures(caller.lab, page.limit, page.after)
    return ListOf(items=[ErasureOut.of(row) for row in rows], next_cursor=page.next_cursor(rows))
