"""All queries on gonio's tables, each filtered by the lab that asks. Nothing else in gonio writes a query."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple, TypeVar
from uuid import uuid4

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from gonio.errors import InputError
from gonio.jobs.tables import (
    ACTIVE,
    FINAL,
    TALLIES,
    CalibrationRow,
    DeliveryRow,
    ErasureRow,
    FileRow,
    JobRow,
    JobState,
    KeyRow,
    ReadingRow,
    ReportRow,
    Row,
    SessionRow,
    WebhookRow,
    now,
)

R = TypeVar("R", bound=Row)

_NOUNS: dict[type[Row], str] = {
    SessionRow: "session",
    FileRow: "file",
    JobRow: "job",
    ReportRow: "report",
    CalibrationRow: "calibration",
    KeyRow: "key",
    WebhookRow: "webhook",
}


class Place(NamedTuple):
    """Where a page of a list begins: after the row with this time and id, the list being newest first."""

    created_at: datetime
    id: str


class Repository:
    """What one lab can see and change, within one database session."""

    def __init__(self, session: Session, lab: str) -> None:
        self._db = session
        self._lab = lab

    def add(self, row: Row) -> None:
        """Add a row; its lab becomes the asking one."""
        row.lab = self._lab
        self._db.add(row)
        self._db.flush()

    def session(self, session_id: str) -> SessionRow:
        """Give a session, or raise ``not-found``."""
        return self._one(SessionRow, SessionRow.id == session_id)

    def sessions(self, limit: int, after: Place | None = None, subject: str | None = None) -> Sequence[SessionRow]:
        """List sessions, newest first; all, or those of the subject with a code."""
        conditions = () if subject is None else (SessionRow.subject["code"].as_string() == subject,)
        return self._page(SessionRow, limit, after, *conditions)

    def files(self, session_id: str) -> Sequence[FileRow]:
        """List the files of a session by name."""
        query = self._select(FileRow).where(FileRow.session_id == session_id).order_by(FileRow.name)
        return self._db.scalars(query).all()

    def file(self, session_id: str, file_id: str) -> FileRow:
        """Give a file of a session, or raise ``not-found``."""
        return self._one(FileRow, FileRow.session_id == session_id, FileRow.id == file_id)

    def find_file(self, file_id: str) -> FileRow | None:
        """Give a file if there is one."""
        return self._db.scalar(self._select(FileRow).where(FileRow.id == file_id))

    def file_named(self, session_id: str, name: str) -> FileRow | None:
        """Give the file of a session that has this name, if there is one."""
        return self._db.scalar(self._select(FileRow).where(FileRow.session_id == session_id, FileRow.name == name))

    def count_file_bytes(self) -> int:
        """Tell how much all files of the lab hold."""
        return self._db.scalar(sa.select(sa.func.sum(FileRow.size)).where(FileRow.lab == self._lab)) or 0

    def count_frames(self, session_id: str) -> int:
        """Tell how many frames all videos of a session have."""
        return sum(int(file.facts.get("frames") or 0) for file in self.files(session_id))

    def job(self, job_id: str) -> JobRow:
        """Give a job, or raise ``not-found``."""
        return self._one(JobRow, JobRow.id == job_id)

    def find_job(self, job_id: str) -> JobRow | None:
        """Give a job if there is one."""
        return self._db.scalar(self._select(JobRow).where(JobRow.id == job_id))

    def find_same_job(self, session_id: str, fingerprint: str) -> JobRow | None:
        """Give the newest job that computes or computed the same from the same, if there is one that didn't fail."""
        wanted = (JobRow.session_id == session_id, JobRow.fingerprint == fingerprint)
        useful = JobRow.state.in_([*ACTIVE, JobState.SUCCEEDED])
        query = self._select(JobRow).where(*wanted, useful).order_by(JobRow.created_at.desc()).limit(1)
        return self._db.scalar(query)

    def jobs(self, limit: int, after: Place | None = None, session_id: str | None = None) -> Sequence[JobRow]:
        """List jobs, newest first; of one session if it is named."""
        return self._page(JobRow, limit, after, *([JobRow.session_id == session_id] if session_id else []))

    def active_jobs(self, session_id: str) -> Sequence[JobRow]:
        """List the jobs that haven't ended and read a session's files, or a calibration that it gave."""
        made_here = sa.select(CalibrationRow.id).where(CalibrationRow.session_id == session_id)
        reads = sa.or_(JobRow.session_id == session_id, JobRow.calibration_id.in_(made_here))
        return self._db.scalars(self._select(JobRow).where(reads, JobRow.state.in_(ACTIVE))).all()

    def jobs_of(self, session_id: str) -> Sequence[JobRow]:
        """List all jobs of a session."""
        return self._db.scalars(self._select(JobRow).where(JobRow.session_id == session_id)).all()

    def report(self, report_id: str) -> ReportRow:
        """Give a report, or raise ``not-found``."""
        return self._one(ReportRow, ReportRow.id == report_id)

    def reports(self, limit: int, after: Place | None = None) -> Sequence[ReportRow]:
        """List reports, newest first."""
        return self._page(ReportRow, limit, after)

    def calibration(self, calibration_id: str) -> CalibrationRow:
        """Give a calibration, or raise ``not-found``."""
        return self._one(CalibrationRow, CalibrationRow.id == calibration_id)

    def calibrations(self, limit: int, after: Place | None = None) -> Sequence[CalibrationRow]:
        """List calibrations, newest first."""
        return self._page(CalibrationRow, limit, after)

    def key(self, key_id: str) -> KeyRow:
        """Give a key, or raise ``not-found``."""
        return self._one(KeyRow, KeyRow.id == key_id)

    def keys(self) -> Sequence[KeyRow]:
        """List keys, newest first."""
        return self._db.scalars(self._select(KeyRow).order_by(KeyRow.created_at.desc(), KeyRow.id)).all()

    def readings(self, session_id: str | None, limit: int, after: Place | None = None) -> Sequence[ReadingRow]:
        """List who read what, newest first; of one session if it is named."""
        return self._page(ReadingRow, limit, after, *([ReadingRow.session_id == session_id] if session_id else []))

    def erasures(self, limit: int, after: Place | None = None) -> Sequence[ErasureRow]:
        """List deletions of sessions, newest first."""
        return self._page(ErasureRow, limit, after)

    def webhook(self, webhook_id: str) -> WebhookRow:
        """Give a webhook, or raise ``not-found``."""
        return self._one(WebhookRow, WebhookRow.id == webhook_id)

    def webhooks(self) -> Sequence[WebhookRow]:
        """List webhooks, newest first."""
        return self._db.scalars(self._select(WebhookRow).order_by(WebhookRow.created_at.desc(), WebhookRow.id)).all()

    def deliveries(self, webhook_id: str, limit: int) -> Sequence[DeliveryRow]:
        """List the newest messages to a webhook."""
        return self._page(DeliveryRow, limit, None, DeliveryRow.webhook_id == webhook_id)

    def delete(self, row: Row) -> None:
        """Delete a row and, with a session, all that belongs to it."""
        self._db.delete(row)
        self._db.flush()

    def change_job(
        self,
        job_id: str,
        expected: Sequence[JobState],
        *,
        of_generation: int | None = None,
        **values: Any,  # noqa: ANN401 - columns
    ) -> bool:
        """Change a job if it is in an expected state, and tell whether it was: the guard of every transition.

        An ``of_generation`` that is not the job's present one changes nothing either: it comes from a worker that lost the job.
        """
        query = sa.update(JobRow).where(JobRow.lab == self._lab, JobRow.id == job_id, JobRow.state.in_(expected))
        if of_generation is not None:
            query = query.where(JobRow.generation == of_generation)
        session_id = self._db.scalars(query.values(**values).returning(JobRow.session_id)).first()
        if session_id is not None and values.get("state") in FINAL:
            self._announce({"job": job_id, "session": session_id, "state": values["state"]})
        return session_id is not None

    def _announce(self, job: dict[str, Any]) -> None:
        """Have the lab's webhooks told that a job has ended, in the transaction that ends it."""
        for webhook in self.webhooks():
            self.add(DeliveryRow(id=str(uuid4()), webhook_id=webhook.id, content={"event": "job-ended", **job}))

    def lose_job(self, job_id: str, takeovers: int, steps: int) -> None:
        """Note that a worker died over a job: from now on, what may still come from it is refused."""
        values = {"takeovers": takeovers, "steps_at_takeover": steps, "generation": JobRow.generation + 1}
        self._db.execute(sa.update(JobRow).where(JobRow.lab == self._lab, JobRow.id == job_id).values(values))

    def count_active_jobs(self) -> int:
        """Tell how many jobs wait or are being computed."""
        query = sa.select(sa.func.count()).where(JobRow.lab == self._lab, JobRow.state.in_(ACTIVE))
        return self._db.scalar(query) or 0

    def _select(self, kind: type[R]) -> sa.Select[R]:
        return sa.select(kind).where(kind.lab == self._lab)

    def _one(self, kind: type[R], *where: sa.ColumnElement[bool]) -> R:
        row = self._db.scalar(self._select(kind).where(*where))
        if row is None:
            noun = _NOUNS[kind]
            raise InputError(
                f"There is no such {noun}.", hint=f"Check its id; GET the list of {noun}s.", code="not-found"
            )
        return row

    def _page(self, kind: type[R], limit: int, after: Place | None, *where: sa.ColumnElement[bool]) -> Sequence[R]:
        query = self._select(kind).where(*where).order_by(kind.created_at.desc(), kind.id.desc()).limit(limit)
        if after is not None:
            query = query.where(sa.tuple_(kind.created_at, kind.id) < sa.tuple_(after.created_at, after.id))
        return self._db.scalars(query).all()


