"""The soles of a body: its heels, toe joints and tips of the toes, by OpenSim's feet.

The bodies are OpenSim's: ``calcn`` begins at the back of the heel, ``toes`` at the toe joint, X along the foot.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.kernel.body.forward import body_poses
from gonio.records import FEET, BodyModel, Markers

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
