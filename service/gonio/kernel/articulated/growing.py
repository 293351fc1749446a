"""One picture after another: the pictures of a still background join those whose cameras are known already."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from gonio.kernel.articulated.background_bundle import Guess, Problem, adjust
from gonio.kernel.articulated.background_refusals import refuse
from gonio.kernel.articulated.plane import resect_plane
from gonio.kernel.articulated.two_views import resect, triangulate_rays

MIN_COMMON = 10
"""A picture must share so many points with others: eight give an epipolar geometry that nothing checks."""

MIN_KNOWN = 7
"""A picture is resected from so many known points: one more than determine it."""

FOCALS = 9
WIDEST, LONGEST = 0.4, 5.0
"""Focal lengths that are tried, in longer sides of the picture: from a wide to a long lens."""

TRIED = 60
"""So many points do to tell which focal lengths are right; hundreds may be found in pictures."""

LOST = 50.0
"""The loss of a mark whose point lies behind the camera."""


def nothing_known(used: Bool[np.ndarray, "picture point"]) -> Guess:
    """Give a guess in which no point has a place yet."""
    pictures, points = used.shape
    return Guess(
        np.tile(np.eye(3), (pictures, 1, 1)), np.zeros((pictures, 3)), np.zeros(pictures), np.zeros(3),
        np.full((points, 3), np.nan),
    )  # fmt: skip


def spread_points(
    used: Bool[np.ndarray, "picture point"], good: Bool[np.ndarray, " point"], seed: int
) -> Bool[np.ndarray, " point"]:
    """Choose the points that the focal lengths are tried on: of the good ones, those that most pictures show."""
    rank = used.sum(axis=0) + np.random.default_rng(seed).random(used.shape[1]) - len(used) * ~good
    return np.isin(np.arange(used.shape[1]), np.argsort(-rank)[:TRIED])


def grow(
    problem: Problem, uv: np.ndarray, guess: Guess, inside: list[int], more: list[int], seed: int
) -> tuple[Guess, float] | None:
    """Add pictures to those that are inside, each followed by a short adjustment."""
    focal, side = problem.background.lens.focal_px, max(problem.background.lens.image_size_px)
    tried = (WIDEST * side, LONGEST * side)
    scene = place_points(problem, uv, guess, inside)
    cost = np.inf
    for i in more:
        known = problem.used[i] & np.isfinite(scene.x_m[:, 0])
        if known.sum() < MIN_KNOWN:
            return None
        in_depth = resect(scene.x_m[known], uv[i, known], focal[i], seed)
        cameras = resect_plane(scene.x_m[known], uv[i, known], focal[i], tried, seed)
        if in_depth is not None:
            cameras.append(in_depth)
        if not cameras:
            return None
        inside, scenes = [*inside, i], []
        for camera in cameras:
            R, t, log_f = scene.R.copy(), scene.t.copy(), scene.log_f.copy()
            R[i], t[i], log_f[i] = camera[0], camera[1], np.log(camera[2])
            seen = place_points(problem, uv, replace(scene, R=R, t=t, log_f=log_f), inside)
            scenes.append(adjust_inside(problem, seen, inside, 12))
        scene, cost = min(scenes, key=lambda each: each[1])
    if not more:
        scene, cost = adjust_inside(problem, scene, inside, 12)
    return (scene, cost) if np.isfinite(cost) else None


def adjust_inside(problem: Problem, scene: Guess, inside: list[int], iterations: int) -> tuple[Guess, float]:
    """Adjust the pictures inside and their points; gives the loss, too. Points with too few marks become NaN."""
    here = np.isin(np.arange(len(problem.used)), inside)[:, None]
    used = problem.used & here & np.isfinite(scene.x_m[:, 0])
    ahead = (scene.x_m @ scene.R[:, 2].T + scene.t[:, 2]).T > 0
    # What lies behind a camera can't be adjusted; it counts as wrong.
    believed = used & np.where(np.isnan(ahead), False, ahead)
    believed &= believed.sum(axis=0) >= 2
    lost = int((used & ~believed).sum())
    filled = replace(scene, x_m=np.nan_to_num(scene.x_m))
    found, cost = adjust(replace(problem, used=believed), filled, iterations)
    known = believed.any(axis=0)
    return replace(found, x_m=np.where(known[:, None], found.x_m, np.nan)), cost + LOST * lost


def place_points(problem: Problem, uv: np.ndarray, guess: Guess, inside: list[int]) -> Guess:
    """Triangulate the points that the pictures inside show and that have no place yet."""
    xy = np.where(problem.used[inside][..., None], uv[inside] / np.exp(guess.log_f[inside])[:, None, None], np.nan)
    fresh = triangulate_rays(guess.R[inside], guess.t[inside], xy)
    ahead = (fresh @ guess.R[inside, 2].T + guess.t[inside, 2]).T
    behind = np.asarray((problem.used[inside] & ~(ahead > 0)).any(axis=0))
    fresh = np.where(behind[:, None], np.nan, fresh)
    return replace(guess, x_m=np.where(np.isfinite(guess.x_m[:, :1]), guess.x_m, fresh))


def extend(problem: Problem, uv: np.ndarray, guess: Guess, core: list[int], seed: int) -> Guess:
    """Bring in the pictures beyond the core, the best tied first, and adjust all."""
    inside = list(core)
    guess = replace(guess, x_m=np.where((problem.used[core].sum(axis=0) >= 2)[:, None], guess.x_m, np.nan))
    while len(inside) < len(problem.used):
        known = np.isfinite(guess.x_m[:, 0])
        left = [i for i in range(len(problem.used)) if i not in inside]
        following = max(left, key=lambda i: int((problem.used[i] & known).sum()))
        grown = grow(problem, uv, guess, inside, [following], seed)
        if grown is None:
            raise refuse("background-pictures-apart", f"picture {problem.background.pictures[following]}")
        guess, inside = grown[0], [*inside, following]
    return adjust_inside(problem, place_points(problem, uv, guess, inside), inside, 60)[0]
