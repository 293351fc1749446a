"""Solve one joint: many starts, the lowest loss wins, wrong marks are thrown out, and what can't be told is refused."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.bundle import Sights, adjust, whitened
from gonio.kernel.articulated.motion import Motions, unknowns
from gonio.kernel.articulated.observability import Sensitivity, check_moving_camera, check_observed, refuse, sensitivity
from gonio.kernel.articulated.starts import places, random_starts
from gonio.records import JointKind

STARTS, SCREENED, KEPT = 30, 12, 5
"""So many starts get so many steps; so many of them are then followed to the end."""

MIN_POINTS = 6
"""Fewer points can have several exact solutions."""

HINGE_RATIO = 0.08
"""Turns whose second principal direction is below this share of the first are about one axis: a true hinge gives 0.004 at
0.3 px and 0.013 at 1 px, a joint with three freedoms 0.30 at its 5th percentile."""

REJECT = 4.5
"""A mark that is off by more standard deviations is wrong: one good mark in 25 000 is."""

FINEST_PX = 1e-3
"""No mark is taken to be better than this: what stands on the floor would count for nothing beside it."""

HINGE_FITS = 1.3
"""A hinge whose loss is below this multiple of the joint's with three freedoms is the right one: the freedoms that it lacks,
2 n − 4 in n pictures, leave a few times the noise of as many marks."""

TWIN = 1.2
"""A second answer whose loss is below this multiple of the best can't be told from it."""

