"""Calibrations, and sessions and jobs that name one."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Go forward."""
    op.create_table(
        "calibrations",
        sa.Column("id", sa.String(36), nullable=False),
        sa.Column("lab", sa.String(64), nullable=False),
        sa.Column("created_at", sa.DateTime(), nullable=False),
        sa.Column("session_id", sa.String(36), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("level", sa.String(16), nullable=False),
        sa.Column("summary", sa.JSON(), nullable=False),
        sa.Column("files", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_calibrations"),
        sa.ForeignKeyConstraint(["session_id"], ["sessions.id"], name="fk_calibrations_session_id", ondelete="CASCADE"),
    )
    op.create_index("ix_calibrations_lab_created_at", "calibrations", ["lab", "created_at"])
    with op.batch_alter_table("sessions") as table:
        table.add_column(sa.Column("calibration_id", sa.String(36), nullable=True))
    with op.batch_alter_table("jobs") as table:
        table.add_column(sa.Column("calibration_id", sa.String(36), nullable=True))
        table.add_column(sa.Column("kind", sa.String(32), nullable=False, server_default="human_multicamera"))


def downgrade() -> None:
    """Go back."""
    with op.batch_alter_table("jobs") as table:
        table.drop_column("kind")
        table.drop_column("calibration_id")
    with op.batch_alter_table("sessions") as table:
        table.drop_column("calibration_id")
    op.drop_table("calibrations")
