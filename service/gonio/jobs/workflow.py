"""The DBOS workflow ``analyse``: take a job, run the river with durable stages, publish its report, exactly once."""

import logging
import shutil
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

from dbos import DBOS

from gonio.jobs.database import Database
from gonio.jobs.failure import Problem, describe
from gonio.jobs.repository import Repository
from gonio.jobs.runner import DurableRunner
from gonio.jobs.store import Store
from gonio.jobs.tables import ACTIVE, JobRow, JobState, ReportRow, now
from gonio.pipeline.run import Analyse, CaptureFile, ReportFiles, Role

log = logging.getLogger(__name__)

APPLICATION = "gonio"
WORKFLOW = "analyse"
QUEUE = "analysis"
VERSION = "pipeline-1"
"""The version of the steps' names and order. DBOS goes on with a job only in the version that began it: change it when
a stage is added, removed or moved, and only then, or each deployment would strand the jobs that are under way."""


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """What a worker works with; ``shares`` are the stages' shares of the wall time in ``analyse``."""

    database: Database
    store: Store
    folder: Path
    analyse: Analyse
    shares: Mapping[str, float]


def session_prefix(lab: str, session_id: str) -> str:
    """Give the prefix of all objects of a session: deleting it deletes everything the session ever produced."""
    return f"labs/{lab}/sessions/{session_id}"


def register(workshop: Workshop) -> None:
    """Make the workflow known to DBOS; before ``DBOS.launch``."""

    def analyse(lab: str, job_id: str) -> None:
        Analysis(workshop, lab, job_id).run()

    # Nothing in here may depend on the time, on chance or on the database, except inside a step: a replay must ask for
    # the same steps in the same order.
    DBOS.workflow(name=WORKFLOW)(analyse)


class Analysis:
    """One job's way through a worker."""

    def __init__(self, workshop: Workshop, lab: str, job_id: str) -> None:
        self._workshop = workshop
        self._lab = lab
        self._job_id = job_id

    def run(self) -> None:
        """Run the job to its end, whatever that is; only cancellation and loss of ownership leave it early."""
        plan = DBOS.run_step({"name": "begin"}, self._begin)
        if plan is None:
            return
        try:
            self._analyse(plan)
        except Exception as error:
            problem = describe(error)
            DBOS.run_step({"name": "fail"}, self._fail, problem)

    def _analyse(self, plan: dict[str, Any]) -> None:
        with self._workplace(plan["files"]) as (folder, files):
            prefix = f"{session_prefix(self._lab, plan['session_id'])}/jobs/{self._job_id}"
            runner = DurableRunner(self._workshop.store, prefix, folder, self._workshop.shares)
            report = self._workshop.analyse(files, plan["parameters"], runner, folder / "output")
            stages = [{"name": stage, "seconds": seconds} for stage, seconds in runner.seconds.items()]
            DBOS.run_step({"name": "publish"}, self._publish, plan["session_id"], prefix, report, stages)

    @contextmanager
    def _workplace(self, files: list[dict[str, Any]]) -> Generator[tuple[Path, list[CaptureFile]]]:
        """Give a folder with the capture files under their own names and with an empty folder ``output``."""
        folder = self._workshop.folder / f"{self._job_id}-{uuid4().hex[:8]}"
        (folder / "capture").mkdir(parents=True)
        (folder / "output").mkdir()
        with ExitStack() as stack:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            captured: list[CaptureFile] = []
            for file in files:
                link = folder / "capture" / file["name"]
                link.symlink_to(stack.enter_context(self._workshop.store.local_path(file["key"])))
                role = cast("Role", file["role"])
                captured.append(CaptureFile(path=link, name=file["name"], role=role, camera=file["camera"]))
            yield folder, captured

    def _begin(self) -> dict[str, Any] | None:
        """Take the job, unless it was cancelled while it waited."""
        with self._workshop.database.write() as session:
            repository = Repository(session, self._lab)
            if not repository.change_job(self._job_id, ACTIVE, state=JobState.DOING, started_at=now()):
                return None
            job: JobRow = repository.job(self._job_id)
            return {"session_id": job.session_id, "parameters": job.parameters, "files": job.files}

    def _publish(self, session_id: str, prefix: str, report: ReportFiles, stages: list[dict[str, Any]]) -> bool:
        """Store the report and end the job, if it is still this job's turn; may safely run twice."""
        files: list[dict[str, Any]] = []
        for kind, path in (
            ("document", report.document),
            ("page", report.page),
            *(("other", path) for path in report.others),
        ):
            stored = self._workshop.store.put_file(f"{prefix}/report", path.name, path)
            files.append({"name": path.name, "kind": kind, **stored._asdict()})
        with self._workshop.database.write() as session:
            repository = Repository(session, self._lab)
            ended = repository.change_job(
                self._job_id, [JobState.DOING], state=JobState.SUCCEEDED, ended_at=now(), stages=stages
            )
            if ended:
                repository.add(ReportRow(id=self._job_id, session_id=session_id, files=files))
        return ended

    def _fail(self, problem: Problem) -> bool:
        log.warning("Job %s failed: %s", self._job_id, problem["code"])
        with self._workshop.database.write() as session:
            return end_badly(Repository(session, self._lab), self._job_id, problem)


def end_badly(repository: Repository, job_id: str, problem: Problem) -> bool:
    """End a job with a problem, if it hasn't ended."""
    return repository.change_job(job_id, ACTIVE, state=JobState.FAILED, ended_at=now(), problem=problem)
