"""What pressure soles measured."""

import numpy as np
from jaxtyping import Float

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
