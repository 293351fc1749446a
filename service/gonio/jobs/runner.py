"""The durable stage runner: each stage is a DBOS step whose outcome is kept, so a crash costs at most one stage."""

import io
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from dbos import DBOS
from sqlalchemy.exc import DBAPIError

from gonio.formats.record_file import read_record, write_record
from gonio.jobs.failure import Suspended, describe, revive
from gonio.jobs.queue import PROGRESS
from gonio.jobs.store import Store, Stored
from gonio.pipeline.run import STAGE_SHARES, Estimate, Outcome, Progress
from gonio.records import Finding

T = TypeVar("T")

REPORT_EVERY_S = 1.0


class DurableRunner:
    """Runs the stages of one job inside its DBOS workflow, or takes their outcomes from the store.

    The database keeps the key and hash of a stage's outcome; the outcome itself, and the files that the stage wrote
    into the output folder, are in the store. Paths below ``folder`` (the capture files, the output) are kept relative
    to it, so another worker can go on in another folder. ``on_move`` hears each sign that a stage gets on.
    """

    def __init__(
        self,
        store: Store,
        prefix: str,
        folder: Path,
        shares: Mapping[str, float] = STAGE_SHARES,
        on_move: Callable[[], None] = lambda: None,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self._on_move = on_move
        self._store = store
        self._prefix = prefix
        self._folder = folder
        self._output = folder / "output"
        self._findings: list[Finding] = []
        self._estimate = Estimate(shares)
        self._last_report_s = float("-inf")

    def __call__(self, stage: str, work: Callable[[Progress], Outcome[T]]) -> T:
        """Run a stage, or take its stored outcome; keep its findings and give its value."""
        fresh: list[Outcome[T]] = []

        def step() -> dict[str, Any]:
            begin_s = time.monotonic()
            before = self._listing()
            try:
                fresh.append(self._run(stage, work))
                return {
                    "outcome": self._put_outcome(stage, fresh[0]),
                    "files": self._put_files(stage, before),
                    "seconds": time.monotonic() - begin_s,
                }
            except DBAPIError as error:  # of telling the progress: stages know no database
                raise Suspended from error
            except Exception as error:
                return {"problem": describe(error)}

        kept = DBOS.run_step({"name": stage}, step)
        if "problem" in kept:
            raise revive(kept["problem"])
        outcome = fresh[0] if fresh else cast("Outcome[T]", self._take(stage, kept))
        self.seconds[stage] = kept["seconds"]
        self._findings.extend(outcome.findings)
        return outcome.value

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of all stages so far, in order."""
        return tuple(self._findings)

    def _run(self, stage: str, work: Callable[[Progress], Outcome[T]]) -> Outcome[T]:
        def progress(fraction: float) -> None:
            self._on_move()
            whole, remaining_s = self._estimate.at(stage, fraction)
            now_s = time.monotonic()
            if now_s - self._last_report_s < REPORT_EVERY_S:
                return
            self._last_report_s = now_s
            remaining_s = None if remaining_s is None else round(remaining_s, 1)
            # Stops the stage when the job was cancelled or another worker has it: what DBOS raises is no Exception.
            DBOS.set_event(PROGRESS, {"stage": stage, "fraction": round(whole, 4), "remaining_s": remaining_s})

        progress(0.0)
        outcome = work(progress)
        progress(1.0)
        return outcome

    def _take(self, stage: str, kept: dict[str, Any]) -> Outcome[Any]:
        for name, stored in kept["files"].items():
            path = self._output / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self._store.get_bytes(Stored(*stored)))
        self._estimate.take(stage)
        return read_record(io.BytesIO(self._store.get_bytes(Stored(*kept["outcome"]))), self._folder)

    def _put_outcome(self, stage: str, outcome: Outcome[Any]) -> Stored:
        content = io.BytesIO()
        write_record(content, outcome, self._folder)
        return self._store.put_bytes(f"{self._prefix}/stages/{stage}", "outcome.npz", content.getvalue())

    def _put_files(self, stage: str, before: dict[str, tuple[int, int]]) -> dict[str, Stored]:
        return {
            name: self._store.put_file(f"{self._prefix}/stages/{stage}", name, self._output / name)
            for name, state in self._listing().items()
            if before.get(name) != state
        }

    def _listing(self) -> dict[str, tuple[int, int]]:
        """Tell the output folder's files and their states, to see what a stage writes."""
        return {
            path.relative_to(self._output).as_posix(): (path.stat().st_mtime_ns, path.stat().st_size)
            for path in sorted(self._output.rglob("*"))
            if path.is_file()
        }
