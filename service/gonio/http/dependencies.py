"""What routes ask for: the service, who asks and for which lab, ids, pages."""

import base64
import binascii
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated
from urllib.parse import urlsplit
from uuid import UUID

from fastapi import Depends, Path, Query, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBasic, HTTPBasicCredentials, HTTPBearer
from pydantic import AfterValidator
from starlette.requests import Request

from gonio.errors import InputError
from gonio.jobs.access import Caller, Scope
from gonio.jobs.repository import Place
from gonio.jobs.service import Service
from gonio.jobs.tables import Row
from gonio.settings import Settings, is_loopback

# Those that wait for nothing are coroutines: a plain function would cost each request a thread and two changes to it.


async def _service(request: Request) -> Service:
    return request.app.state.service


async def _settings(request: Request) -> Settings:
    return request.app.state.settings


TheService = Annotated[Service, Depends(_service)]
TheSettings = Annotated[Settings, Depends(_settings)]


_BEARER = HTTPBearer(auto_error=False, scheme_name="key", description="A key of the lab: `gonio keys create LAB`.")
KEY_COOKIE = "gonio_key"
"""Where a browser keeps the key after `POST /sign-in`: HttpOnly, SameSite=Strict."""

_BASIC = HTTPBasic(auto_error=False, scheme_name="password", description="For browsers: any name, the key as password.")


def _known_caller(
    request: Request,
    service: TheService,
    settings: TheSettings,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)],
    basic: Annotated[HTTPBasicCredentials | None, Depends(_BASIC)],
) -> Caller:
    """Find out who asks.

    Raises:
        InputError: ``key-missing``, ``key-invalid`` or ``foreign-page``.
    """
    if _changes(request):
        refuse_foreign_pages(request)
    cookie = request.cookies.get(KEY_COOKIE, "")
    key = bearer.credentials if bearer else basic.password if basic else cookie
    if not key and is_at_home(request, service, settings):
        return _paced(request, Caller(settings.default_lab))
    if not key:
        raise InputError(
            "This service wants a key.",
            hint="Send `Authorization: Bearer KEY`; whoever runs the service makes one with `gonio keys create LAB`.",
            code="key-missing",
        )
    caller = service.access.caller(key)
    if caller is None:
        raise InputError(
            "The key is unknown, has expired or was revoked.", hint="Ask your lab for a valid one.", code="key-invalid"
        )
    return _paced(request, caller)


def _paced(request: Request, caller: Caller) -> Caller:
    """Refuse who asks too often."""
    wait_s = request.app.state.pace.wait_s(caller.key_id or caller.lab)
    if wait_s:
        raise InputError(
            "This key sends more requests than the service takes.",
            hint=f"Wait {wait_s} s. To follow a job, read its events, or ask with `Prefer: wait=30`.",
            code="too-many-requests",
            retry_after_s=wait_s,
        )
    return caller


_KnownCaller = Annotated[Caller, Depends(_known_caller)]


def _changes(request: Request) -> bool:
    return request.method not in ("GET", "HEAD")


def refuse_foreign_pages(request: Request) -> None:
    """Refuse what a page of another site sent.

    A browser sends passwords, and reaches this machine, also for a page of somebody else's.

    Raises:
        InputError: ``foreign-page``.
    """
    site, origin = request.headers.get("sec-fetch-site"), request.headers.get("origin")
    foreign = site not in ("same-origin", "none")
    if site is None:  # no browser, or one from before 2023, whose pages give at least their origin
        foreign = origin is not None and urlsplit(origin).netloc != request.headers.get("host")
    if foreign:
        raise InputError(
            "A page of another site sent this request.", hint="Use a client of your own.", code="foreign-page"
        )


def is_at_home(request: Request, service: Service, settings: Settings) -> bool:
    """Tell whether a request comes from this machine, on its own behalf, to a service that is for it alone.

    A proxy's requests come from this machine too, but on behalf of others; and a foreign page can make its own name
    point to this machine, but then that name stands in `Host`.
    """
    if settings.keys == "required" or not settings.is_embedded:
        return False
    forwarded = any(name in request.headers for name in ("forwarded", "x-forwarded-for", "x-forwarded-host", "via"))
    return not forwarded and is_loopback(request.url.hostname or "") and not service.access.has_keys()


def _allowed(caller: Caller, scope: Scope) -> Caller:
    if scope not in caller.scopes:
        raise InputError(
            f"This key may not {scope}: it has {', '.join(caller.scopes) or 'no scopes'}.",
            hint="Use a key with this scope.",
            code="scope-missing",
        )
    return caller


async def _caller(request: Request, caller: _KnownCaller) -> Caller:
    """Refuse who may not do what the method does."""
    return _allowed(caller, "write" if _changes(request) else "read")


TheCaller = Annotated[Caller, Depends(_caller)]
"""Who asks. Every route that reads or writes anything asks for it, or for the lab alone."""


async def _writer(caller: _KnownCaller) -> Caller:
    return _allowed(caller, "write")


Writer = Annotated[Caller, Depends(_writer)]
"""Who asks, for a route that belongs to writing whatever its method is."""


async def _administrator(caller: TheCaller) -> Caller:
    return _allowed(caller, "admin")


Administrator = Annotated[Caller, Depends(_administrator)]


async def _current_lab(caller: TheCaller) -> str:
    return caller.lab


CurrentLab = Annotated[str, Depends(_current_lab)]
"""The lab on whose behalf a request comes."""


def _known_shape(value: str) -> str:
    """Take what can't be an id for the id of nothing: 404, and nothing odd ever reaches the database."""
    try:
        return str(UUID(value))
    except ValueError:
        raise InputError("There is no such id.", hint="An id looks like a UUID.", code="not-found") from None


Id = Annotated[str, Path(description="An id that the service gave."), AfterValidator(_known_shape)]


class PageOf:
    """Which page of a list is asked for, newest first."""

    def __init__(
        self,
        request: Request,
        response: Response,
        limit: Annotated[int, Query(ge=1, le=200, description="How many items a page has.")] = 50,
        cursor: Annotated[str | None, Query(max_length=200, description="`next_cursor` of the page before.")] = None,
    ) -> None:
        self._request = request
        self._response = response
        self.limit = limit
        self.after = None if cursor is None else _place(cursor)

    def next_cursor(self, rows: Sequence[Row]) -> str | None:
        """Give the cursor of the page after this one, if this one is full, and tell it in the header `Link` too."""
        if len(rows) < self.limit:
            return None
        text = f"{rows[-1].created_at.isoformat()} {rows[-1].id}"
        cursor = base64.urlsafe_b64encode(text.encode()).decode()
        url = self._request.url.include_query_params(cursor=cursor)
        self._response.headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'
        return cursor


Page = Annotated[PageOf, Depends()]


def _place(cursor: str) -> Place:
    try:
        time, _, row_id = base64.urlsafe_b64decode(cursor).decode("ascii").partition(" ")
        return Place(datetime.fromisoformat(time), str(UUID(row_id)))
    except (ValueError, binascii.Error):
        raise InputError(
            "The cursor is not one of this service.", hint="Start at page one.", code="bad-cursor"
        ) from None