def active_jobs_of_all_labs(session: Session) -> Sequence[JobRow]:
    """List the jobs that haven't ended: for workers, which serve every lab."""
    return session.scalars(sa.select(JobRow).where(JobRow.state.in_(ACTIVE))).all()


def active_job_of_any_lab(session: Session, job_id: str) -> JobRow | None:
    """Give a job if it hasn't ended: for workers."""
    return session.scalar(sa.select(JobRow).where(JobRow.id == job_id, JobRow.state.in_(ACTIVE)))


def key_of_any_lab(session: Session, digest: str) -> KeyRow | None:
    """Give the key that has this digest, if it is valid now: it is what tells which lab asks."""
    valid = sa.or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > now())
    return session.scalar(sa.select(KeyRow).where(KeyRow.digest == digest, valid))


def any_key(session: Session) -> bool:
    """Tell whether a key was ever made; one that is over counts too, or its end would open the door."""
    return session.scalar(sa.select(sa.exists(KeyRow.id))) or False


def add_to_tallies(session: Session, added: Mapping[str, float]) -> None:
    """Count something in several tallies: one more each, and an amount."""
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    for name, amount in sorted(
        added.items()
    ):  # sorted: two transactions that lock the same rows never wait in a circle
        query = insert(TALLIES).values(name=name, count=1, total=amount)
        more = {"count": TALLIES.c["count"] + 1, "total": TALLIES.c.total + amount}
        session.execute(query.on_conflict_do_update(index_elements=[TALLIES.c.name], set_=more))


