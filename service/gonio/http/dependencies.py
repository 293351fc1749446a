"""What routes ask for: the service, the lab that asks, ids, pages."""

import base64
import binascii
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Path, Query
from pydantic import AfterValidator
from starlette.requests import Request

from gonio.errors import InputError
from gonio.jobs.repository import Place
from gonio.jobs.service import Service
from gonio.jobs.tables import Row
from gonio.settings import Settings


def _service(request: Request) -> Service:
    return request.app.state.service


def _settings(request: Request) -> Settings:
    return request.app.state.settings


TheService = Annotated[Service, Depends(_service)]
TheSettings = Annotated[Settings, Depends(_settings)]


def _current_lab(settings: TheSettings) -> str:
    return settings.default_lab


CurrentLab = Annotated[str, Depends(_current_lab)]
"""The lab on whose behalf a request comes. Every route that reads or writes anything asks for it."""


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
        limit: Annotated[int, Query(ge=1, le=200, description="How many items a page has.")] = 50,
        cursor: Annotated[str | None, Query(max_length=200, description="`next_cursor` of the page before.")] = None,
    ) -> None:
        self.limit = limit
        self.after = None if cursor is None else _place(cursor)

    def next_cursor(self, rows: Sequence[Row]) -> str | None:
        """Give the cursor of the page after this one, if this one is full."""
        if len(rows) < self.limit:
            return None
        text = f"{rows[-1].created_at.isoformat()} {rows[-1].id}"
        return base64.urlsafe_b64encode(text.encode()).decode()


Page = Annotated[PageOf, Depends()]


def _place(cursor: str) -> Place:
    try:
        time, _, row_id = base64.urlsafe_b64decode(cursor).decode("ascii").partition(" ")
        return Place(datetime.fromisoformat(time), str(UUID(row_id)))
    except (ValueError, binascii.Error):
        raise InputError(
            "The cursor is not one of this service.", hint="Start at page one.", code="bad-cursor"
        ) from None
