"""Who may do what: the keys of labs, and the trail of who read whose data."""

import hashlib
import re
import secrets
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Literal, get_args
from uuid import uuid4

from gonio.errors import InputError
from gonio.jobs.database import Database, upgrade
from gonio.jobs.repository import Place, Repository, any_key, key_of_any_lab
from gonio.jobs.tables import KeyRow, ReadingRow, now
from gonio.settings import Settings

Scope = Literal["read", "write", "admin"]
"""``read``: see all of the lab's. ``write``: create, upload, analyse, cancel, delete. ``admin``: keys, and who read what."""

SCOPES: tuple[Scope, ...] = get_args(Scope)

PREFIX = "gonio_"
"""All keys begin so: scanners of repositories and logs recognise them."""

LAB_NAME = r"[a-z0-9][a-z0-9-]{0,63}"
"""A lab's name is a part of its files' paths."""

LONGEST_KEY = 200
"""Nothing longer is looked at."""

USED_EVERY = timedelta(minutes=1)
"""How exactly the last use is kept: a write a request would be too dear."""


@dataclass(frozen=True)
class Caller:
    """On whose behalf a request comes: its lab, its key (None on the service's own machine), and what it may do."""

    lab: str
    key_id: str | None = None
    scopes: tuple[str, ...] = SCOPES


@dataclass(frozen=True)
class NewKey:
    """A key that was just made; ``secret`` is the key itself, which is shown once and kept nowhere."""

    row: KeyRow
    secret: str


class Access:
    """Gives out keys, knows their holders, and keeps the trail."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def has_keys(self) -> bool:
        """Tell whether a key was ever made: from then on, nobody gets in without one."""
        with self._database.read() as session:
            return any_key(session)

    def caller(self, key: str) -> Caller | None:
        """Give the caller whose key this is; None if the key is unknown, has expired or was revoked."""
        if not key.startswith(PREFIX) or len(key) > LONGEST_KEY:
            return None
        with self._database.read() as session:
            row = key_of_any_lab(session, _digest(key))
        if row is None:
            return None
        if row.last_used_at is None or row.last_used_at < now() - USED_EVERY:
            with self._database.write(row.lab) as session:
                Repository(session, row.lab).key(row.id).last_used_at = now()
        return Caller(lab=row.lab, key_id=row.id, scopes=tuple(row.scopes))

    def create_key(self, lab: str, name: str, scopes: Sequence[Scope], lifetime: timedelta | None = None) -> NewKey:
        """Make a key for a lab, which need not have one yet; without a lifetime it is valid until it is revoked.

        Raises:
            InputError: ``lab-name-wrong``.
        """
        if not re.fullmatch(LAB_NAME, lab):
            raise InputError(
                f"{lab!r} can't be the name of a lab.",
                hint="Use up to 64 small letters, digits and hyphens, such as st-mary-gait.",
                code="lab-name-wrong",
            )
        secret = PREFIX + secrets.token_urlsafe(32)
        row = KeyRow(
            id=str(uuid4()),
            name=name,
            digest=_digest(secret),
            scopes=sorted(set(scopes), key=SCOPES.index),
            expires_at=None if lifetime is None else now() + lifetime,
        )
        with self._database.write() as session:
            Repository(session, lab).add(row)
        return NewKey(row, secret)

    def rotate_key(self, lab: str, key_id: str, grace: timedelta) -> NewKey:
        """Make a key like this one, with as long a life; the old one itself stays valid for the ``grace``.

        Raises:
            InputError: ``not-found``, or ``key-expired`` if there is nothing left to replace.
        """
        with self._database.read() as session:
            old = Repository(session, lab).key(key_id)
        if old.expires_at is not None and old.expires_at <= now():
            raise InputError("The key is not valid any more.", hint="Make a new one.", code="key-expired")
        lifetime = None if old.expires_at is None else old.expires_at - old.created_at
        new = self.create_key(lab, old.name, [scope for scope in SCOPES if scope in old.scopes], lifetime)
        self._end(lab, key_id, grace)
        return new

    def revoke_key(self, lab: str, key_id: str) -> None:
        """End a key now; it stays listed.

        Raises:
            InputError: ``not-found``.
        """
        self._end(lab, key_id, timedelta(0))

    def keys(self, lab: str) -> Sequence[KeyRow]:
        """List a lab's keys, newest first, also those that are over."""
        with self._database.read() as session:
            return Repository(session, lab).keys()

    def note_reading(self, caller: Caller, session_id: str | None, what: str) -> None:
        """Note that a caller looked at what a session holds of its subject; None: at the list of sessions."""
        row = ReadingRow(id=str(uuid4()), key_id=caller.key_id, session_id=session_id, what=what)
        with self._database.write() as session:
            Repository(session, caller.lab).add(row)

    def readings(
        self, lab: str, session_id: str | None, limit: int, after: Place | None = None
    ) -> Sequence[ReadingRow]:
        """List who read what of a lab's, newest first; of one session if it is named."""
        with self._database.read() as session:
            return Repository(session, lab).readings(session_id, limit, after)

    def _end(self, lab: str, key_id: str, grace: timedelta) -> None:
        end = now() + grace
        with self._database.write(lab) as session:
            row = Repository(session, lab).key(key_id)
            row.expires_at = end if row.expires_at is None else min(row.expires_at, end)


def _digest(key: str) -> str:
    """Give what is kept of a key. It has 256 random bits: salt and stretching would add nothing."""
    return hashlib.sha256(key.encode()).hexdigest()


@contextmanager
def opened(settings: Settings) -> Generator[Access]:
    """Open a service's keys past its API: for whoever has its database, as the command line has."""
    upgrade(settings)
    database = Database(settings.resolved_database_url)
    try:
        yield Access(database)
    finally:
        database.close()
