"""The worker process: takes jobs from the queue, one at a time, and looks after the jobs of workers that died."""

import ctypes
import functools
import logging
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from types import FrameType
from uuid import uuid4

import psycopg
from dbos import DBOS, DBOSPortableJSONSerializer, WorkflowStatus
from sqlalchemy.exc import OperationalError

from gonio.jobs.database import Database, upgrade
from gonio.jobs.desk import Desk, start_heartbeat
from gonio.jobs.failure import Problem
from gonio.jobs.liveness import open_locks
from gonio.jobs.logs import set_up_logging
from gonio.jobs.postgres import connect_patiently, is_postgres
from gonio.jobs.queue import APPLICATION, QUEUE, Queue
from gonio.jobs.repository import Repository, active_job_of_any_lab, active_jobs_of_all_labs, add_to_tallies
from gonio.jobs.store import Store
from gonio.jobs.workflow import VERSION, Workshop, end_badly, register
from gonio.pipeline.run import River
from gonio.settings import Settings

log = logging.getLogger("gonio.jobs.worker")  # by name: run as a module, this one is __main__

POLL_S = 0.5
"""How long a queued job waits at most for an idle worker."""
NICENESS = 5
"""By how much a worker lets others go first: minutes of computing can wait for a request of milliseconds."""
SWEEP_S = 1.0
"""How often a worker looks for dead ones."""
MAX_TAKEOVERS = 3
"""How many workers a job may kill in one and the same stage."""
STORE_PATIENCE_S = 280.0
"""How long a worker waits for a store that is out of reach before it gives a job up."""
STRANDED_EVERY_S = 10.0
"""How often a worker looks at all active jobs: there can be thousands."""
OUTAGE_GRACE_S = 10.0
"""How long nobody is taken for dead after an outage of the database, in which all workers lose their locks."""
SWEEPS_UNTIL_LOST = 3
"""How many sweeps long a job of this worker may be off its desk: it was taken and isn't there yet, or ends just now."""
SWEEPS_AFTER_END = 3
"""How many sweeps long a stage may go on whose job has ended elsewhere, on request or by another worker."""


class WorkerStuck(Exception):
    """What the worker computes doesn't get on, or isn't wanted any more, and can't be stopped without the process."""


def run_worker(
    settings: Settings,
    rivers: Mapping[str, River],
    *,
    supervisor_pid: int | None = None,
) -> None:
    """Work until SIGTERM or SIGINT; a job that is under way then goes on with another worker, or with the next one.

    Args:
        settings: Where the database and the store are.
        rivers: What it computes, by the kind of session: ``gonio.pipeline.rivers.RIVERS``.
        supervisor_pid: The process that started this one, if the worker must not outlive it.
    """
    if supervisor_pid is not None:
        die_with(supervisor_pid)
    start_heartbeat()
    stop = threading.Event()

    def ask_to_stop(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, ask_to_stop)
    upgrade(settings)
    worker = Worker(settings, rivers)
    with worker.alive():
        status = 1
        try:
            worker.start()
            while not stop.wait(SWEEP_S):
                worker.look_around()
            status = 0
        except WorkerStuck as stuck:
            log.error("Worker %s ends: %s", worker.name, stuck)  # noqa: TRY400 - a traceback would tell nothing
        except Exception:
            log.exception("Worker %s ends", worker.name)
        worker.clean_up()
        # A stage can run on for minutes, and all that is lost when it is cut is the stage: don't let the interpreter
        # wait for its thread, and hold the lock until that thread is gone.
        logging.shutdown()
        os._exit(status)


