"""What the service can do, for http to call: sessions, files, analyses, jobs and reports of one lab."""

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid4, uuid5

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from gonio.errors import CaptureError, InputError, ResourceError
from gonio.jobs.access import Access
from gonio.jobs.database import Database
from gonio.jobs.demand import as_file, fingerprint_of, refuse_when_full, refuse_when_incomplete, same_job
from gonio.jobs.filenames import check_role, guess_role
from gonio.jobs.partial import PartialUploads, Upload, Whole
from gonio.jobs.probe import Probe
from gonio.jobs.queue import Queue
from gonio.jobs.repository import (
    Place,
    Repository,
    count_jobs_of_all_labs,
    erasures_of_all_labs_to_do,
    oldest_queued_job_of_all_labs,
    sessions_of_all_labs_untouched_since,
    tallies,
)
from gonio.jobs.spool import Incoming, Spool
from gonio.jobs.store import Store
from gonio.jobs.tables import ACTIVE, CalibrationRow, ErasureRow, FileRow, JobRow, JobState, ReportRow, SessionRow, now
from gonio.jobs.webhooks import Webhooks
from gonio.jobs.workflow import session_prefix
from gonio.pipeline.run import Role
from gonio.settings import Settings

SETTLED = timedelta(minutes=1)
"""After so long, no worker computes a job any more that has ended."""


@dataclass(frozen=True)
class JobView:
    """A job and, while it is being computed, what its worker last said of it."""

    row: JobRow
    progress: Mapping[str, Any] | None


@dataclass(frozen=True)
class Statistics:
    """What happens in the service: ``stages`` holds, by name, how many were finished and their seconds in all."""

    jobs: Mapping[str, int]
    oldest_s: float
    stages: Mapping[str, tuple[int, float]]
    takeovers: int
    frames: int


