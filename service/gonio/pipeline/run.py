"""How the river is run: what a stage gives, who runs it, and how far it is.

``analyse(capture_files, parameters, runner, output_dir)`` is written against :class:`StageRunner` only. The command
line gives it a :class:`LocalRunner`; a job gives it a runner that keeps each finished stage (``gonio.jobs.runner``), so
that a crash costs at most the stage it fell into.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Literal, Protocol, TypeVar

from gonio.records import Finding

T = TypeVar("T")

SessionKind = Literal["human_multicamera", "human_monocular", "articulated_object", "calibration"]

TrialRole = Literal[
    "video",
    "keypoints",
    "calibration",
    "body_model",
    "marker_set",
    "pressure",
    "pressure_card",
    "force_plates",
    "force_coefficients",
]
"""``keypoints`` are one camera's, as another program found them (OpenPose's files in a ZIP archive). ``pressure`` is a table of
foot pressure, ``pressure_card`` says what its columns mean; ``force_plates`` is C3D or MOT; ``force_coefficients`` are a lab's
own numbers of the shear."""

CalibrationRole = Literal["sweep", "lens", "floor", "board", "optics", "floor_points", "previous"]
"""``sweep``: all cameras film the board at the same time. ``lens``: one camera films it alone, close. ``floor``: it lies on
the floor. ``board`` is its card, ``optics`` a file with lenses that are known already, ``floor_points`` named points,
``previous`` gonio's calibration of the same cameras, which is checked."""

ROLE_NAMES: dict[str, CalibrationRole] = {
    "board": "board", "charuco": "board", "checkerboard": "board", "floor_points": "floor_points",
    "optics": "optics", "intrinsics": "optics", "lenses": "optics", "camera_array": "optics",
}  # fmt: skip
"""What a calibration's file is that is called so, whatever its ending."""

ObjectRole = Literal["joint_tree", "tracks", "background", "picture", "calibration"]
"""``joint_tree`` is body.toml, ``tracks`` the marks of the parts, ``background`` those of what stands still, ``picture`` a
photograph, ``calibration`` the cameras where they are known."""

Role = Literal[TrialRole, CalibrationRole, ObjectRole]

STAGE_SHARES: Mapping[str, float] = MappingProxyType(
    {
        "calibration": 0.01,
        "capture": 0.01,
        "sensors": 0.005,
        "keypoints": 0.82,
        "checks": 0.005,
        "synchronization": 0.02,
        "tripods": 0.005,
        "cameras": 0.01,
        "triangulation": 0.03,
        "smoothing": 0.01,
        "scaling": 0.01,
        "kinematics": 0.03,
        "pressure": 0.005,
        "forces": 0.005,
        "dynamics": 0.005,
        "gait": 0.01,
        "report": 0.01,
    }
)
"""Each stage's share of the wall time, in the order of the river; they only steer the progress bar.

A stage that is not named here doesn't move the bar, and one that a run leaves out counts as passed.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureFile:
    """One uploaded file, as the river sees it: a local path, the name its owner gave it, and what it is."""

    path: Path
    name: str
    role: Role
    camera: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportFiles:
    """What an analysis or a calibration wrote into its output folder; ``others`` are the files for other programs."""

    document: Path
    page: Path
    others: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Outcome(Generic[T]):
    """What a stage gives: its value, and what the report must say about how it came to be."""

    value: T
    findings: tuple[Finding, ...] = ()


class Progress(Protocol):
    """Says how far a stage is. May raise ``Cancelled``, or whatever else its runner stops a stage with: let it pass."""

    def __call__(self, fraction: float) -> None:
        """Report the done fraction of the stage, 0 to 1; at least twice a second in a long stage, more is free.

        In the thread that runs the stage: a runner may know no other.
        """
        ...


class StageRunner(Protocol):
    """Runs the stages of one analysis, one after the other."""

    def __call__(self, stage: str, work: Callable[[Progress], Outcome[T]]) -> T:
        """Run a stage, or take its stored outcome; keep its findings and give its value.

        The value must be a record, or a tuple, list or dict of records, arrays and plain values
        (``gonio.formats.record_file``). A stage may also write files into the output folder.
        """
        ...

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of all stages so far, in order."""
        ...


