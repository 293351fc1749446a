"""gonio's own tables. Every row belongs to a lab; ``gonio.jobs.repository`` holds all queries, and filters by it."""

from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, Column, Float, ForeignKey, Index, MetaData, String, Table, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

METADATA = MetaData(
    naming_convention={  # SQLite can only change a constraint that has a name
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)


class JobState(StrEnum):
    """The states of a job; the last three are final."""

    TODO = "todo"  # in the queue
    DOING = "doing"  # a worker computes it, or will again after a crash
    SUCCEEDED = "succeeded"  # its report is there
    FAILED = "failed"  # its problem says why
    CANCELLED = "cancelled"  # on request


ACTIVE = (JobState.TODO, JobState.DOING)
FINAL = (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)


def now() -> datetime:
    """Give the time as the tables keep it: UTC without saying so, since SQLite has no zones."""
    return datetime.now(UTC).replace(tzinfo=None)


class Row(DeclarativeBase):
    """What all rows have: an id that is also their name over HTTP, a lab that owns them, and a time."""

    metadata = METADATA
    type_annotation_map = {dict[str, Any]: JSON, list[dict[str, Any]]: JSON, list[str]: JSON}  # noqa: RUF012 - SQLAlchemy's protocol

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    lab: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(default=now)


class SessionRow(Row):
    """A session: one person filmed once, or a board filmed to calibrate the cameras."""

    __tablename__ = "sessions"
    __table_args__ = (Index(None, "lab", "created_at"),)

    kind: Mapped[str] = mapped_column(String(32))
    name: Mapped[str]
    subject: Mapped[dict[str, Any]]
    calibration_id: Mapped[str | None] = mapped_column(String(36))  # what its analyses use if they name no other


class FileRow(Row):
    """An accepted file. Its content is in the store, whole, under ``key`` before this row exists."""

    __tablename__ = "files"
    __table_args__ = (UniqueConstraint("session_id", "name"),)

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"))
    name: Mapped[str]
    role: Mapped[str] = mapped_column(String(32))
    camera: Mapped[str | None]
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    facts: Mapped[dict[str, Any]]  # what the probe saw: frames, rate, cameras, ...
    key: Mapped[str]


class JobRow(Row):
    """An analysis of a session. The queue entry in DBOS has the same id and was written in the same transaction."""

    __tablename__ = "jobs"
    __table_args__ = (Index(None, "lab", "created_at"), Index(None, "session_id", "state"))

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(32), server_default="human_multicamera")  # its session's
    calibration_id: Mapped[str | None] = mapped_column(String(36))  # may not be deleted while the job runs
    state: Mapped[str] = mapped_column(String(16))
    parameters: Mapped[dict[str, Any]]
    files: Mapped[
        list[dict[str, Any]]
    ]  # the session's files when the analysis was asked for: name, role, camera, key, sha256
    problem: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    stages: Mapped[list[dict[str, Any]]] = mapped_column(default=list)  # name and seconds of each finished stage
    started_at: Mapped[datetime | None]
    ended_at: Mapped[datetime | None]
    takeovers: Mapped[int] = mapped_column(default=0)  # how often a worker died over it since it last got on
    steps_at_takeover: Mapped[int] = mapped_column(default=0)
    fingerprint: Mapped[str | None] = mapped_column(String(64))  # of all that its result depends on
    generation: Mapped[int] = mapped_column(default=0, server_default="0")  # one more with each worker that lost it


class CalibrationRow(Row):
    """A calibrated rig: the result of a calibration's job, whose id it shares."""

    __tablename__ = "calibrations"
    __table_args__ = (Index(None, "lab", "created_at"),)

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"))
    name: Mapped[str]
    level: Mapped[str] = mapped_column(String(16))  # the verdict
    summary: Mapped[dict[str, Any]]  # cameras, lab, findings: what a list shows without opening the document
    files: Mapped[list[dict[str, Any]]]  # as a report's


class KeyRow(Row):
    """A lab's key to the service. The key itself is kept nowhere, only its digest."""

    __tablename__ = "api_keys"
    __table_args__ = (UniqueConstraint("digest"), Index(None, "lab", "created_at"))

    name: Mapped[str]  # for people: who or what has it
    digest: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[str]]
    expires_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]


class ReadingRow(Row):
    """Who looked at what of a subject, and when. It outlives the session: it holds ids only."""

    __tablename__ = "readings"
    __table_args__ = (Index(None, "lab", "created_at"), Index(None, "session_id"))

    key_id: Mapped[str | None] = mapped_column(String(36))  # None: without a key, on the service's own machine
    session_id: Mapped[str | None] = mapped_column(String(36))  # None: the list of sessions
    what: Mapped[str]


class ErasureRow(Row):
    """The deletion of a session: written with the deletion of its rows, done when nothing else is left of it either."""

    __tablename__ = "erasures"
    __table_args__ = (Index(None, "lab", "created_at"), Index(None, "done_at"))

    session_id: Mapped[str] = mapped_column(String(36))
    jobs: Mapped[list[str]]
    done_at: Mapped[datetime | None]


class WebhookRow(Row):
    """An address of a lab's that hears when its jobs end."""

    __tablename__ = "webhooks"
    __table_args__ = (Index(None, "lab", "created_at"),)

    url: Mapped[str]
    secret: Mapped[str]  # signs; so it can't be kept as a digest


class DeliveryRow(Row):
    """A message to a webhook: on its way while ``due_at`` is set."""

    __tablename__ = "deliveries"
    __table_args__ = (Index(None, "due_at"), Index(None, "webhook_id", "created_at"))

    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    content: Mapped[dict[str, Any]]
    attempts: Mapped[int] = mapped_column(default=0)
    due_at: Mapped[datetime | None] = mapped_column(default=now)
    delivered_at: Mapped[datetime | None]
    answer: Mapped[str] = mapped_column(default="")  # the status of the last answer, or why there was none


TALLIES = Table(
    "tallies",
    METADATA,
    Column("name", String(100), primary_key=True),
    Column("count", BigInteger, nullable=False),
    Column("total", Float, nullable=False),
)
"""Numbers that only grow, over all labs: they outlive what they counted, and tell nothing of anybody."""


class ReportRow(Row):
    """The result of a job, whose id it shares: there can't be two."""

    __tablename__ = "reports"
    __table_args__ = (Index(None, "lab", "created_at"),)

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"))
    files: Mapped[list[dict[str, Any]]]  # name, key, size, sha256, and whether it is the document or the page