class Worker:
    """One worker. Its name is new at each start, so that a name whose lock is free belongs to a dead one for good."""

    def __init__(self, settings: Settings, rivers: Mapping[str, River]) -> None:
        self.name = f"worker-{uuid4().hex[:12]}"
        self._url = settings.resolved_database_url
        self._silence_s = settings.stage_silence_s
        self.desk = Desk()
        self._locks = open_locks(settings)
        self._queue = Queue(settings.resolved_database_url)
        self._folders = settings.work_dir
        self._workshop = Workshop(
            database=Database(self._url),
            store=Store.open(settings.resolved_objects_url, patience_s=STORE_PATIENCE_S),
            folder=self._folders / self.name,
            rivers=rivers,
            desk=self.desk,
        )
        self._careful_until_s = self._stranded_at_s = 0.0
        self._sweeps_after_end = 0
        self._sweeps_off_desk: dict[str, int] = {}

    def alive(self) -> ExitStack:
        """Hold the lock that tells the other workers that this one lives."""
        stack = ExitStack()
        stack.enter_context(self._locks.hold(self.name))
        return stack

    def start(self) -> None:
        """Begin to take jobs from the queue."""
        self._workshop.folder.mkdir(parents=True)
        register(self._workshop)
        DBOS(
            config={
                "name": APPLICATION,
                "system_database_url": self._url,
                "executor_id": self.name,
                "application_version": VERSION,
                "run_migrations": False,
                "serializer": DBOSPortableJSONSerializer(),  # plain JSON: writing to the database can't run code here
                "log_level": "WARNING",
                "db_engine_kwargs": (
                    {"creator": functools.partial(connect_patiently, self._url)} if is_postgres(self._url) else None
                ),
            }
        )
        DBOS.launch()
        DBOS.register_queue(QUEUE, worker_concurrency=1, polling_interval_sec=POLL_S)
        log.info("Worker %s is ready", self.name)
        self.look_around()

    def look_around(self) -> None:
        """Look after dead workers' jobs and after the own one; while the database is out of reach, do nothing.

        Raises:
            WorkerStuck: This process must end.
        """
        try:
            if self._locks.renew():
                self._careful_until_s = time.monotonic() + OUTAGE_GRACE_S
            if time.monotonic() > self._careful_until_s:
                self.take_over()
            self.take_up_again()
            self.watch_desk()
        except (psycopg.OperationalError, OperationalError) as error:
            log.warning("Worker %s can't use the database: %s", self.name, error)
            self._careful_until_s = time.monotonic() + OUTAGE_GRACE_S

    def take_over(self) -> None:
        """Put the jobs of dead workers back into the queue, and remove what else they left."""
        owners = {workflow.executor_id for workflow in self._queue.pending() if workflow.executor_id}
        left = {path.name for path in self._folders.iterdir()} | set(self._locks.names())
        for owner in (owners | left) - {self.name}:
            if not owner.startswith("worker-"):
                continue
            with self._locks.try_hold(owner) as dead:
                if not dead:
                    continue
                # Asked again inside the lock: another worker may have taken them over since.
                for workflow in self._queue.pending(owner):
                    self._resume(workflow)
                shutil.rmtree(self._folders / owner, ignore_errors=True)
        if time.monotonic() > self._stranded_at_s:
            self._queue_stranded_jobs()
            self._stranded_at_s = time.monotonic() + STRANDED_EVERY_S

    def take_up_again(self) -> None:
        """Put this worker's own jobs back into the queue that an error of the database has cut off in the middle.

        Their workflows still count as its own, and it lives, so nobody else would take them over.
        """
        off_desk = {workflow.workflow_id for workflow in self._queue.pending(self.name)} - {self.desk.job_id}
        self._sweeps_off_desk = {job_id: self._sweeps_off_desk.get(job_id, 0) + 1 for job_id in off_desk}
        for job_id in [job_id for job_id, sweeps in self._sweeps_off_desk.items() if sweeps > SWEEPS_UNTIL_LOST]:
            with self._workshop.database.read() as session:
                job = active_job_of_any_lab(session, job_id)
            if job is None:  # it has ended, and all that is missing is DBOS's note of it
                continue
            with self._workshop.database.write(job.lab) as session:  # no take-over: it isn't the job's fault
                Repository(session, job.lab).lose_job(job_id, job.takeovers, job.steps_at_takeover)
            log.warning("Worker %s takes up job %s again", self.name, job_id)
            self._queue.resume(job_id)
            del self._sweeps_off_desk[job_id]

    def clean_up(self) -> None:
        """Remove the work in progress: what is worth keeping is in the store."""
        shutil.rmtree(self._workshop.folder, ignore_errors=True)

    def watch_desk(self) -> None:
        """See whether the job on the desk gets on and is still wanted.

        Raises:
            WorkerStuck: It doesn't, or isn't, and only the end of this process stops it.
        """
        desk = self.desk
        job_id, silent_s = desk.job_id, desk.silent_s
        if job_id is None:
            self._sweeps_after_end = 0
            return
        if silent_s > self._silence_s:
            raise WorkerStuck(f"nothing was heard of job {job_id} for {silent_s:.0f} s")
        with self._workshop.database.read() as session:
            wanted = active_job_of_any_lab(session, job_id) is not None
        self._sweeps_after_end = 0 if wanted else self._sweeps_after_end + 1
        if self._sweeps_after_end > SWEEPS_AFTER_END:
            raise WorkerStuck(f"job {job_id} has ended, and its stage doesn't hear of it")

    def close(self) -> None:
        """Close all connections."""
        self._queue.close()
        self._workshop.database.close()

    def _resume(self, workflow: WorkflowStatus) -> None:
        """Put a job back into the queue, unless it killed too many workers in the same stage."""
        job_id = workflow.workflow_id
        steps = len(self._queue.step_names(job_id))
        with self._workshop.database.read() as session:
            job = active_job_of_any_lab(session, job_id)
        if job is None:
            self._queue.cancel(job_id)
            return
        with self._workshop.database.write(job.lab) as session:
            # DBOS forgets its own count when a workflow is resumed, so it is kept here.
            takeovers = 1 if steps > job.steps_at_takeover else job.takeovers + 1
            repository = Repository(session, job.lab)
            repository.lose_job(job_id, takeovers, steps)
            add_to_tallies(session, {"takeovers": 1})
            if takeovers >= MAX_TAKEOVERS:
                end_badly(repository, job_id, _crash_problem(takeovers))
        if takeovers >= MAX_TAKEOVERS:
            self._queue.cancel(job_id)
            return
        log.warning("Worker %s takes over job %s", self.name, job_id)
        self._queue.resume(job_id)

    def _queue_stranded_jobs(self) -> None:
        """Bring jobs on that no worker would ever take.

        Those are begun in another version of the river, and wait: they start anew. And those whose workflow ended without
        telling, by an error outside the river: they have failed.
        """
        with self._workshop.database.read() as session:
            labs = {job.id: job.lab for job in active_jobs_of_all_labs(session)}
        if not labs:
            return
        workflows = {workflow.workflow_id: workflow for workflow in self._queue.of_jobs(list(labs))}
        for job_id, lab in labs.items():
            workflow = workflows.get(job_id)
            if workflow is None:
                self._queue.add_again(self._workshop.database, lab, job_id)
            elif workflow.status in ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"):
                with self._workshop.database.write(lab) as session:
                    end_badly(Repository(session, lab), job_id, _crash_problem(1))
            elif workflow.status == "ENQUEUED" and workflow.app_version not in (None, VERSION):
                log.warning("Job %s was begun by version %s and starts anew", job_id, workflow.app_version)
                self._queue.forget([job_id])


def die_with(parent_pid: int) -> None:
    """Have the kernel kill this process when its parent dies (Linux; elsewhere the supervisor stops its workers)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
    if os.getppid() != parent_pid:  # it died before we could ask
        sys.exit(1)


def _crash_problem(count: int) -> Problem:
    times = "once" if count == 1 else f"{count} times in the same stage"
    return {
        "kind": "",
        "code": "worker-crashed",
        "message": f"The analysis ended its worker {times}.",
        "hint": "The machine may lack memory: see the service's log, then start the analysis again.",
        "details": {},
    }


def main() -> None:
    """Run a worker with the settings of the environment and the rivers of this version."""
    start_heartbeat()  # before the imports: on a machine that has no time for them they take longer than a frozen worker may
    settings = Settings()
    set_up_logging(settings)
    # In here, since importing the rivers takes seconds that nobody else needs to wait for.
    from gonio.pipeline.rivers import RIVERS

    supervisor = os.environ.get("GONIO_SUPERVISOR_PID")
    if sys.platform != "win32":
        os.nice(NICENESS)
    run_worker(settings, RIVERS, supervisor_pid=int(supervisor) if supervisor else None)


if __name__ == "__main__":
    main()
