"""Solve one joint: search for its motion, take a hinge for what it is, and refuse what the pictures can't tell."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.bundle import Sights, adjust
from gonio.kernel.articulated.motion import Motions
from gonio.kernel.articulated.observability import Sensitivity, check_moving_camera, check_observed, refuse, sensitivity
from gonio.kernel.articulated.search import MIN_POINTS, Answer, believe, search
from gonio.kernel.articulated.starts import places, random_starts
from gonio.records import JointKind

STARTS, SCREENED, KEPT = 30, 12, 5
"""So many starts of a hinge about random axes get so many steps; so many of them are then followed to the end."""

HINGE_RATIO = 0.08
"""Turns whose second principal direction is below this share of the first are about one axis: a true hinge gives 0.004 at
0.3 px and 0.013 at 1 px, a joint with three freedoms 0.30 at its 5th percentile."""


@dataclass(frozen=True)
class Solution:
    """A joint's motion in the frame that the solver works in; arrays have one start."""

    kind: JointKind
    motions: Motions
    x_m: Float[np.ndarray, "1 point 3"]
    sights: Sights
    found: Sensitivity
    sigma_px: float
    found_hinge: bool
    other: Motions | None


def solve(kind: JointKind, sights: Sights, part: str, *, scale_known: bool = False, seed: int = 0) -> Solution:
    """Find a joint's motion without any guess.

    Args:
        kind: What the joint may do. A spherical joint that turns about one axis only is solved again as a hinge.
        sights: Marks and cameras; its ``sigma_px`` is only a first idea of the noise.
        part: The part's name, for errors.
        scale_known: Whether the part's size is going to be fixed afterwards, by a known length; what can be told is then
            checked afterwards, too.
        seed: Of the random starts.

    Raises:
        CaptureError: One of :data:`~gonio.kernel.articulated.observability.REFUSALS`.
    """
    sights = replace(sights, used=sights.used & ((sights.used.sum(axis=0) >= 2) | sights.floor.any(axis=0)))
    if sights.used.any(axis=0).sum() < MIN_POINTS:
        raise refuse("too-few-points", part)
    if kind == "free" and not scale_known and not (sights.floor & sights.used).any():
        raise refuse("scale-unobservable", part)
    check_moving_camera(kind, sights, part, scale_known=scale_known)
    # A hinge is sought with three freedoms first: an axis that starts wrong is a trap.
    answer, twin = search("spherical" if kind == "hinge" else kind, sights, seed, part)
    found_hinge = False
    if kind == "hinge":
        answer, twin = _hinge(sights, answer, seed), None
    elif kind == "spherical" and _axis_ratio(answer.motions)[0] < HINGE_RATIO and _largest_turn(answer.motions) > 0.02:
        kind, found_hinge, twin = "hinge", True, None
        answer = believe("hinge", sights, *_next_hinge(answer))
    found = sensitivity(kind, answer.sights, answer.motions, answer.x_m)
    if not scale_known:
        check_observed(kind, answer.sights, answer.motions, answer.x_m, found, part)
    return Solution(
        kind, answer.motions, answer.x_m, answer.sights, found, answer.sigma_px, found_hinge, twin and twin.motions
    )


def _hinge(sights: Sights, looser: Answer, seed: int) -> Answer:
    """Take the better of the hinge next to the joint of three freedoms, and of those that random axes lead to.

    A hinge has fewer unknowns than that joint, so that a right one explains more; then no others are sought.
    """
    near = believe("hinge", sights, *_next_hinge(looser))
    if near.evidence >= looser.evidence:
        return near
    far, x_m = random_starts(sights, "hinge", places(sights, "hinge", None), STARTS, seed)
    far, x_m, cost = adjust("hinge", sights, far, x_m, iterations=SCREENED)
    best = np.argsort(cost)[:KEPT]
    far, x_m, cost = adjust("hinge", sights, far.pick(best), x_m[best], iterations=80)
    first = np.array([int(np.argmin(cost))])
    if not np.isfinite(cost[first[0]]):
        return near
    other = believe("hinge", sights, far.pick(first), x_m[first])
    return other if other.evidence > near.evidence else near


def _next_hinge(answer: Answer) -> tuple[Motions, Float[np.ndarray, "1 point 3"]]:
    """Give the hinge next to a joint of three freedoms, by the marks that this believes."""
    hinge = _as_hinge(replace(answer.motions, axis=_axis_ratio(answer.motions)[1][None]), answer.x_m)
    motions, x_m, _ = adjust("hinge", answer.sights, hinge, answer.x_m, iterations=80)
    return motions, x_m


def _axis_ratio(motions: Motions) -> tuple[float, Float[np.ndarray, "3"]]:
    _, values, axes = np.linalg.svd(Rotation.from_matrix(motions.R[0]).as_rotvec())
    return float(values[1] / max(values[0], 1e-12)), axes[0]


def _largest_turn(motions: Motions) -> float:
    return float(Rotation.from_matrix(motions.R[0]).magnitude().max())


def _as_hinge(motions: Motions, x_m: Float[np.ndarray, "1 point 3"]) -> Motions:
    """Keep of each turn what is about the axis, and of the axis's points the one next to the part's middle."""
    axis = motions.axis[0]
    angle = Rotation.from_matrix(motions.R[0]).as_rotvec() @ axis
    R = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    away = x_m[0].mean(axis=0) - motions.centre[0]
    centre = motions.centre[0] + axis * (away @ axis)
    return Motions(R[None], (centre - R @ centre)[None], centre[None], axis[None])
