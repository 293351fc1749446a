"""A flat background, a floor or a wall: first guesses from its homographies, and whether they tell the cameras at all.

A plane tells little of focal lengths: there may be two answers, or a valley of the loss, which the slopes at its deepest
point do not always show. So the answers that were met on the way are kept, and held against the error bars.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.background_bundle import EACH, SHARED, Guess, Problem, residuals
from gonio.kernel.articulated.background_refusals import refuse
from gonio.kernel.articulated.growing import (
    FOCALS,
    LONGEST,
    MIN_COMMON,
    MIN_KNOWN,
    TRIED,
    WIDEST,
    adjust_inside,
    extend,
    nothing_known,
    place_points,
    spread_points,
)
from gonio.kernel.articulated.plane import Plane, plane_cameras
from gonio.kernel.articulated.two_views import fit_homography, turn_rms_px

PICTURES = 5
"""So many pictures tell which answer is right; more follow them."""

TURNED_PX = 3.0
"""A turn that leaves no more than this multiple of the noise explains a pair."""

TOLD_APART = 3.0
"""The evidence of two answers, which differ in where the points are, differs by √points for noise alone; so many times that
tells them apart."""

ANSWERS = 5
"""At most so many answers are followed."""

APART_SD, SAME_ANSWER = 4.0, 0.01
"""Answers that differ by more than so many standard deviations, and by so many radians, are two."""

UNSURE_LOSS = 9.0
"""Cameras beyond the error bars must cost three standard deviations more."""


@dataclass(frozen=True)
class Valley:
    """What the descents of a flat background's core came through: cameras, and their loss for a noise of ``noise_px``."""

    core: list[int]
    noise_px: float
    passed: list[tuple[Guess, float]]


NO_VALLEY = Valley([], 1.0, [])


def before_plane(
    problem: Problem, uv: np.ndarray, seed: int, *, still: bool
) -> tuple[list[tuple[Bool[np.ndarray, "picture point"], Guess]], Valley]:
    """Find the cameras from the homographies of a background that is flat, or nearly; none if the camera only turned.

    Raises:
        CaptureError: The camera only turned, and that is all that the marks show (``still``).
    """
    used, lens, noise = problem.used, problem.background.lens, problem.sigma_px.max()
    first, homographies = _homographies(used, uv, seed)
    focal = np.where(np.isfinite(lens.focal_px), lens.focal_px, max(lens.image_size_px))
    turned = [
        turn_rms_px(uv[first, on], uv[i, on], focal[[first, i]], ~problem.free_focals[[first, i]]) < TURNED_PX * noise
        for i, (_, on) in homographies.items()
    ]
    if all(turned):
        if still and turned:
            raise refuse("background-camera-static")
        return [], NO_VALLEY
    core = [first, *homographies]
    believed = used.copy()
    believed[core[1:]] = [on for _, on in homographies.values()]
    believed[first] = believed[core[1:]].any(axis=0)
    candidates, nearer = _core_answers(problem, uv, core, [H for H, _ in homographies.values()], believed, seed)
    out, others = [], used.copy()
    others[first] = False  # a point that fits no homography is wrong in their common picture
    for found, _ in nearer:
        grown = extend(replace(problem, used=believed), uv, found, core, seed)
        if any((_apart(grown, other, first) < SAME_ANSWER).all() for _, other in out):
            continue
        out.append((believed, place_points(replace(problem, used=others), uv, grown, list(range(len(used))))))
    # More pictures than the core tell more.
    return out, Valley(core, float(noise), candidates) if len(core) == len(used) else NO_VALLEY


def _core_answers(
    problem: Problem, uv: np.ndarray, core: list[int], homographies: list[np.ndarray],
    believed: Bool[np.ndarray, "picture point"], seed: int,
) -> tuple[list[tuple[Guess, float]], list[tuple[Guess, float]]]:  # fmt: skip
    """Adjust all cameras that the homographies allow; gives all states that were met, and the answers worth following."""
    used, lens, first = problem.used, problem.background.lens, core[0]
    on_plane = np.asarray(believed[first])
    plane = Plane(
        np.stack([np.eye(3), *homographies]),
        uv[first, on_plane],
        np.array([np.nanstd(uv[i, used[i]], axis=0).mean() for i in core]),
        lens.focal_px[core],
        np.geomspace(WIDEST, LONGEST, FOCALS) * max(lens.image_size_px),
    )
    narrow = replace(problem, used=believed & spread_points(used, on_plane, seed))
    candidates = []
    for cameras in plane_cameras(plane):
        guess = nothing_known(used)
        guess.R[core], guess.t[core], guess.log_f[core] = cameras.R, cameras.t, np.log(cameras.f)
        guess.x_m[on_plane] = cameras.on_plane(uv[first, on_plane])
        candidates.append(adjust_inside(narrow, guess, core, 12))
    nearer = [adjust_inside(narrow, found, core, 60) for found, _ in _distinct(candidates, core)]
    # At first sight, more than the final comparison allows.
    allowed = np.exp(4 * TOLD_APART * np.sqrt(narrow.used.any(axis=0).sum()) / max(1, narrow.freedom))
    worst = allowed * min((cost for _, cost in nearer), default=0.0)
    return [*candidates, *nearer], [each for each in _distinct(nearer, core) if each[1] <= worst]