class Service:
    """All use cases. Each takes the lab that asks, and sees and changes nothing of any other lab.

    The process that owns it computes nothing: it writes a job's row and queue entry, and a worker does the rest.
    """

    def __init__(self, settings: Settings, probe: Probe) -> None:
        self.spool = Spool(
            settings.data_dir / "spool", limit=settings.max_upload_bytes, free_disk_floor=settings.free_disk_floor
        )
        self.uploads = PartialUploads(settings.data_dir / "uploads", self.spool, settings.upload_hours * 3600)
        self._quota_bytes = settings.lab_quota_bytes
        self._jobs_per_lab = settings.jobs_per_lab
        self.sweep()
        self._probe = probe
        self._database = Database(settings.resolved_database_url)
        self.access = Access(self._database)
        self.webhooks = Webhooks(self._database, allow_private=settings.private_webhooks)
        self._store = Store.open(settings.resolved_objects_url)
        self._queue = Queue(settings.resolved_database_url)

    def close(self) -> None:
        """Close all connections."""
        self._queue.close()
        self._database.close()

    def check(self) -> None:
        """Raise an error if the database can't be read or the disk is full."""
        with self._database.read() as session:
            session.execute(sa.text("SELECT 1"))
        self.spool.check_room(0)

    def sweep(self) -> None:
        """Remove uploads whose sender or server is gone for good."""
        self.spool.sweep()
        self.uploads.sweep()

    def delete_what_is_over(self, retention: timedelta) -> int:
        """Delete the sessions on which nobody worked for so long, and tell how many; those that are busy wait."""
        with self._database.read() as session:
            over = [(row.lab, row.id) for row in sessions_of_all_labs_untouched_since(session, now() - retention)]
        count = 0
        for lab, session_id in over:
            with suppress(CaptureError, InputError):
                self.delete_session(lab, session_id)
                count += 1
        return count

    def statistics(self) -> Statistics:
        """Count what happens, over all labs."""
        with self._database.read() as session:
            jobs, oldest, sums = (
                count_jobs_of_all_labs(session), oldest_queued_job_of_all_labs(session), tallies(session)
            )  # fmt: skip
        return Statistics(
            jobs={state.value: jobs.get(state, 0) for state in JobState},
            oldest_s=(now() - oldest).total_seconds() if oldest else 0.0,
            stages={name.removeprefix("stage "): each for name, each in sums.items() if name.startswith("stage ")},
            takeovers=sums.get("takeovers", (0, 0.0))[0],
            frames=round(sums.get("frames", (0, 0.0))[1]),
        )

    def create_session(
        self, lab: str, *, kind: str, name: str, subject: dict[str, Any], calibration_id: str | None = None
    ) -> SessionRow:
        """Create a session; ``calibration_id`` names the calibration of its cameras, where there is one already."""
        row = SessionRow(id=str(uuid4()), kind=kind, name=name, subject=subject, calibration_id=calibration_id)
        with self._repository(lab) as repository:
            if calibration_id is not None:
                repository.calibration(calibration_id)
            repository.add(row)
        return row

    def session(self, lab: str, session_id: str) -> SessionRow:
        """Give a session."""
        with self._reading(lab) as repository:
            return repository.session(session_id)

    def sessions(
        self, lab: str, limit: int, after: Place | None = None, subject: str | None = None
    ) -> Sequence[SessionRow]:
        """List sessions, newest first; all, or those of the subject with a code."""
        with self._reading(lab) as repository:
            return repository.sessions(limit, after, subject)

    def delete_session(self, lab: str, session_id: str) -> None:
        """Delete a session with its files, jobs and reports or calibrations, and everything that was computed from it.

        What stays is that it was deleted, and who read it: ids only.

        Raises:
            CaptureError: ``session-busy`` while an analysis runs that reads it, or a calibration that it gave.
        """
        with self._repository(lab) as repository:
            row = repository.session(session_id)
            _refuse_when_busy(repository, session_id)
            jobs = [job.id for job in repository.jobs_of(session_id)]
            erasure = ErasureRow(id=str(uuid4()), session_id=session_id, jobs=jobs)
            repository.add(erasure)
            repository.delete(row)
        # Should this process be killed here, or the store be out of reach, `erase_again` goes on with it.
        with suppress(ResourceError):
            self._erase(erasure)

    def erase_again(self) -> None:
        """Go on with deletions until nothing is left, and note when.

        A worker may have stored something after the first time: its job was cancelled just before, and it hadn't heard.
        """
        with self._database.read() as session:
            erasures = erasures_of_all_labs_to_do(session)
        settled = [erasure for erasure in erasures if erasure.created_at < now() - SETTLED]
        for erasure in erasures:
            self._erase(erasure)
        if settled:
            self._database.scrub()
        for erasure in settled:
            with self._database.write(erasure.lab) as session:
                session.merge(erasure).done_at = now()

    def erasures(self, lab: str, limit: int, after: Place | None = None) -> Sequence[ErasureRow]:
        """List deletions of sessions, newest first."""
        with self._reading(lab) as repository:
            return repository.erasures(limit, after)

    def _erase(self, erasure: ErasureRow) -> None:
        self._queue.forget(erasure.jobs)
        self.uploads.delete_of_session(erasure.session_id)
        self._store.delete(session_prefix(erasure.lab, erasure.session_id))

    def begin_upload(
        self, lab: str, session_id: str, name: str, role: Role | None, camera: str | None, length: int
    ) -> Upload:
        """Begin an upload that can be gone on with after a cut; what can be known to be wrong is refused now.

        Raises:
            InputError: ``not-found``, ``role-unknown``, ``role-wrong``, ``camera-missing`` or ``file-too-large``.
            ResourceError: ``quota-exceeded`` or ``disk-full``.
        """
        with self._reading(lab) as repository:
            kind = repository.session(session_id).kind
            check_role(role or guess_role(name, kind), name, kind, camera)
            self._check_quota(repository, length + self.uploads.announced(lab) if self._quota_bytes else 0)
        return self.uploads.create(lab, session_id, name, role, camera, length)

    def finish_upload(self, lab: str, upload: Upload) -> Upload:
        """Accept the file of a locked upload that is whole; if it is refused, the upload is removed, as a form's is.

        A server may be killed in the middle of it. The file then has the upload's id, if it was accepted at all.
        """
        if upload.file_id:
            return upload
        with self._reading(lab) as repository:
            accepted = repository.find_file(upload.id)
        if accepted is not None:
            return self.uploads.end(upload, accepted.id)
        if self.uploads.offset(upload) < upload.length:
            return upload
        whole = self.uploads.whole(upload)
        try:
            row, _ = self.accept_file(lab, upload.session_id, whole, upload.role, upload.camera, upload.id)
        except (InputError, CaptureError):
            self.uploads.delete(upload)
            raise
        return self.uploads.end(upload, row.id)

    def accept_file(
        self,
        lab: str,
        session_id: str,
        incoming: Incoming | Whole,
        role: Role | None,
        camera: str | None,
        file_id: str | None = None,
    ) -> tuple[FileRow, bool]:
        """Accept a file that was received whole, and tell whether it is new: the same file twice is one file.

        A new one gets the ``file_id``, or an id of its own.

        Raises:
            InputError: Its content can't be read (the probe's code), ``file-exists`` with other content, ``role-unknown``,
                ``role-wrong`` or ``camera-missing``.
        """
        with self._reading(lab) as repository:
            kind = repository.session(session_id).kind
            role = role or guess_role(incoming.name, kind)
            check_role(role, incoming.name, kind, camera)
            known = repository.file_named(session_id, incoming.name)
            if known is not None:
                return _same_file(known, incoming, role, camera), False
            self._check_quota(repository, incoming.size)
        facts = self._probe(incoming.path, role)
        file_id = file_id or str(uuid4())
        row = FileRow(
            id=file_id,
            session_id=session_id,
            name=incoming.name,
            role=role,
            camera=camera,
            size=incoming.size,
            sha256=incoming.sha256,
            facts=facts,
            key=f"{session_prefix(lab, session_id)}/files/{file_id}",
        )
        # The content first: a row without its content would be a promise broken, a content without its row is nothing.
        self._store.take_file(row.key, incoming.path)
        try:
            with self._repository(lab) as repository:
                repository.session(session_id)
                repository.add(row)
        except IntegrityError:  # the same name came in twice at once, and the other one was first
            self._store.delete(row.key)
            with self._reading(lab) as repository:
                known = repository.file_named(session_id, incoming.name)
            if known is None:
                raise
            return _same_file(known, incoming, role, camera), False
        except InputError:  # the session was deleted meanwhile
            self._store.delete(row.key)
            raise
        return row, True

    def files(self, lab: str, session_id: str) -> Sequence[FileRow]:
        """List the files of a session."""
        with self._reading(lab) as repository:
            repository.session(session_id)
            return repository.files(session_id)

    def file(self, lab: str, session_id: str, file_id: str) -> FileRow:
        """Give a file."""
        with self._reading(lab) as repository:
            return repository.file(session_id, file_id)

    def delete_file(self, lab: str, session_id: str, file_id: str) -> None:
        """Delete a file.

        Raises:
            CaptureError: ``session-busy`` while an analysis of the session runs.
        """
        with self._repository(lab) as repository:
            row = repository.file(session_id, file_id)
            _refuse_when_busy(repository, session_id)
            repository.delete(row)
        self._store.delete(row.key)

    def enqueue(
        self,
        lab: str,
        session_id: str,
        parameters: dict[str, Any],
        idempotency_key: str | None = None,
        calibration_id: str | None = None,
    ) -> tuple[JobRow, bool]:
        """Queue an analysis of a session's present files, and tell whether it is new.

        A key gives one job for ever. Without one, the same analysis of the same files is not computed twice: a job that
        waits, runs or succeeded is given again.

        ``calibration_id`` names the calibration to use, in place of the session's own; in a session of kind
        ``calibration`` it is the one to check.

        Raises:
            CaptureError: ``calibration-missing``, ``too-few-videos`` or ``too-few-cameras``.
            InputError: ``too-many-jobs``; ``idempotency-key-reused`` if the key's job was another one;
                ``calibration-ambiguous``.
        """
        job_id = str(uuid4()) if idempotency_key is None else str(uuid5(NAMESPACE_URL, f"{lab}/{idempotency_key}"))
        with self._database.write(lab) as session:
            repository = Repository(session, lab)
            owner = repository.session(session_id)
            calibration_id = calibration_id or owner.calibration_id
            wanted = parameters
            if owner.kind != "calibration":
                # The code is the lab's affair: nothing is computed from it, and no report has it.
                person = {name: value for name, value in owner.subject.items() if name != "code"}
                wanted = {**parameters, "subject": {**person, **parameters.get("subject", {})}}
            known = repository.find_job(job_id)
            if known is not None:
                return same_job(known, session_id, wanted, calibration_id), False
            files = [
                {"name": f.name, "role": f.role, "camera": f.camera, "key": f.key, "sha256": f.sha256}
                for f in repository.files(session_id)
            ]
            if calibration_id is not None:
                files.append(as_file(repository.calibration(calibration_id), owner.kind))
            refuse_when_incomplete(files, owner.kind)
            fingerprint = fingerprint_of(owner.kind, files, wanted)
            if idempotency_key is None:
                known = repository.find_same_job(session_id, fingerprint)
                if known is not None:
                    return known, False
            active = repository.count_active_jobs()
            refuse_when_full(active, self._jobs_per_lab)
            row = JobRow(
                id=job_id,
                session_id=session_id,
                kind=owner.kind,
                calibration_id=calibration_id,
                state=JobState.TODO,
                parameters=wanted,
                files=files,
                fingerprint=fingerprint,
            )
            repository.add(row)
            self._queue.add(session, lab, job_id, active + 1)
        return row, True

    def job(self, lab: str, job_id: str) -> JobView:
        """Give a job with its progress."""
        with self._reading(lab) as repository:
            return self._view(repository.job(job_id))

    def jobs(
        self, lab: str, limit: int, after: Place | None = None, session_id: str | None = None
    ) -> Sequence[JobView]:
        """List jobs, newest first; of one session if it is named."""
        with self._reading(lab) as repository:
            return [self._view(row) for row in repository.jobs(limit, after, session_id)]

    def cancel(self, lab: str, job_id: str) -> JobView:
        """Cancel a job; one that has ended stays as it is."""
        with self._repository(lab) as repository:
            repository.job(job_id)
            cancelled = repository.change_job(job_id, ACTIVE, state=JobState.CANCELLED, ended_at=now())
        if cancelled:  # after the row: if this process dies in between, the worker sees that the job has ended
            self._queue.cancel(job_id)
        return self.job(lab, job_id)

    def report(self, lab: str, report_id: str) -> ReportRow:
        """Give a report."""
        with self._reading(lab) as repository:
            return repository.report(report_id)

    def reports(self, lab: str, limit: int, after: Place | None = None) -> Sequence[ReportRow]:
        """List reports, newest first."""
        with self._reading(lab) as repository:
            return repository.reports(limit, after)

    def calibration(self, lab: str, calibration_id: str) -> CalibrationRow:
        """Give a calibration."""
        with self._reading(lab) as repository:
            return repository.calibration(calibration_id)

    def calibrations(self, lab: str, limit: int, after: Place | None = None) -> Sequence[CalibrationRow]:
        """List calibrations, newest first."""
        with self._reading(lab) as repository:
            return repository.calibrations(limit, after)

    @contextmanager
    def content(self, key: str) -> Generator[Path]:
        """Give a local file with the content of a file or report, for as long as the block lasts."""
        with self._store.local_path(key) as path:
            yield path

    def _check_quota(self, repository: Repository, size: int) -> None:
        if self._quota_bytes and repository.count_file_bytes() + size > self._quota_bytes:
            raise ResourceError(
                f"The lab may keep {self._quota_bytes} bytes of files, and with this one it would keep more.",
                hint="Delete sessions that are no longer needed, or ask for more room (GONIO_LAB_QUOTA_BYTES).",
                code="quota-exceeded",
            )

    def _view(self, row: JobRow) -> JobView:
        progress = self._queue.progress(row.id) if row.state == JobState.DOING else None
        return JobView(row, progress)

    @contextmanager
    def _reading(self, lab: str) -> Generator[Repository]:
        with self._database.read() as session:
            yield Repository(session, lab)

    @contextmanager
    def _repository(self, lab: str) -> Generator[Repository]:
        with self._database.write(lab) as session:
            yield Repository(session, lab)


def _same_file(known: FileRow, incoming: Incoming | Whole, role: Role, camera: str | None) -> FileRow:
    if (known.sha256, known.role, known.camera) == (incoming.sha256, role, camera):
        return known
    raise InputError(
        f"The session already has another file {known.name}.",
        hint="DELETE it first, or upload this one under another name.",
        code="file-exists",
        file=known.id,
    )


def _refuse_when_busy(repository: Repository, session_id: str) -> None:
    jobs = repository.active_jobs(session_id)
    if jobs:
        raise CaptureError(
            "An analysis that reads this session is waiting or running.",
            hint="Wait for its end, or cancel it first.",
            code="session-busy",
            jobs=[job.id for job in jobs],
        )