TWIN_RAD = 0.1
"""Answers that differ by less than this turn in all pictures are the same."""


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
        scale_known: Whether a free joint's size is going to be fixed afterwards, by a known length.
        seed: Of the random starts.

    Raises:
        CaptureError: One of :data:`~gonio.kernel.articulated.observability.REFUSALS`.
    """
    sights = replace(sights, used=sights.used & ((sights.used.sum(axis=0) >= 2) | sights.floor.any(axis=0)))
    if sights.used.any(axis=0).sum() < MIN_POINTS:
        raise refuse("too-few-points", part)
    if kind == "free" and not scale_known and not (sights.floor & sights.used).any():
        raise refuse("scale-unobservable", part)
    check_moving_camera(kind, sights, part)
    motions, x_m, other = _search(kind, sights, seed, part)
    motions, x_m, sights, sigma_px = _purge(kind, sights, motions, x_m)
    found_hinge = False
    if kind == "spherical" and _axis_ratio(motions)[0] < HINGE_RATIO and _largest_turn(motions) > 0.02:
        kind, found_hinge, other = "hinge", True, None
        motions = _as_hinge(replace(motions, axis=_axis_ratio(motions)[1][None]), x_m)
        motions, x_m, _ = adjust(kind, sights, motions, x_m, iterations=100)
        motions, x_m, sights, sigma_px = _purge(kind, sights, motions, x_m)
    found = sensitivity(kind, sights, motions, x_m)
    if not scale_known:
        check_observed(kind, sights, motions, x_m, found, part)
    return Solution(kind, motions, x_m, sights, found, sigma_px, found_hinge, other)


def _search(
    kind: JointKind, sights: Sights, seed: int, part: str
) -> tuple[Motions, Float[np.ndarray, "1 point 3"], Motions | None]:
    at_m = places(sights, kind, None)
    # A hinge is sought with three freedoms first: an axis that starts wrong is a trap.
    sought: JointKind = "spherical" if kind == "hinge" else kind
    motions, x_m = random_starts(sights, sought, at_m, STARTS, seed)
    motions, x_m, cost = adjust(sought, sights, motions, x_m, iterations=SCREENED)
    if not np.isfinite(cost).any():
        raise refuse("not-observable", part)
    best = np.argsort(cost)[:KEPT]
    # Along its axis a hinge leaves the centre free to creep: what it has after a few more steps is as good.
    more = 80 if sought == kind else 20
    motions, x_m, cost = adjust(sought, sights, motions.pick(best), x_m[best], iterations=more)
    order = np.argsort(cost)
    first = order[:1]
    if kind == "hinge":
        return *_search_hinge(sights, motions.pick(first), x_m[first], float(cost[order[0]]), at_m, seed), None
    for twin in order[1:]:
        relative = motions.R[twin] @ motions.R[first[0]].swapaxes(-1, -2)
        if cost[twin] < TWIN * cost[first[0]] and Rotation.from_matrix(relative).magnitude().max() > TWIN_RAD:
            return motions.pick(first), x_m[first], motions.pick(np.array([twin]))
    return motions.pick(first), x_m[first], None


def _search_hinge(
    sights: Sights,
    motions: Motions,
    x_m: Float[np.ndarray, "1 point 3"],
    looser: float,
    at_m: Float[np.ndarray, "picture 3"],
    seed: int,
) -> tuple[Motions, Float[np.ndarray, "1 point 3"]]:
    """Take the better of the hinge next to the joint of three freedoms, and of those that random axes lead to.

    ``looser`` is that joint's loss: no hinge's is below it, so that one which comes near it needs no others beside it.
    """
    near = _as_hinge(replace(motions, axis=_axis_ratio(motions)[1][None]), x_m)
    near, near_X, near_cost = adjust("hinge", sights, near, x_m, iterations=80)
    if near_cost[0] < HINGE_FITS * looser:
        return near, near_X
    far, far_X = random_starts(sights, "hinge", at_m, STARTS, seed)
    far, far_X, cost = adjust("hinge", sights, far, far_X, iterations=SCREENED)
    best = np.argsort(cost)[:KEPT]
    far, far_X, cost = adjust("hinge", sights, far.pick(best), far_X[best], iterations=80)
    first = np.array([int(np.argmin(cost))])
    return (far.pick(first), far_X[first]) if cost[first[0]] < 0.999 * near_cost[0] else (near, near_X)


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


def _purge(
    kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]
) -> tuple[Motions, Float[np.ndarray, "1 point 3"], Sights, float]:
    """Throw out wrong marks until none is left, and tell the noise of the rest."""
    marked = sights.used
    for _ in range(6):
        r, _ = whitened(sights.with_noise(1.0), motions.moved(x_m))
        size = np.hypot(r[0, ..., 0], r[0, ..., 1])
        sigma = _noise(size[sights.used], kind, sights.used)
        r_all, _ = whitened(replace(sights, used=marked, sigma_px=sigma), motions.moved(x_m))
        believed = marked & (np.hypot(r_all[0, ..., 0], r_all[0, ..., 1]) < REJECT)
        believed &= (believed.sum(axis=0) >= 2) | (sights.floor & believed).any(axis=0)
        if believed.any(axis=0).sum() < MIN_POINTS:
            break
        same = (believed == sights.used).all()
        sights = replace(sights, used=believed, sigma_px=sigma)
        motions, x_m, _ = adjust(kind, sights, motions, x_m, iterations=60)
        if same:
            break
    r, _ = whitened(sights, motions.moved(x_m))
    freedom = max(1, 2 * sights.used.sum() - 3 * sights.used.any(axis=0).sum() - unknowns(kind, len(sights.used)))
    sigma = sights.sigma_px * float(np.sqrt((r[..., :2] ** 2).sum() / freedom))
    return motions, x_m, sights.with_noise(max(sigma, FINEST_PX)), sigma


def _noise(size_px: Float[np.ndarray, " mark"], kind: JointKind, used: Bool[np.ndarray, "picture point"]) -> float:
    """Tell the noise from the median of the distances, Rayleigh distributed, and what the unknowns took of it."""
    count = 2 * used.sum()
    left = max(0.1, 1 - (3 * used.any(axis=0).sum() + unknowns(kind, len(used))) / count)
    return float(max(np.median(size_px) / 1.1774 / np.sqrt(left), 1e-7))