def tallies(session: Session) -> Mapping[str, tuple[int, float]]:
    """Give all tallies by name: how often, and how much."""
    rows = session.execute(sa.select(TALLIES.c.name, TALLIES.c["count"], TALLIES.c.total))
    return {name: (count, total) for name, count, total in rows}


def count_jobs_of_all_labs(session: Session) -> Mapping[str, int]:
    """Count the jobs in each state."""
    return dict(session.execute(sa.select(JobRow.state, sa.func.count()).group_by(JobRow.state)).all())


def oldest_queued_job_of_all_labs(session: Session) -> datetime | None:
    """Tell when the oldest job was created that waits."""
    return session.scalar(sa.select(sa.func.min(JobRow.created_at)).where(JobRow.state == JobState.TODO))


def sessions_of_all_labs_untouched_since(session: Session, time: datetime) -> Sequence[SessionRow]:
    """List the sessions that were made, and whose files and jobs all came, before a time; for retention."""
    younger = [
        sa.exists().where(kind.session_id == SessionRow.id, kind.created_at >= time) for kind in (FileRow, JobRow)
    ]
    return session.scalars(
        sa.select(SessionRow).where(SessionRow.created_at < time, *(~each for each in younger))
    ).all()


def claim_deliveries_of_all_labs(
    session: Session, time: datetime, until: datetime, limit: int
) -> Sequence[tuple[DeliveryRow, WebhookRow]]:
    """Take the messages that are due; nobody else gets them before ``until``."""
    due = sa.select(DeliveryRow.id).where(DeliveryRow.due_at <= time).order_by(DeliveryRow.due_at).limit(limit)
    mine = sa.update(DeliveryRow).where(DeliveryRow.id.in_(due), DeliveryRow.due_at <= time).values(due_at=until)
    ids = session.scalars(mine.returning(DeliveryRow.id)).all()
    query = sa.select(DeliveryRow, WebhookRow).join(WebhookRow, WebhookRow.id == DeliveryRow.webhook_id)
    return list(session.execute(query.where(DeliveryRow.id.in_(ids))))


def erasures_of_all_labs_to_do(session: Session) -> Sequence[ErasureRow]:
    """List the deletions that aren't known to be complete, oldest first."""
    return session.scalars(
        sa.select(ErasureRow).where(ErasureRow.done_at.is_(None)).order_by(ErasureRow.created_at)
    ).all()
