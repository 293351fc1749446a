"""The body's shape: capsules along its segments, good enough to hide a knee behind a thigh."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.body.forward import body_poses
from gonio.kernel.virtual_lab.steps import REFERENCE_LEG_M, leg_length_m
from gonio.records import BodyModel

# From the origin of one body (a joint) to that of another, or to a point of the same one; radii of an ordinary adult, our
# own estimates of limbs in clothes. Lengths in metres for the built-in man; they scale with the leg.
_TRUNK = (
    ("pelvis", "femur_r", "femur_l", (0.0, 0.0, 0.0), 0.11),
    ("trunk", "torso", "head", (0.0, -0.08, 0.0), 0.13),
    ("shoulders", "humerus_r", "humerus_l", (0.0, 0.0, 0.0), 0.06),
    ("head", "head", "head", (0.03, 0.17, 0.0), 0.09),
)
_LIMBS = (
    ("thigh", "femur", "tibia", (0.0, 0.0, 0.0), 0.075),
    ("shank", "tibia", "talus", (0.0, 0.0, 0.0), 0.05),
    ("foot", "calcn", "toes", (0.04, 0.01, 0.0), 0.035),
    ("upper arm", "humerus", "radius", (0.0, 0.0, 0.0), 0.045),
    ("forearm", "radius", "hand", (0.0, 0.0, 0.0), 0.037),
    ("hand", "hand", "hand", (0.0, -0.09, 0.0), 0.035),
)

DEPTH_M = 0.05
"""A keypoint lies inside its limb: it is hidden only by what is in front of it by more than a radius and this."""


class Capsules(NamedTuple):
    """Which bodies the capsules hang on, and how thick they are."""

    names: tuple[str, ...]
    start_body: Int[np.ndarray, " capsule"]
    end_body: Int[np.ndarray, " capsule"]
    end_m: Float[np.ndarray, "capsule 3"]  # in the end body
    radius_m: Float[np.ndarray, " capsule"]


class Placed(NamedTuple):
    """Capsules in the lab, over time."""

    start_m: Float[np.ndarray, "frame capsule 3"]
    end_m: Float[np.ndarray, "frame capsule 3"]
    radius_m: Float[np.ndarray, " capsule"]


def capsules_of(body: BodyModel) -> Capsules:
    """Give a built-in body its capsules."""
    listed = list(_TRUNK)
    for letter in "rl":
        listed += [(f"{name} {letter}", f"{a}_{letter}", f"{b}_{letter}", end, r) for name, a, b, end, r in _LIMBS]
    scale = leg_length_m(body) / REFERENCE_LEG_M
    index = body.bodies.index
    return Capsules(
        names=tuple(name for name, *_ in listed),
        start_body=np.array([index(start) for _, start, *_ in listed]),
        end_body=np.array([index(end) for _, _, end, *_ in listed]),
        end_m=scale * np.array([end for *_, end, _ in listed]),
        radius_m=scale * np.array([radius for *_, radius in listed]),
    )


def place(body: BodyModel, capsules: Capsules, q: Float[np.ndarray, "frame coordinate"]) -> Placed:
    """Put the capsules where the body is."""
    T_lab_body = body_poses(body, q)
    start, end = T_lab_body[:, capsules.start_body], T_lab_body[:, capsules.end_body]
    return Placed(
        start_m=start[..., :3, 3],
        end_m=np.einsum("fcij,cj->fci", end[..., :3, :3], capsules.end_m) + end[..., :3, 3],
        radius_m=capsules.radius_m,
    )


def hidden(
    centre_m: Float[np.ndarray, "3"], points_m: Float[np.ndarray, "frame keypoint 3"], placed: Placed
) -> Bool[np.ndarray, "frame keypoint"]:
    """Tell which points the body hides from a camera: those with the surface of a capsule well in front of them."""
    sight = points_m - centre_m
    distance_m = np.linalg.norm(sight, axis=-1)
    sight = sight / distance_m[..., None]
    behind = np.zeros(distance_m.shape, dtype=bool)
    for number, radius_m in enumerate(placed.radius_m):
        start, end = placed.start_m[:, number, None], placed.end_m[:, number, None]
        entry_m = _enter(centre_m, sight, start, end, radius_m)
        behind |= entry_m < distance_m - radius_m - DEPTH_M
    return behind


def _enter(
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "frame keypoint 3"],
    start: Float[np.ndarray, "frame 1 3"],
    end: Float[np.ndarray, "frame 1 3"],
    radius: float,
) -> Float[np.ndarray, "frame keypoint"]:
    """Give the distance at which rays enter a capsule; infinity where they miss it.

    A ray meets the cylinder where its distance from the axis' line is the radius; beyond the axis' ends, the balls count.
    """
    axis, offset = end - start, origin - start
    length2 = (axis * axis).sum(-1)
    along, ahead = (axis * direction).sum(-1), (axis * offset).sum(-1)
    a = np.maximum(length2 - along**2, 1e-12)
    b = length2 * (direction * offset).sum(-1) - ahead * along
    c = length2 * ((offset * offset).sum(-1) - radius**2) - ahead**2
    with np.errstate(invalid="ignore"):
        entry = (-b - np.sqrt(b * b - a * c)) / a
        where = ahead + entry * along
        ball = np.where((where <= 0)[..., None], offset, origin - end)
        toward = (direction * ball).sum(-1)
        to_ball = -toward - np.sqrt(toward**2 - (ball * ball).sum(-1) + radius**2)
    entry = np.where((where > 0) & (where < length2), entry, to_ball)
    return np.where(np.isnan(entry), np.inf, entry)