class Analyse(Protocol):
    """The signature of ``gonio.pipeline.analyse`` and of ``gonio.pipeline.calibration.calibrate``, which jobs call."""

    def __call__(
        self,
        capture_files: Sequence[CaptureFile],
        parameters: Mapping[str, Any],
        runner: StageRunner,
        output_dir: Path,
    ) -> ReportFiles:
        """Compute a report from the files of one session.

        ``parameters`` holds what the caller asked for, and under ``subject`` what the session knows of the person
        (``mass_kg``, ``stature_m``, ``sex``: each may be missing).
        """
        ...


@dataclass(frozen=True)
class River:
    """What a job of one kind of session runs; ``shares`` are its stages' shares of the wall time, in order."""

    compute: Analyse
    shares: Mapping[str, float]


class Estimate:
    """How far a whole run is, and how many seconds it still takes.

    The pace is measured within the stage that runs, from its first progress on: what a stage does before that (a network
    is loaded, code is compiled) comes once and would make the rest look long.
    """

    SETTLING_S = 3.0
    """How long a pace is measured before it is believed."""
    SMOOTHING_S = 5.0
    """A new estimate replaces the old one with this time constant, so that the number on the screen doesn't jump."""

    def __init__(self, shares: Mapping[str, float] = STAGE_SHARES, clock: Callable[[], float] = time.monotonic) -> None:
        self._starts: dict[str, float] = {}
        self._shares = dict(shares)
        total = sum(self._shares.values())
        passed = 0.0
        for stage, share in self._shares.items():
            self._starts[stage] = passed / total
            self._shares[stage] = share / total
            passed += share
        self._clock = clock
        self._last_s = clock()
        self._stage = ""
        self._begin: tuple[float, float] | None = None
        self._fraction = 0.0
        self._remaining_s: float | None = None

    def take(self, stage: str) -> None:
        """Count a stage as done that cost nothing, because its outcome was already there."""
        self._fraction = max(self._fraction, self._starts.get(stage, 0.0) + self._shares.get(stage, 0.0))

    def at(self, stage: str, fraction: float) -> tuple[float, float | None]:
        """Give the fraction of the whole and the remaining seconds (None: not known yet) at a point of a stage."""
        if stage in self._starts:
            here = self._starts[stage] + min(max(fraction, 0.0), 1.0) * self._shares[stage]
            self._fraction = max(self._fraction, here)  # a stage that starts anew doesn't take the bar back
        if stage != self._stage:
            self._stage, self._begin = stage, None
        now_s = self._clock()
        step_s, self._last_s = now_s - self._last_s, now_s
        if self._remaining_s is not None:
            self._remaining_s = max(self._remaining_s - step_s, 0.0)
        if self._begin is None and fraction > 0:
            self._begin = now_s, self._fraction
        if self._begin is not None:
            self._measure(now_s - self._begin[0], self._fraction - self._begin[1], step_s)
        return self._fraction, self._remaining_s

    def _measure(self, elapsed_s: float, gained: float, step_s: float) -> None:
        if elapsed_s < self.SETTLING_S or gained <= 0:
            return
        measured_s = elapsed_s * (1.0 - self._fraction) / gained
        if self._remaining_s is None:
            self._remaining_s = measured_s
        else:
            self._remaining_s += (measured_s - self._remaining_s) * min(step_s / self.SMOOTHING_S, 1.0)


class LocalRunner:
    """Runs everything in this process: ``gonio analyse`` and the tests.

    ``on_progress(stage, fraction, remaining_s)`` hears the fraction of the whole run; an exception that it raises stops
    the run there. ``seconds`` holds the wall time of each finished stage.
    """

    def __init__(
        self,
        on_progress: Callable[[str, float, float | None], None] | None = None,
        shares: Mapping[str, float] = STAGE_SHARES,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self._findings: list[Finding] = []
        self._on_progress = on_progress
        self._estimate = Estimate(shares)

    def __call__(self, stage: str, work: Callable[[Progress], Outcome[T]]) -> T:
        """Run a stage and keep its findings."""

        def progress(fraction: float) -> None:
            whole, remaining_s = self._estimate.at(stage, fraction)
            if self._on_progress is not None:
                self._on_progress(stage, whole, remaining_s)

        begin_s = time.monotonic()
        progress(0.0)
        outcome = work(progress)
        progress(1.0)
        self.seconds[stage] = time.monotonic() - begin_s
        self._findings.extend(outcome.findings)
        return outcome.value

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of all stages so far, in order."""
        return tuple(self._findings)
