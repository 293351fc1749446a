"""A calibration board of the virtual laboratory, beside its truth."""

import numpy as np
from jaxtyping import Float

from gonio.records.record import record


@record
class VirtualBoard:
    """Where cameras saw the corners of a board that is waved about, and where it was.

    ``uv_px`` is what they report (NaN: not seen), ``exact_px`` where the corners were in their pictures, seen or not.
    ``T_lab_board`` is the board's pose at the nominal times; each camera took its pictures at times of its own.
    """

    times_s: Float[np.ndarray, " frame"]
    camera_times_s: Float[np.ndarray, "camera frame"]
    T_lab_board: Float[np.ndarray, "frame 4 4"]
    uv_px: Float[np.ndarray, "camera frame corner 2"]
    exact_px: Float[np.ndarray, "camera frame corner 2"]
