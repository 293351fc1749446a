"""The database: one for gonio's own tables and for DBOS's, so that a job and its queue entry are one transaction."""

import logging
from collections.abc import Generator
from contextlib import contextmanager
from importlib.resources import as_file, files
from typing import Any

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from dbos import DBOS
from sqlalchemy import event
from sqlalchemy.orm import Session

from gonio.errors import InputError
from gonio.jobs.liveness import Locks
from gonio.settings import Settings


class Database:
    """An SQLAlchemy engine whose transactions say beforehand whether they will write."""

    def __init__(self, url: str) -> None:
        if not url.startswith("sqlite:"):
            raise InputError(
                f"The database {sa.make_url(url).render_as_string()} is of a kind that isn't supported.",
                hint="Leave GONIO_DATABASE_URL unset, or give it a sqlite:/// URL.",
                code="database-unsupported",
            )
        self.engine = sa.create_engine(url)
        event.listen(self.engine, "connect", _configure_sqlite)
        event.listen(self.engine, "begin", _begin_sqlite)
        self._writing = self.engine.execution_options(begin="IMMEDIATE")

    @contextmanager
    def read(self) -> Generator[Session]:
        """Give a session that only reads: it waits for nobody."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def write(self) -> Generator[Session]:
        """Give a session that is committed when the block ends without an error.

        It takes SQLite's write lock at its beginning: what it reads stays true until it commits, and two writers wait
        for each other instead of failing.
        """
        with Session(self._writing, expire_on_commit=False) as session, session.begin():
            yield session

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def upgrade(settings: Settings) -> None:
    """Bring the database to this version's tables; safe to call from several processes at once."""
    for library in ("dbos", "alembic"):  # they tell each of a hundred migrations
        logging.getLogger(library).setLevel(logging.WARNING)
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.resolved_database_url)
    try:
        with Locks(settings.data_dir / "locks").hold("migrations"):
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
