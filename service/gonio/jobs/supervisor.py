"""The supervisor: keeps N worker processes running, for as long as the process that owns it lives."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import BinaryIO

from gonio.jobs.desk import HEARTBEAT_VARIABLE
from gonio.settings import Settings

log = logging.getLogger(__name__)

WORKER_COMMAND = (sys.executable, "-m", "gonio.jobs.worker")
FIRST_PAUSE_S, LAST_PAUSE_S = 0.1, 30.0
STABLE_S = 60.0
"""A worker that lived this long had no trouble starting: the pause before its restart is the first one again."""
GRACE_S = 5.0
FROZEN_S = 60.0
"""A worker that gives no sign of life for so long is frozen. It is killed, since as long as it lives, its jobs wait."""


class Supervisor:
    """Starts workers, starts them again when they end, and stops them; use it in a ``with`` block.

    Args:
        settings: The workers' settings; they get them through their environment.
        command: What starts a worker.
        frozen_s: How long a worker may give no sign of life.
    """

    def __init__(
        self, settings: Settings, command: Sequence[str] = WORKER_COMMAND, *, frozen_s: float = FROZEN_S
    ) -> None:
        self._frozen_s = frozen_s
        self._environment = {**os.environ, **settings.environment(), "GONIO_SUPERVISOR_PID": str(os.getpid())}
        self._command = list(command)
        self._stop = threading.Event()
        # The kernel kills a worker when the *thread* that started it ends: so each has a thread that stays with it.
        self._threads = [
            threading.Thread(target=self._keep_running, args=(number,), name=f"worker-{number}", daemon=True)
            for number in range(settings.workers)
        ]

    def __enter__(self) -> "Supervisor":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _keep_running(self, number: int) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._stop.is_set():
            begin_s = time.monotonic()
            process, heartbeat = self._start()
            log.info("Worker %d runs as process %d", number, process.pid)
            with heartbeat:
                self._watch(process, heartbeat)
            if process.poll() is None:
                _stop(process)
                return
            pause_s = FIRST_PAUSE_S if time.monotonic() - begin_s > STABLE_S else min(pause_s * 2, LAST_PAUSE_S)
            log.warning("Worker %d ended with %d; the next starts in %.1f s", number, process.returncode, pause_s)
            self._stop.wait(pause_s)

    def _start(self) -> tuple[subprocess.Popen[bytes], BinaryIO]:
        """Start a worker, and give it with the pipe on which it gives signs of life."""
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        try:
            process = subprocess.Popen(  # noqa: S603 - our own command
                self._command,
                env={**self._environment, HEARTBEAT_VARIABLE: str(writing)},
                pass_fds=(writing,),
                process_group=0,  # Ctrl-C is for the supervisor, which then stops its workers
            )
        finally:
            os.close(writing)
        return process, os.fdopen(reading, "rb", buffering=0)

    def _watch(self, process: subprocess.Popen[bytes], heartbeat: BinaryIO) -> None:
        """Return when the worker ended, was killed because it is frozen, or is to be stopped."""
        heard_s = time.monotonic()
        while process.poll() is None and not self._stop.wait(0.1):
            if heartbeat.read(100):
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > self._frozen_s:
                log.error("Process %d gave no sign of life for %.0f s and is killed", process.pid, self._frozen_s)
                process.kill()
                process.wait()


def supervise(settings: Settings, command: Sequence[str] = WORKER_COMMAND) -> None:
    """Keep workers running until SIGINT or SIGTERM: `gonio worker`."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with Supervisor(settings, command):
        stop.wait()


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
