"""Turn the lab so that the subject walks towards +X, as OpenSim and ISB have it."""

import numpy as np
from jaxtyping import Float

WALKED_M = 1.0
"""A subject whose pelvis travels less than this is standing: its heading is where it faces."""


def heading_rad(left_hip_lab_m: Float[np.ndarray, "frame 3"], right_hip_lab_m: Float[np.ndarray, "frame 3"]) -> float:
    """Give the subject's heading as an angle about the vertical (Y): 0 is +X, a quarter turn is -Z.

    For a walk it is the direction from the pelvis' first to its last known place; else the mean direction that the hip
    line faces. NaN frames are left out; without any known frame the heading is 0.
    """
    middle = (left_hip_lab_m + right_hip_lab_m) / 2
    known = np.isfinite(middle[:, 0])
    if not known.any():
        return 0.0
    travel = middle[known][-1] - middle[known][0]
    if np.hypot(travel[0], travel[2]) >= WALKED_M:
        forward = travel
    else:
        to_the_right = (right_hip_lab_m - left_hip_lab_m)[known]
        facing = np.cross([0.0, 1.0, 0.0], to_the_right)  # up × right = forward
        forward = (facing / np.linalg.norm(facing, axis=-1, keepdims=True)).mean(axis=0)
    return float(np.arctan2(-forward[2], forward[0]))
