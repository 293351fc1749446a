"""Sessions, files, jobs and reports."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Go forward."""
    op.create_table(
        "sessions",
        *_row("sessions"),
        sa.Column("kind", sa.String(32), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("subject", sa.JSON(), nullable=False),
    )
    op.create_table(
        "files",
        *_row("files"),
        *_session("files"),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("role", sa.String(32), nullable=False),
        sa.Column("camera", sa.String(), nullable=True),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("facts", sa.JSON(), nullable=False),
        sa.Column("key", sa.String(), nullable=False),
        sa.UniqueConstraint("session_id", "name", name="uq_files_session_id_name"),
    )
    op.create_table(
        "jobs",
        *_row("jobs"),
        *_session("jobs"),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("parameters", sa.JSON(), nullable=False),
        sa.Column("files", sa.JSON(), nullable=False),
        sa.Column("problem", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("stages", sa.JSON(), nullable=False),
        sa.Column("started_at", sa.DateTime(), nullable=True),
        sa.Column("ended_at", sa.DateTime(), nullable=True),
        sa.Column("takeovers", sa.Integer(), nullable=False),
        sa.Column("steps_at_takeover", sa.Integer(), nullable=False),
    )
    op.create_table("reports", *_row("reports"), *_session("reports"), sa.Column("files", sa.JSON(), nullable=False))
    for table in ("sessions", "jobs", "reports"):
        op.create_index(f"ix_{table}_lab_created_at", table, ["lab", "created_at"])
    op.create_index("ix_jobs_session_id_state", "jobs", ["session_id", "state"])


def downgrade() -> None:
    """Go back."""
    for table in ("reports", "jobs", "files", "sessions"):
        op.drop_table(table)


def _row(table: str) -> tuple[sa.Column[str] | sa.Column[object] | sa.Constraint, ...]:
    return (
        sa.Column("id", sa.String(36), nullable=False),
        sa.Column("lab", sa.String(64), nullable=False),
        sa.Column("created_at", sa.DateTime(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=f"pk_{table}"),
    )


def _session(table: str) -> tuple[sa.Column[str] | sa.Constraint, ...]:
    return (
        sa.Column("session_id", sa.String(36), nullable=False),
        sa.ForeignKeyConstraint(["session_id"], ["sessions.id"], name=f"fk_{table}_session_id", ondelete="CASCADE"),
    )
