"""The soles: which points of a foot touch the ground, and where they stand."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.kernel.body.forward import body_poses
from gonio.records import FEET, BodyModel, Markers, Steps

HEEL, BALL, EDGE, TIP = range(4)
"""Points of a sole: the back of the heel, the toe joint, a point beside it on the outer edge, and the tip of the toes."""

_TIP = 0.36  # from the toe joint to the tip, over the distance from heel to toe joint: 65 mm of 180 mm in a man's foot
_EDGE = 0.17


class Sole(NamedTuple):
    """A foot's measures: where the toe joint lies in the heel's frame, and how far it is, m."""

    ball_m: Float[np.ndarray, "foot 3"]
    length_m: float


def measure_sole(body: BodyModel) -> Sole:
    """Measure the feet in the default pose, in which they stand level."""
    T_lab_body = body_poses(body, body.coordinates.default[None])[0]
    origin = T_lab_body[:, :3, 3]
    ball = [
        origin[body.bodies.index(f"toes_{side[0]}")] - origin[body.bodies.index(f"calcn_{side[0]}")] for side in FEET
    ]
    return Sole(np.array(ball), float(ball[0][0]))


def mark_soles(body: BodyModel) -> BodyModel:
    """Give the body the points of its soles as its only markers: those of the right foot, then those of the left."""
    length = measure_sole(body).length_m
    owners, places, names = [], [], []
    for side, outwards in zip(FEET, (1.0, -1.0), strict=True):
        heel, toes = (body.bodies.index(f"{name}_{side[0]}") for name in ("calcn", "toes"))
        owners += [heel, toes, toes, toes]
        places += [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, outwards * _EDGE * length), (_TIP * length, 0.0, 0.0)]
        names += [f"{side}_{point}" for point in ("heel", "ball", "edge", "tip")]
    markers = Markers(
        names=tuple(names),
        body=np.array(owners),
        location_body_m=np.array(places),
        fixed=np.ones(len(names), dtype=bool),
    )
    return replace(body, markers=markers)


def directions(steps: Steps) -> Float[np.ndarray, "foot 3 3"]:
    """Give the turn R_lab_foot of each foot that stands flat: outwards by the toe-out angle."""
    turns = np.zeros((len(FEET), 3, 3))
    for foot, outwards in enumerate((1.0, -1.0)):
        c, s = np.cos(steps.toe_out_rad), outwards * np.sin(steps.toe_out_rad)
        turns[foot] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    return turns


def heels_on_floor(steps: Steps, stride_phase: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node foot 3"]:
    """Give where the heels stand, in the frame that walks along at the mean speed: they drift back from each strike on."""
    places = np.zeros((len(stride_phase), len(FEET), 3))
    for foot in range(len(FEET)):
        places[:, foot, 0] = -steps.speed_m_s * steps.stride_s * steps.phase(foot, stride_phase)
        places[:, foot, 2] = steps.heel_z_m[foot]
    return places


def load_shares(steps: Steps, stride_phase: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node foot"]:
    """Give each foot's share of the vertical force: 0 in swing, 1 alone, a smooth exchange while both feet stand.

    The exchange is the polynomial 10 u³ − 15 u⁴ + 6 u⁵ of the time u since the strike, over the time of double support:
    its first and second derivatives vanish at both ends, so that forces start and end without a jerk.
    """
    shares = np.empty((len(stride_phase), len(FEET)))
    for foot in range(len(FEET)):
        phase, other = steps.phase(foot, stride_phase), steps.phase(1 - foot, stride_phase)
        # The other foot's double support with this one begins at this foot's strike and ends when the other leaves.
        rise_time = np.mod(steps.strike[1 - foot] + steps.stance[1 - foot] - steps.strike[foot], 1.0)
        fall_time = np.mod(steps.strike[foot] + steps.stance[foot] - steps.strike[1 - foot], 1.0)
        falling = np.where(other <= phase, _exchange(other / fall_time), 0.0)
        shares[:, foot] = _exchange(phase / rise_time) * (1.0 - falling)
        shares[phase >= steps.stance[foot], foot] = 0.0
    return shares


def _exchange(u: Float[np.ndarray, " node"]) -> Float[np.ndarray, " node"]:
    u = np.clip(u, 0.0, 1.0) ** 0.7
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
