"""The worker process: takes jobs from the queue, one at a time, and looks after the jobs of workers that died."""

import ctypes
import logging
import os
import shutil
import signal
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from types import FrameType
from uuid import uuid4

from dbos import DBOS, DBOSPortableJSONSerializer

from gonio.jobs.database import Database, upgrade
from gonio.jobs.failure import Problem
from gonio.jobs.liveness import Locks
from gonio.jobs.repository import Repository, active_job_of_any_lab, active_jobs_of_all_labs
from gonio.jobs.store import Store
from gonio.jobs.workflow import APPLICATION, QUEUE, VERSION, Workshop, end_badly, register
from gonio.pipeline.run import River
from gonio.settings import Settings

log = logging.getLogger("gonio.jobs.worker")  # by name: run as a module, this one is __main__

POLL_S = 0.5
"""How long a queued job waits at most for an idle worker."""
SWEEP_S = 1.0
"""How often a worker looks for dead ones."""
MAX_TAKEOVERS = 3
"""How many workers a job may kill in one and the same stage."""


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
                worker.take_over()
            status = 0
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
        self._locks = Locks(settings.data_dir / "locks")
        self._folders = settings.cache_dir / "work"
        self._workshop = Workshop(
            database=Database(self._url),
            store=Store.open(settings.resolved_objects_url),
            folder=self._folders / self.name,
            rivers=rivers,
        )

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
            }
        )
        DBOS.launch()
        DBOS.register_queue(QUEUE, worker_concurrency=1, polling_interval_sec=POLL_S)
        log.info("Worker %s is ready", self.name)
        self.take_over()

    def take_over(self) -> None:
        """Put the jobs of dead workers back into the queue, and remove what else they left."""
        pending = DBOS.list_workflows(status="PENDING", load_input=False, load_output=False)
        owners = {workflow.executor_id for workflow in pending if workflow.executor_id}
        left = {path.name for path in self._folders.iterdir()} | set(self._locks.names())
        for owner in (owners | left) - {self.name}:
            if not owner.startswith("worker-"):
                continue
            with self._locks.try_hold(owner) as dead:
                if not dead:
                    continue
                # Asked again inside the lock: another worker may have taken them over since.
                for workflow in DBOS.list_workflows(status="PENDING", executor_id=owner, load_output=False):
                    self._resume(workflow.workflow_id, workflow.queue_name)
                shutil.rmtree(self._folders / owner, ignore_errors=True)
        self._end_lost_jobs()

    def clean_up(self) -> None:
        """Remove the work in progress: what is worth keeping is in the store."""
        shutil.rmtree(self._workshop.folder, ignore_errors=True)

    def _resume(self, job_id: str, queue: str | None) -> None:
        """Put a job back into the queue, unless it killed too many workers in the same stage."""
        steps = len(DBOS.list_workflow_steps(job_id))
        with self._workshop.database.write() as session:
            job = active_job_of_any_lab(session, job_id)
            poisonous = False
            if job is not None:
                # DBOS forgets its own count when a workflow is resumed, so it is kept here.
                job.takeovers = 1 if steps > job.steps_at_takeover else job.takeovers + 1
                job.steps_at_takeover = steps
                poisonous = job.takeovers >= MAX_TAKEOVERS
                if poisonous:
                    end_badly(Repository(session, job.lab), job_id, _crash_problem(job.takeovers))
        if job is None or poisonous:
            DBOS.cancel_workflow(job_id)
        else:
            log.warning("Worker %s takes over job %s", self.name, job_id)
            DBOS.resume_workflow(job_id, queue_name=queue or QUEUE)  # the queue: or its limits would be bypassed

    def _end_lost_jobs(self) -> None:
        """End the jobs whose workflow ended without telling: an error outside the river, such as a full disk."""
        with self._workshop.database.read() as session:
            labs = {job.id: job.lab for job in active_jobs_of_all_labs(session)}
        if not labs:
            return
        for workflow in DBOS.list_workflows(workflow_ids=list(labs), load_input=False, load_output=False):
            if workflow.status in ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"):
                with self._workshop.database.write() as session:
                    repository = Repository(session, labs[workflow.workflow_id])
                    end_badly(repository, workflow.workflow_id, _crash_problem(1))


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
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # In here, since importing the rivers takes seconds that nobody else needs to wait for.
    from gonio.pipeline.rivers import RIVERS

    supervisor = os.environ.get("GONIO_SUPERVISOR_PID")
    run_worker(Settings(), RIVERS, supervisor_pid=int(supervisor) if supervisor else None)


if __name__ == "__main__":
    main()
