"""What is known of a walk: when the feet touch the ground, and the cycles between."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.records.record import record
from gonio.records.timebase import Timebase
from gonio.records.walk import FEET

CYCLE_POINTS = 101
"""A cycle's curve has a value at each per cent, from one initial contact (0 %) to the next one of the same foot (100 %)."""


@record
class FootPaths:
    """Where the feet and the pelvis are in the lab, m; NaN where that is not known.

    ``heel_lab_m`` is the back of the heel and ``toe_lab_m`` the tip of the toes, the right foot first.
    """

    timebase: Timebase
    heel_lab_m: Float[np.ndarray, "frame foot 3"]
    toe_lab_m: Float[np.ndarray, "frame foot 3"]
    pelvis_lab_m: Float[np.ndarray, "frame 3"]

    def __post_init__(self) -> None:
        if self.heel_lab_m.shape[1] != len(FEET):
            raise InputError(
                f"Paths of {self.heel_lab_m.shape[1]} feet were given.", hint="Give the right foot, then the left one."
            )


@record
class EventTrain:
    """Events of one kind of one foot, ascending, in frames with a fraction.

    ``sd_s`` is the standard deviation of each event's time. ``from_force`` says that a force showed it, not the movement.
    """

    frames: Float[np.ndarray, " event"]
    sd_s: Float[np.ndarray, " event"]
    from_force: Bool[np.ndarray, " event"]


@record
class GaitEvents:
    """Initial contacts (``strikes``) and toe-offs (``lifts``) of the right and the left foot."""

    strikes: tuple[EventTrain, EventTrain]
    lifts: tuple[EventTrain, EventTrain]


@record
class GaitCycle:
    """From one initial contact of a foot to its next one; frames with a fraction, NaN where an event was not seen.

    ``foot`` is an index into ``FEET``. In between: the other foot lifts (loading ends), the heel rises (mid-stance ends), the
    other foot strikes, this one lifts (swing begins). ``left_out`` says why the cycle does not count in the averages; empty
    where it does.
    """

    foot: int
    start_frame: float
    other_lift_frame: float
    heel_off_frame: float
    other_strike_frame: float
    lift_frame: float
    end_frame: float
    left_out: str = ""

    def percent(self, frame: float) -> float:
        """Give where in the cycle a frame is, 0 to 100; NaN for NaN."""
        return 100.0 * (frame - self.start_frame) / (self.end_frame - self.start_frame)


@record
class Measure:
    """One spatio-temporal parameter: its value in each step, stride or cycle.

    ``side`` is that of the foot whose step or cycle it is, or ``both``.
    """

    name: str
    side: str
    unit: str
    values: Float[np.ndarray, " occurrence"]

    @property
    def mean(self) -> float:
        """The mean, NaN without a value."""
        return float(self.values.mean()) if self.values.size else np.nan

    @property
    def sd(self) -> float:
        """The standard deviation between occurrences, NaN with fewer than two."""
        return float(self.values.std(ddof=1)) if self.values.size > 1 else np.nan


@record
class TimeCurve:
    """A joint's angle, moment or power over the trial, in the clinical sense and the report's unit, with its error.

    ``quantity`` is its name in the norms, ``knee_flexion``. ``sd`` is the standard deviation of each value's error; NaN
    where the value is, or where it is not known.
    """

    quantity: str
    side: str
    unit: str
    values: Float[np.ndarray, " frame"]
    sd: Float[np.ndarray, " frame"]


@record
class CycleCurves:
    """The same over the gait cycle: a row a cycle, in the order of the cycles of its side."""

    quantity: str
    side: str
    unit: str
    values: Float[np.ndarray, "cycle 101"]
    sd: Float[np.ndarray, "cycle 101"]


@record
class GaitAnalysis:
    """A walk cut into cycles.

    ``belt_m_s`` is how fast the ground moved backwards: 0 on the floor, NaN where nobody walked; ``leg_length_m`` from hip to
    sole.
    """

    events: GaitEvents
    cycles: tuple[GaitCycle, ...]
    measures: tuple[Measure, ...]
    curves: tuple[CycleCurves, ...]
    timebase: Timebase
    belt_m_s: float
    leg_length_m: float

    def cycles_of(self, side: str) -> tuple[GaitCycle, ...]:
        """List the cycles of a side."""
        return tuple(c for c in self.cycles if FEET[c.foot] == side)

    def measure(self, name: str, side: str) -> Measure | None:
        """Give a parameter by name and side, if it could be measured."""
        return next((m for m in self.measures if m.name == name and m.side == side), None)


@record
class NormCurve:
    """A curve of healthy people over the gait cycle: mean and standard deviation between people."""

    unit: str
    mean: Float[np.ndarray, "101"]
    sd: Float[np.ndarray, "101"]


@record
class NormCondition:
    """Norm curves by quantity for a range of walking speeds, as shares of √(gravity · leg length)."""

    name: str
    slowest: float
    fastest: float
    curves: dict[str, NormCurve]


@record
class Norms:
    """Norm curves of one source."""

    name: str
    population: str
    citation: str
    licence: str
    conditions: tuple[NormCondition, ...]


@record
class UsualValues:
    """What spatio-temporal parameters usually are, by their names."""

    population: str
    citation: str
    male: dict[str, float]
    female: dict[str, float]