def _distinct(candidates: list[tuple[Guess, float]], core: list[int]) -> list[tuple[Guess, float]]:
    """Give the best candidates that differ, at most :data:`ANSWERS`."""
    out: list[tuple[Guess, float]] = []
    for guess, cost in sorted(candidates, key=lambda each: each[1]):
        if len(out) < ANSWERS and not any(
            (_apart(guess, other, core[0])[core] < SAME_ANSWER).all() for other, _ in out
        ):
            out.append((guess, cost))
    return out


def _apart(one: Guess, other: Guess, first: int) -> Float[np.ndarray, "picture 4"]:
    """Give how the pictures' turns against the first, and their logarithms of focal lengths, differ."""
    turns, others = (each.R @ each.R[first].T for each in (one, other))
    turned = Rotation.from_matrix(turns @ others.swapaxes(-1, -2)).as_rotvec()
    return np.abs(np.column_stack([turned, one.log_f - other.log_f]))


def _homographies(
    used: Bool[np.ndarray, "picture point"], uv: np.ndarray, seed: int
) -> tuple[int, dict[int, tuple[np.ndarray, np.ndarray]]]:
    """Give a picture of the plane, and from it to others that share most with it the homographies and their marks."""
    shared = used.astype(int) @ used.T
    shared[range(len(used)), range(len(used))] = 0
    first = int(np.argmax(np.minimum(shared, TRIED).sum(axis=1)))
    out = {}
    for i in np.argsort(-shared[first])[: PICTURES - 1]:
        if shared[first, i] < MIN_COMMON:
            continue
        common = np.flatnonzero(used[first] & used[i])
        H, fits = fit_homography(uv[first, common], uv[i, common], seed)
        if fits.sum() >= MIN_KNOWN:
            out[int(i)] = H, np.isin(np.arange(used.shape[1]), common[fits])
    return first, out


def told_heights(problem: Problem, guess: Guess) -> Guess:
    """Take the noise out of the points' distances from the plane through them.

    What a nearly flat background tells of the focal lengths is in the squares of these distances; noise adds its variances
    to them, and would make a plane tell what it does not.
    """
    points = problem.used.sum(axis=0) >= 2
    *_, by_x = residuals(problem, guess)
    spread = np.linalg.inv(np.einsum("ipau,ipav->puv", by_x, by_x)[points])
    x = guess.x_m[points] - guess.x_m[points].mean(axis=0)
    n, weight = np.linalg.svd(x, full_matrices=False)[2][2], np.ones(len(x))
    for _ in range(3):
        weight = 1 / np.sqrt(np.einsum("u,puv,v->p", n, spread, n))
        x = x - (weight**2 @ x) / (weight**2).sum()
        n = np.linalg.svd(x * weight[:, None], full_matrices=False)[2][2]
    height = x @ n
    excess = ((height * weight) ** 2).sum() / max(1, points.sum() - 3)
    x_m = guess.x_m.copy()
    x_m[points] -= (1 - np.sqrt(max(0.0, 1 - 1 / excess))) * height[:, None] * n
    return replace(guess, x_m=x_m)


def evidence(problem: Problem) -> float:
    """Say how much an answer explains: each freedom from the marks' scatter down to the noise; what it throws out, nothing."""
    scatter = np.nanstd(problem.background.uv_px, axis=(0, 1)).mean()
    each = np.log(scatter / problem.sigma_px)[np.nonzero(problem.used)[1]]
    return problem.freedom * float(each.mean())


def check_rivals(answers: list[tuple[Problem, Guess]], spread: Float[np.ndarray, "unknown unknown"]) -> None:
    """Refuse if another answer than the first, beyond its error bars, explains the marks about as well.

    Raises:
        CaptureError: ``background-two-answers``.
    """
    (problem, best), *rivals = answers
    least = evidence(problem) - TOLD_APART * np.sqrt(problem.used.any(axis=0).sum())
    for other, rival in rivals:
        if (_apart(best, rival, 0) > _tolerance(spread, 0)).any() and evidence(other) > least:
            raise refuse("background-two-answers")


def check_valley(problem: Problem, guess: Guess, spread: Float[np.ndarray, "unknown unknown"], valley: Valley) -> None:
    """Refuse if the way to the answer led through cameras that the error bars exclude and that cost hardly more.

    Before a plane the loss is a long valley, whose end, with points near the plane's horizon, may look like a pit.

    Raises:
        CaptureError: ``background-not-observable``.
    """
    least = min((cost for _, cost in valley.passed), default=0.0)
    noise = problem.sigma_px.mean() / valley.noise_px
    for other, cost in valley.passed:
        apart = _apart(guess, other, valley.core[0]) > _tolerance(spread, valley.core[0])
        if cost < least + UNSURE_LOSS * noise**2 and apart[valley.core].any():
            i = valley.core[int(np.argmax(apart[valley.core].any(axis=1)))]
            raise refuse("background-not-observable", f"picture {problem.background.pictures[i]}")


def _tolerance(spread: Float[np.ndarray, "unknown unknown"], first: int) -> Float[np.ndarray, "picture 4"]:
    sd = np.sqrt(np.diag(spread)[:-SHARED].reshape(-1, EACH))[:, [0, 1, 2, 6]]
    return np.maximum(APART_SD * np.hypot(sd, sd[first] * [1, 1, 1, 0]), SAME_ANSWER)
