"""The database: one for gonio's own tables and for DBOS's, so that a job and its queue entry are one transaction."""

import logging
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.resources import as_file, files
from typing import Any, TypeVar

import psycopg
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from dbos import DBOS
from sqlalchemy import event
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from gonio.errors import InputError, ResourceError
from gonio.jobs.liveness import open_locks
from gonio.jobs.postgres import PATIENCE_S, is_postgres, lock_key, with_driver
from gonio.settings import Settings

log = logging.getLogger(__name__)

T = TypeVar("T")

LONGEST_PAUSE_S = 2.0


class Database:
    """An SQLAlchemy engine whose transactions say beforehand whether they will write."""

    def __init__(self, url: str) -> None:
        self._is_postgres = is_postgres(url)
        if not self._is_postgres and not url.startswith("sqlite:"):
            raise InputError(
                f"The database {sa.make_url(url).render_as_string()} is of a kind that isn't supported.",
                hint="Leave GONIO_DATABASE_URL unset, or give it a postgresql:// or a sqlite:/// URL.",
                code="database-unsupported",
            )
        if self._is_postgres:
            self.engine = sa.create_engine(with_driver(url), pool_pre_ping=True, pool_size=10, max_overflow=30)
        else:
            # As many as the API has threads: one more would be opened and configured for each request anew.
            self.engine = sa.create_engine(url, pool_size=40)
            event.listen(self.engine, "connect", _configure_sqlite)
            event.listen(self.engine, "begin", _begin_sqlite)
        self._writing = self.engine.execution_options(begin="IMMEDIATE")

    @contextmanager
    def read(self) -> Generator[Session]:
        """Give a session that only reads: it waits for nobody."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def write(self, lab: str | None = None) -> Generator[Session]:
        """Give a session that is committed when the block ends without an error.

        Those of one lab come one after another (on SQLite, those of all labs): what such a session reads of the lab
        stays true until it commits. Without a lab it may only add what nobody else changes.
        """
        with Session(self._writing, expire_on_commit=False) as session, session.begin():
            if self._is_postgres and lab is not None:
                session.execute(sa.select(sa.func.pg_advisory_xact_lock(lock_key(f"lab {lab}"))))
            yield session

    def scrub(self) -> None:
        """Have the database hold no byte any more of what was deleted: SQLite only marks its pages as free, and keeps a log.

        PostgreSQL does so by itself, in its own time (autovacuum).
        """
        if self._is_postgres:
            return
        with self.engine.connect().execution_options(begin="DEFERRED") as connection:
            raw = connection.connection.dbapi_connection
            assert raw is not None
            connection.rollback()
            raw.execute("VACUUM")
            raw.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def patiently(work: Callable[[], T], patience_s: float = PATIENCE_S) -> T:
    """Do something in the database; while it is out of reach or full, try again."""
    end_s, pause_s = time.monotonic() + patience_s, 0.1
    while True:
        try:
            return work()
        except OperationalError as error:
            if time.monotonic() > end_s:
                raise
            log.warning("The database can't be used (%s); trying again in %.1f s", error.orig, pause_s)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


def database_unreachable() -> ResourceError:
    """Say that the database can't be used."""
    return ResourceError(
        "The database of the service can't be used at the moment.",
        hint="Try again in a minute; whoever runs the service finds the reason in its log.",
        code="database-unreachable",
    )


def upgrade(settings: Settings) -> None:
    """Bring the database to this version's tables; safe to call from several processes at once.

    Raises:
        ResourceError: ``database-unreachable``, for whoever starts the service: it says why.
    """
    try:
        _upgrade(settings)
    except (OperationalError, psycopg.OperationalError) as error:
        reason = str(getattr(error, "orig", error)).strip().splitlines()[0]
        raise ResourceError(
            f"The database can't be used: {reason}.",
            hint="See that it runs, that GONIO_DATABASE_URL is right, and that its disk has room and can be written.",
            code="database-unreachable",
        ) from error


def _upgrade(settings: Settings) -> None:
    for library in ("dbos", "alembic"):  # they tell each of a hundred migrations
        logging.getLogger(library).setLevel(logging.WARNING)
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.resolved_database_url)
    try:
        with open_locks(settings).hold("migrations"):
            with as_file(files("gonio.jobs") / "migrations") as folder, database.write() as session:
                config = Config()
                config.set_main_option("script_location", str(folder))
                config.attributes["connection"] = session.connection()
                command.upgrade(config, "head")
            DBOS.migrate(settings.resolved_database_url)
    finally:
        database.close()


def _configure_sqlite(connection: Any, _: object) -> None:  # noqa: ANN401 - a DBAPI connection
    connection.isolation_level = None  # the driver would open transactions by rules of its own; see _begin_sqlite
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=30000", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: sa.Connection) -> None:
    connection.exec_driver_sql(f"BEGIN {connection.get_execution_options().get('begin', 'DEFERRED')}")
