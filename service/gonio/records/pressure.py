"""What pressure soles measured."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.records.record import record
from gonio.records.walk import FEET


@record
class FootPressure:
    """A stream of foot pressure: the vertical force under each foot (right, left), and where it acts on the sole.

    ``times_s`` are the soles' own time stamps, ascending and often irregular. ``cop_foot_m`` is the centre of pressure
    along the sole from the back of the heel, and across it to the right; NaN while a foot carries next to nothing. A
    sample that was lost is NaN in everything but its time.
    """

    times_s: Float[np.ndarray, " sample"]
    vertical_n: Float[np.ndarray, "sample foot"]
    cop_foot_m: Float[np.ndarray, "sample foot 2"]

    def __post_init__(self) -> None:
        if self.vertical_n.shape[1] != len(FEET):
            raise InputError(
                f"Pressure of {self.vertical_n.shape[1]} feet was given.",
                hint="Give the right foot, then the left one.",
            )
        if np.any(np.diff(self.times_s) <= 0):
            raise InputError(
                "The time stamps of the pressure stream do not ascend.", hint="Sort the samples and drop doubles."
            )


@record
class PressureStream:
    """A pressure stream as its file gives it, still on its own clock and with its own gain.

    ``pressure`` is in newtons where ``in_newtons``; else its force is in the sensors' own counts, proportional to force as
    far as its maker says so. ``saturated`` marks what a foot's sensors could not show in full. Where the recording stopped
    for a while there is a lost sample, so that nothing is interpolated across. ``doubled`` samples had the time stamp of
    the one before and were left out; ``negative`` is the share of values that were below zero, by noise, and became zero.
    """

    source: str
    pressure: FootPressure
    saturated: Bool[np.ndarray, "sample foot"]
    in_newtons: bool
    doubled: int
    negative: float


@record
class VirtualPressure:
    """A pressure stream of the virtual laboratory beside its truth.

    ``pressure`` is what the soles report. The rest is true: when each sample was taken by the laboratory's clock, what a
    perfect sole would have shown, the factor that each sole multiplies forces by, and how far its clock runs ahead.
    """

    pressure: FootPressure
    times_s: Float[np.ndarray, " sample"]
    vertical_n: Float[np.ndarray, "sample foot"]
    cop_foot_m: Float[np.ndarray, "sample foot 2"]
    gain: Float[np.ndarray, " foot"]
    offset_s: float
