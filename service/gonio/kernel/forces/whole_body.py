"""What finding forces needs of the movement: the whole body's momentum, its heading, and the soles' places."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from gonio.kernel.body.forward import body_poses
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.records import FEET, BodyModel

HEADING_S = 1.0
"""The pelvis' direction is averaged for so long: it turns to and fro with each step."""


class WholeBody(NamedTuple):
    """The movement of the body in the lab.

    ``need_n`` is the force that it needs from outside in all, m (a − g); ``turning_nm`` the rate of its angular momentum about
    the centre of mass. ``heading_lab`` is level and of unit length. ``T_lab_heel`` and ``T_lab_toes`` place the feet's two
    segments, ``ball_m`` the toe joint in the heel's.
    """

    times_s: Float[np.ndarray, " frame"]
    com_lab_m: Float[np.ndarray, "frame 3"]
    need_n: Float[np.ndarray, "frame 3"]
    turning_nm: Float[np.ndarray, "frame 3"]
    heading_lab: Float[np.ndarray, "frame 3"]
    T_lab_heel: Float[np.ndarray, "frame foot 4 4"]
    T_lab_toes: Float[np.ndarray, "frame foot 4 4"]
    ball_m: Float[np.ndarray, "foot 3"]
    weight_n: float

    @property
    def rate_hz(self) -> float:
        """How many frames there are in a second."""
        return (len(self.times_s) - 1) / float(self.times_s[-1] - self.times_s[0])

    @property
    def right_lab(self) -> Float[np.ndarray, "frame 3"]:
        """The level direction to the right of the heading."""
        return np.cross(self.heading_lab, [0.0, 1.0, 0.0])


def observe(model: BodyModel, motion: SmoothMotion) -> WholeBody:
    """Compute what forces need of a motion; a frame with a NaN gives NaN.

    Raises:
        InputError: the model has no pelvis or no feet (``pelvis``, ``calcn_r``, ``toes_r``, ``calcn_l``, ``toes_l``).
    """
    whole = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration)
    poses, index = body_poses(model, motion.q), model.bodies.index
    heel, toes = (
        np.stack([poses[:, index(f"{part}_{side[0]}")] for side in FEET], axis=1) for part in ("calcn", "toes")
    )
    rest = body_poses(model, model.coordinates.default[None])[0]
    ball = [
        rest[index(f"calcn_{side[0]}"), :3, :3].T
        @ (rest[index(f"toes_{side[0]}"), :3, 3] - rest[index(f"calcn_{side[0]}"), :3, 3])
        for side in FEET
    ]
    return WholeBody(
        times_s=motion.times_s,
        com_lab_m=whole.com_lab_m,
        need_n=whole.net_force_n,
        turning_nm=whole.net_moment_com_nm,
        heading_lab=_heading(motion.times_s, poses[:, index("pelvis"), :3, 0]),
        T_lab_heel=heel,
        T_lab_toes=toes,
        ball_m=np.array(ball),
        weight_n=model.weight_n,
    )


def cop_in_lab(body: WholeBody, cop_foot_m: Float[np.ndarray, "frame foot 2"]) -> Float[np.ndarray, "frame foot 3"]:
    """Give where centres of pressure on the soles lie in the lab, put on the floor y = 0.

    A sole bends at the toe joint: what lies beyond it moves with the toes.
    """
    flat = np.stack([cop_foot_m[..., 0], np.zeros_like(cop_foot_m[..., 0]), cop_foot_m[..., 1]], axis=-1)
    beyond = cop_foot_m[..., :1] > body.ball_m[:, :1]
    from_ball = flat - body.ball_m * [1.0, 0.0, 1.0]
    place = np.where(beyond, _at(body.T_lab_toes, from_ball), _at(body.T_lab_heel, flat))
    return place * [1.0, 0.0, 1.0]


def _at(T_lab_part: Float[np.ndarray, "frame foot 4 4"], place_m: np.ndarray) -> np.ndarray:
    return np.einsum("sfij,sfj->sfi", T_lab_part[..., :3, :3], place_m) + T_lab_part[..., :3, 3]


def _heading(times_s: Float[np.ndarray, " frame"], forwards: Float[np.ndarray, "frame 3"]) -> np.ndarray:
    """Give the level direction, averaged over time; gaps are bridged, for what they cut off is NaN anyway."""
    level = forwards[:, [0, 2]] / np.linalg.norm(forwards[:, [0, 2]], axis=1, keepdims=True)
    known = np.isfinite(level).all(axis=1)
    if not known.any():
        return np.full_like(forwards, np.nan)
    level = np.stack([np.interp(times_s, times_s[known], axis[known]) for axis in level.T], axis=1)
    size = max(round(HEADING_S * (len(times_s) - 1) / float(times_s[-1] - times_s[0])), 1)
    mean = uniform_filter1d(level, size, axis=0, mode="nearest")
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    return np.stack([mean[:, 0], np.zeros(len(mean)), mean[:, 1]], axis=1)
