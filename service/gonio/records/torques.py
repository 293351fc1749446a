"""Joint torques with their error bands."""

import numpy as np
from jaxtyping import Float

from gonio.records.record import record


@record
class Torques:
    """The generalized forces of a body's coordinates, Nm and N, in the coordinates' own sense; NaN where not known.

    ``sd_shear`` is the standard deviation from the shear that nothing measured, ``sd_rest`` that from errors of the movement,
    of the soles and their clock. ``band`` is half the width of a 95 % band of both. ``power_w`` is force times rate.
    ``residual`` is what the root's six coordinates would need: force then moment at the pelvis, in the lab, that nothing
    provides.
    """

    coordinate_names: tuple[str, ...]
    times_s: Float[np.ndarray, " frame"]
    values: Float[np.ndarray, "frame coordinate"]
    power_w: Float[np.ndarray, "frame coordinate"]
    sd_shear: Float[np.ndarray, "frame coordinate"]
    sd_rest: Float[np.ndarray, "frame coordinate"]
    band: Float[np.ndarray, "frame coordinate"]
    residual: Float[np.ndarray, "frame 6"]

    def index(self, name: str) -> int:
        """Give the position of a coordinate by name; ValueError if there is none."""
        return self.coordinate_names.index(name)
