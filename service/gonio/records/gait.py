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
