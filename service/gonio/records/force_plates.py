"""What force plates measured."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.records.record import record


@record
class ForcePlates:
    """The ground's force on whatever stands on each plate, in the lab.

    ``force_lab_n`` points upwards under a load. ``cop_lab_m`` is where it pierces the plate's surface, NaN while the plate
    carries next to nothing; ``free_moment_nm`` turns about the upward axis through it. ``corners_lab_m`` bounds each plate;
    NaN where the file does not say.
    """

    source: str
    times_s: Float[np.ndarray, " sample"]
    force_lab_n: Float[np.ndarray, "sample plate 3"]
    cop_lab_m: Float[np.ndarray, "sample plate 3"]
    free_moment_nm: Float[np.ndarray, "sample plate"]
    corners_lab_m: Float[np.ndarray, "plate 4 3"]


@record
class FootForces:
    """What the ground did to each foot (right, left), as plates measured it, in the lab.

    ``wrench`` is force, then moment about the lab's origin: zero while the foot is in the air, NaN while it stands where no
    plate measures it alone. ``cop_lab_m`` is NaN wherever there is no force. ``shared`` marks when both feet stood on one
    plate, which then tells of neither.
    """

    times_s: Float[np.ndarray, " frame"]
    wrench: Float[np.ndarray, "frame foot 6"]
    cop_lab_m: Float[np.ndarray, "frame foot 3"]
    shared: Bool[np.ndarray, " frame"]
