"""A worker shows that it lives from its first moment on, and not only when all that it needs is imported."""

import os
import select
import sys

from gonio.jobs import worker
from gonio.jobs.desk import HEARTBEAT_VARIABLE


class Slow:
    """The rivers, whose import takes a minute on a busy machine."""

    def __init__(self, reading: int) -> None:
        self._reading = reading
        self.beat = False

    @property
    def RIVERS(self) -> dict[str, object]:
        self.beat = bool(select.select([self._reading], [], [], 5)[0])
        return {}


def test_a_worker_beats_while_it_imports_the_rivers(monkeypatch):
    reading, writing = os.pipe()
    rivers = Slow(reading)
    monkeypatch.setenv(HEARTBEAT_VARIABLE, str(writing))
    monkeypatch.setitem(sys.modules, "gonio.pipeline.rivers", rivers)
    monkeypatch.setattr(worker, "set_up_logging", lambda _: None)
    monkeypatch.setattr(worker.os, "nice", lambda _: 0)
    monkeypatch.setattr(worker, "run_worker", lambda *_, **__: None)
    worker.main()
    os.close(reading)  # the thread ends when it writes again
    assert rivers.beat
