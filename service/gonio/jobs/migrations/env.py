"""Alembic's environment: ``gonio.jobs.database.upgrade`` calls it with a connection, holding the lock."""

from typing import Any

import sqlalchemy as sa
from alembic import context

from gonio.jobs.tables import METADATA


def _is_ours(_: Any, name: str | None, kind: str, *rest: Any) -> bool:  # noqa: ANN401 - Alembic's protocol
    """Leave alone what DBOS keeps in the same database."""
    return kind != "table" or name in METADATA.tables


connection: sa.Connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=METADATA,
    render_as_batch=connection.dialect.name == "sqlite",  # SQLite can't alter a column: Alembic copies the table
    include_object=_is_ours,
)
with context.begin_transaction():
    context.run_migrations()
