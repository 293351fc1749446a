"""The DBOS workflow ``analyse``: take a job, run the river with durable stages, publish its report, exactly once."""

import logging
import math
import shutil
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

from dbos import DBOS
from sqlalchemy.exc import DBAPIError

from gonio.formats.calibration_json import read_calibration_document
from gonio.jobs.database import Database, patiently
from gonio.jobs.desk import Desk
from gonio.jobs.failure import Problem, Suspended, describe
from gonio.jobs.logs import about
from gonio.jobs.queue import WORKFLOW
from gonio.jobs.repository import Repository, add_to_tallies
from gonio.jobs.runner import DurableRunner
from gonio.jobs.store import Store
from gonio.jobs.tables import ACTIVE, CalibrationRow, JobRow, JobState, ReportRow, now
from gonio.pipeline.run import CaptureFile, ReportFiles, River, Role

log = logging.getLogger(__name__)

VERSION = "pipeline-4"
"""The version of the steps' names and order. DBOS goes on with a job only in the version that began it: change it when
a stage is added, removed or moved, and only then, or each deployment would strand the jobs that are under way."""


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """What a worker works with; ``rivers`` are what it computes, by the kind of session."""

    database: Database
    store: Store
    folder: Path
    rivers: Mapping[str, River]
    desk: Desk


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
        self._generation = 0

    def run(self) -> None:
        """Run the job to its end, whatever that is.

        Only cancellation, loss of ownership and an error of the database leave it early.

        Raises:
            Suspended: The database can't be used.
        """
        with self._workshop.desk.working_on(self._job_id), about(job=self._job_id):
            try:
                # No step: a worker that comes after a dead one must read it anew.
                self._generation = patiently(self._read_generation)
                self._run()
            except DBAPIError as error:
                raise Suspended from error

    def _run(self) -> None:
        plan = DBOS.run_step({"name": "begin"}, patiently, self._begin)
        if plan is None:
            return
        try:
            self._analyse(plan)
        except DBAPIError:
            raise
        except Exception as error:
            problem = describe(error)
            DBOS.run_step({"name": "fail"}, patiently, lambda: self._fail(problem))

    def _analyse(self, plan: dict[str, Any]) -> None:
        with self._workplace(plan["files"]) as (folder, files):
            prefix = f"{session_prefix(self._lab, plan['session_id'])}/jobs/{self._job_id}"
            river = self._workshop.rivers[plan["kind"]]
            runner = DurableRunner(self._workshop.store, prefix, folder, river.shares, self._workshop.desk.move)
            result = river.compute(files, plan["parameters"], runner, folder / "output")
            log.info("All stages are done in %.1f s", sum(runner.seconds.values()))
            stages = [{"name": stage, "seconds": seconds} for stage, seconds in runner.seconds.items()]
            publish = partial(self._publish, plan, prefix, result, stages)
            DBOS.run_step({"name": "publish"}, patiently, publish)

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
                link.symlink_to(stack.enter_context(self._workshop.store.local_path(file["key"], folder)))
                role = cast("Role", file["role"])
                captured.append(CaptureFile(path=link, name=file["name"], role=role, camera=file["camera"]))
            yield folder, captured

    def _read_generation(self) -> int:
        with self._workshop.database.read() as session:
            job = Repository(session, self._lab).find_job(self._job_id)
            return job.generation if job is not None else 0

    def _begin(self) -> dict[str, Any] | None:
        """Take the job, unless it was cancelled while it waited."""
        with self._workshop.database.write(self._lab) as session:
            repository = Repository(session, self._lab)
            if not repository.change_job(self._job_id, ACTIVE, state=JobState.DOING, started_at=now()):
                return None
            job: JobRow = repository.job(self._job_id)
            return {
                "session_id": job.session_id, "kind": job.kind, "parameters": job.parameters, "files": job.files
            }  # fmt: skip

    def _publish(self, plan: dict[str, Any], prefix: str, result: ReportFiles, stages: list[dict[str, Any]]) -> bool:
        """Store the result and end the job, if it is still this job's turn; may safely run twice."""
        files: list[dict[str, Any]] = []
        for kind, path in (
            ("document", result.document),
            ("page", result.page),
            *(("other", path) for path in result.others),
        ):
            stored = self._workshop.store.put_file(f"{prefix}/report", path.name, path)
            files.append({"name": path.name, "kind": kind, **stored._asdict()})
        values = summarize_calibration(result.document) if plan["kind"] == "calibration" else None
        with self._workshop.database.write(self._lab) as session:
            repository = Repository(session, self._lab)
            ended = repository.change_job(
                self._job_id,
                [JobState.DOING],
                of_generation=self._generation,
                state=JobState.SUCCEEDED,
                ended_at=now(),
                stages=stages,
            )
            if ended:
                common = {"id": self._job_id, "session_id": plan["session_id"], "files": files}
                name = repository.session(plan["session_id"]).name
                row = ReportRow(**common) if values is None else CalibrationRow(name=name, **common, **values)
                repository.add(row)
                add_to_tallies(session, {f"stage {stage['name']}": stage["seconds"] for stage in stages})
                add_to_tallies(session, {"frames": repository.count_frames(plan["session_id"])})
        return ended

    def _fail(self, problem: Problem) -> bool:
        log.warning("The job failed: %s", problem["code"])
        with self._workshop.database.write(self._lab) as session:
            return end_badly(Repository(session, self._lab), self._job_id, problem, self._generation)


def summarize_calibration(document: Path) -> dict[str, Any]:
    """Give what the list of calibrations shows of one: columns of its row."""
    calibration = read_calibration_document(document)
    error_m = calibration.volume.error_m
    return {
        "level": calibration.verdict.level,
        "summary": {
            "board": calibration.board,
            "cameras": list(calibration.rig.names),
            "left_out": list(calibration.left_out),
            "lab_source": calibration.lab.source,
            "volume_error_mm": None if math.isnan(error_m) else 1000 * error_m,
            "findings": [asdict(finding) for finding in calibration.findings],
        },
    }


def end_badly(repository: Repository, job_id: str, problem: Problem, generation: int | None = None) -> bool:
    """End a job with a problem, if it hasn't ended."""
    return repository.change_job(
        job_id, ACTIVE, of_generation=generation, state=JobState.FAILED, ended_at=now(), problem=problem
    )
