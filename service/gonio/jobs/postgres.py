"""What is PostgreSQL's own: its driver, and locks that it drops when their owner's connection ends."""

import hashlib
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress

import psycopg
import sqlalchemy as sa

KEEPALIVE = "-c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 -c tcp_keepalives_count=3"
"""The server's side looks whether the client still lives: a machine that lost its power holds its locks for 25 s."""

CONNECT_S = 5
POLL_S = 0.1
RECONNECT_S = 0.5
PATIENCE_S = 600.0
"""How long a worker waits for a database that is out of reach before it gives a job up."""

_SILENCE = {"keepalives_idle": "10", "keepalives_interval": "5", "keepalives_count": "3", "tcp_user_timeout": "25000"}
"""The client's side looks whether the server still lives: one whose network was cut would be waited for for hours."""


def is_postgres(url: str) -> bool:
    """Tell whether a database URL is PostgreSQL's."""
    return sa.make_url(url).get_backend_name() == "postgresql"


def with_driver(url: str) -> sa.URL:
    """Give the URL of a PostgreSQL database with the one driver that gonio and DBOS use, and bounds on waiting."""
    made = sa.make_url(url).set(drivername="postgresql+psycopg")
    bounds = {"connect_timeout": str(CONNECT_S), **_SILENCE}
    return made.update_query_dict({name: value for name, value in bounds.items() if name not in made.query})


def without_driver(url: str) -> str:
    """Give the same as psycopg itself takes it."""
    return with_driver(url).set(drivername="postgresql").render_as_string(hide_password=False)


def connect_patiently(url: str, patience_s: float = PATIENCE_S) -> psycopg.Connection:
    """Connect to a PostgreSQL database; while it is out of reach, try again.

    For DBOS in a worker, which waits longer and longer between its own attempts, up to one and a half minutes, and ends a
    workflow whose connection fails in a way that it doesn't know (a socket that is gone, a name that is not resolved).
    """
    address = without_driver(url)
    end_s = time.monotonic() + patience_s
    while True:
        try:
            return psycopg.connect(address)
        except psycopg.OperationalError:
            if time.monotonic() > end_s:
                raise
        time.sleep(RECONNECT_S)


def lock_key(name: str) -> int:
    """Give the number by which PostgreSQL knows an advisory lock."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), signed=True)


class ServerLocks:
    """Locks among all processes of a PostgreSQL database: each process holds its own over one connection.

    The connection must be one to the server itself: a pool in between (PgBouncer in transaction mode) would share it.
    """

    def __init__(self, url: str) -> None:
        self._url = without_driver(url)
        self._connection: psycopg.Connection | None = None
        self._held: set[str] = set()

    @contextmanager
    def hold(self, name: str) -> Generator[None]:
        """Wait for a lock and hold it; see :meth:`renew` for what an outage does to it."""
        self._take(name)
        self._held.add(name)
        try:
            yield
        finally:
            self._held.discard(name)
            with suppress(psycopg.Error):  # after an outage it is gone already
                self._drop(name)
            self._rest()

    @contextmanager
    def try_hold(self, name: str) -> Generator[bool]:
        """Hold a lock if nobody else does, and say so."""
        free = self._ask("SELECT pg_try_advisory_lock(%s)", name)
        yield free
        if free:
            self._drop(name)
        self._rest()

    def names(self) -> list[str]:
        """Give nothing: the server forgets by itself."""
        return []

    def renew(self) -> bool:
        """Take again what an outage of the database took away, and tell whether there was one.

        Raises:
            psycopg.OperationalError: The outage isn't over.
        """
        if self._connection is not None:
            try:
                self._ask("SELECT %s IS NOT NULL", "")
            except psycopg.OperationalError:
                self._disconnect()
            else:
                return False
        try:
            for name in self._held:
                self._take(name)
        except psycopg.OperationalError:
            self._disconnect()  # or the next call would take the new connection for the one that holds the locks
            raise
        return True

    def _take(self, name: str) -> None:
        # Asked again and again: a statement that waited would be a transaction for which others wait, such as DBOS's
        # migrations when they make an index.
        while not self._ask("SELECT pg_try_advisory_lock(%s)", name):
            time.sleep(POLL_S)

    def _drop(self, name: str) -> None:
        self._ask("SELECT pg_advisory_unlock(%s)", name)

    def _rest(self) -> None:
        """Close the connection when nothing is held over it."""
        if not self._held:
            self._disconnect()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None

    def _ask(self, query: str, name: str) -> bool:
        if self._connection is None:
            self._connection = psycopg.connect(self._url, autocommit=True, options=KEEPALIVE)
        row = self._connection.execute(query, (lock_key(name),)).fetchone()  # pyright: ignore[reportArgumentType]
        return bool(row and row[0])
