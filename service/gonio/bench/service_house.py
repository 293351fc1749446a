"""A service that is treated badly: its processes are started, killed at any moment and started again.

The river is the small one of ``tests/service``: real stages that read the uploaded videos, and write down what they do.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gonio.client import Client, Document
from gonio.errors import GonioError, InputError
from gonio.jobs.access import SCOPES, opened
from gonio.jobs.database import Database
from gonio.jobs.queue import Queue
from gonio.jobs.repository import active_job_of_any_lab
from gonio.settings import Settings

SCRIPTS = Path(__file__).resolve().parents[3] / "tests" / "service"
SUPERVISE = (
    "import sys; from gonio.jobs.supervisor import supervise; from gonio.settings import Settings; "
    "supervise(Settings(), [sys.executable, sys.argv[1]])"
)
VICTIMS = ("worker", "api", "worker and api", "supervisor")
READY_S = 120.0


class House:
    """The processes of one service: an API, and a supervisor with its workers."""

    def __init__(self, settings: Settings, folder: Path, environment: Mapping[str, str]) -> None:
        self.settings = settings
        self.folder = folder
        self._environment = {**os.environ, **environment, **settings.environment()}
        self._api: subprocess.Popen[str] | None = None
        self._supervisor: subprocess.Popen[str] | None = None
        self.url = ""
        self.key = ""

    def start_api(self) -> None:
        """Start the API, and wait until it answers; always at the same address."""
        environment = {**self._environment, "GONIO_WORKERS": "0", "GONIO_PORT": self.url.rpartition(":")[2] or "0"}
        self._api = self._run([sys.executable, str(SCRIPTS / "server_main.py")], environment)
        assert self._api.stdout is not None
        url = self._api.stdout.readline().strip()
        if not url:
            raise GonioError("The API doesn't start.", hint=f"See {self.folder / 'log'}.", code="bench-failed")
        self.url = url
        if not self.key and not self.settings.is_embedded:
            with opened(self.settings) as access:
                self.key = access.create_key(self.settings.default_lab, "bench", SCOPES).secret

    def start_workers(self) -> None:
        """Start the supervisor; its workers need seconds to come up."""
        self._supervisor = self._run(
            [sys.executable, "-c", SUPERVISE, str(SCRIPTS / "worker_main.py")], self._environment
        )

    def kill(self, victim: str, worker_pid: int) -> None:
        """Kill and, but for workers, which their supervisor brings back, start again."""
        if "worker" in victim:
            with suppress(ProcessLookupError):
                os.kill(worker_pid, signal.SIGKILL)
        if "api" in victim:
            _kill(self._api)
        if victim == "supervisor":
            _kill(self._supervisor)
        wait_for(lambda: not _lives(worker_pid), 5) if victim != "api" else None

    def restart(self, victim: str) -> None:
        """Start again what was killed and has nobody who does."""
        if "api" in victim:
            self.start_api()
        if victim == "supervisor":
            self.start_workers()

    def stop(self) -> None:
        """Stop everything."""
        for process in (self._supervisor, self._api):
            if process is not None and process.poll() is None:
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
            if process is not None and process.stdout is not None:
                process.stdout.close()

    def client(self) -> Client:
        """Give a client."""
        return Client(self.url, key=self.key)

    def recorded_steps(self, job: str) -> set[str]:
        """Name the stages of a job whose outcome is kept."""
        queue = Queue(self.settings.resolved_database_url)
        try:
            return set(queue.step_names(job))
        finally:
            queue.close()

    def has_ended(self, job: str) -> bool:
        """Tell whether a job has ended; its worker may have been killed before it could record that step."""
        database = Database(self.settings.resolved_database_url)
        try:
            with database.read() as session:
                return active_job_of_any_lab(session, job) is None
        finally:
            database.close()

    def _run(self, command: Sequence[str], environment: Mapping[str, str]) -> subprocess.Popen[str]:
        with (self.folder / "log").open("a") as log:
            return subprocess.Popen(  # noqa: S603 - our own command
                command, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
            )


@contextmanager
def open_house(settings: Settings, folder: Path, environment: Mapping[str, str] | None = None) -> Generator[House]:
    """Run an API and workers for as long as the block lasts.

    Raises:
        InputError: ``checkout-missing``: the small river is a part of the tests.
    """
    if not SCRIPTS.is_dir():
        raise InputError(
            "The tests of the service are not at hand.", hint="Run the bench in a checkout.", code="checkout-missing"
        )
    house = House(settings, folder, environment or {})
    try:
        house.start_api()
        house.start_workers()
        yield house
    finally:
        house.stop()


@dataclass
class Kills:
    """What came of killing."""

    kills: dict[str, int] = field(default_factory=dict)
    stages: dict[str, int] = field(default_factory=dict)
    jobs: int = 0
    lost: int = 0
    different: int = 0
    surplus_reports: int = 0
    repeated_stages: int = 0
    takeover_s: list[float] = field(default_factory=list)


def kill_at_random(house: House, capture: Sequence[Path], count: int, dice: random.Random) -> Kills:
    """Kill processes in the middle of jobs, one after another, and look at what comes of the jobs.

    Each job has four stages that take a fraction of a second; the kill comes at a random moment of it.
    """
    result = Kills()
    with house.client() as client:
        session = client.create_session(name="kills")["id"]
        for path in capture:
            client.upload(session, path)
        expected = _report_of(client, _finished(client, _start(house, client, session, "undisturbed", 0.2)))
        for index in range(count):
            victim = VICTIMS[index % len(VICTIMS)]
            job, journal = _start(house, client, session, f"kill-{index}", 0.15 + 0.01 * dice.random())
            result.jobs += 1
            _wait_for_lines(journal, 1)
            time.sleep(dice.uniform(0.0, 0.5))
            lines = _lines(journal)
            pid = int(lines[-1].rsplit(" ", 1)[1])
            house.kill(victim, pid)
            result.kills[victim] = result.kills.get(victim, 0) + 1
            _look_after(house, job, journal, victim, result)
            try:
                ended = _finished(client, (job, journal))
            except GonioError:
                result.lost += 1
                continue
            result.different += _report_of(client, ended) != expected
        known = [job for job in client.jobs() if job["session"] == session]
        result.surplus_reports = len(known) - result.jobs - 1
    return result


def _look_after(house: House, job: str, journal: Path, victim: str, result: Kills) -> None:
    """See how a job goes on after a kill: when, and that nothing is done again that was done."""
    killed_s = time.monotonic()
    done, known = house.recorded_steps(job), len(_lines(journal))
    last = _lines(journal)[-1].rsplit(" ", 1)[0]
    result.stages[last] = result.stages.get(last, 0) + 1
    ended = house.has_ended(job)
    if victim in ("api", "supervisor") or ended:
        house.restart(victim)
    if victim == "api" or ended:  # nobody lost the job
        return
    wait_for(lambda: len(_lines(journal)) > known or house.has_ended(job), READY_S)
    result.takeover_s.append(time.monotonic() - killed_s)
    if victim == "worker and api":
        house.restart(victim)
    after = [line.rsplit(" ", 1)[0] for line in _lines(journal)[known:]]
    result.repeated_stages += sum(f"begin {stage}" in after for stage in done)


def _start(house: House, client: Client, session: str, name: str, seconds: float) -> tuple[str, Path]:
    journal = house.folder / f"journal-{name}"
    journal.touch()
    job = client.analyse(session, {"journal": str(journal), "seconds": seconds}, idempotency_key=f"{session} {name}")
    return job["id"], journal


def _finished(client: Client, started: tuple[str, Path]) -> Document:
    deadline_s = time.monotonic() + READY_S
    while True:
        try:
            return client.wait(started[0], timeout_s=READY_S, poll_s=0.1)
        except GonioError as error:
            if error.code not in ("service-unreachable", "connection-broken") or time.monotonic() > deadline_s:
                raise
        time.sleep(0.1)


def _report_of(client: Client, job: Document) -> list[tuple[str, str]]:
    return [(file["name"], file["sha256"]) for file in client.report_files(job["id"])]


def _lines(journal: Path) -> list[str]:
    return journal.read_text().splitlines()


def _wait_for_lines(journal: Path, count: int) -> None:
    wait_for(lambda: len(_lines(journal)) >= count, READY_S)


def wait_for(condition: Callable[[], Any], timeout_s: float) -> None:
    """Wait until something holds.

    Raises:
        GonioError: ``bench-failed``: it never did.
    """
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise GonioError("What should have happened didn't.", hint="See the service's log.", code="bench-failed")
        time.sleep(0.02)


def _kill(process: subprocess.Popen[str] | None) -> None:
    assert process is not None
    process.kill()
    process.communicate()


def _lives(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
