"""What a worker computes at the moment, for its main thread to watch, and its sign of life for its supervisor."""

import os
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress

BEAT_S = 1.0
HEARTBEAT_VARIABLE = "GONIO_HEARTBEAT_FD"


class Desk:
    """The one job on which a worker works, and when it last got on with it."""

    def __init__(self) -> None:
        self.job_id: str | None = None
        self._moved_s = time.monotonic()

    @contextmanager
    def working_on(self, job_id: str) -> Generator[None]:
        """Say which job is on the desk for as long as the block lasts."""
        self.move()
        self.job_id = job_id
        try:
            yield
        finally:
            self.job_id = None

    def move(self) -> None:
        """Say that the job gets on."""
        self._moved_s = time.monotonic()

    @property
    def silent_s(self) -> float:
        """For how long nothing was heard of the job."""
        return time.monotonic() - self._moved_s


def start_heartbeat() -> None:
    """Tell the supervisor, if there is one, once a second that this process isn't frozen."""
    descriptor = os.environ.pop(HEARTBEAT_VARIABLE, None)
    if descriptor is None:
        return

    def beat() -> None:
        with suppress(OSError):  # the supervisor is gone, and this process with it
            while os.write(int(descriptor), b"."):
                time.sleep(BEAT_S)

    threading.Thread(target=beat, name="heartbeat", daemon=True).start()
