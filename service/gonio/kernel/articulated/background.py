"""Step A: from marks of what stands still to where the camera was for each picture, and its zoom, without any guess.

The pair of pictures with the most parallax comes first. Its fundamental matrix leaves the two focal lengths open (where the
camera looks at one thing from all sides they can't be told from two pictures at all), so a range of them is tried: each gives
a pair of cameras, the other pictures follow one by one, and the bundle adjustment of all says which was right. Then the floor
and the known lengths make it metric, wrong marks are thrown out, and what the pictures can't tell is refused.

A background that is flat, or nearly, has no fundamental matrix; its homographies give the first guesses
(:mod:`gonio.kernel.articulated.flat_background`).
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.kernel.articulated.background_bundle import (
    EACH,
    SHARED,
    Guess,
    Measure,
    Problem,
    adjust,
    covariance,
    residuals,
)
from gonio.kernel.articulated.background_refusals import refuse
from gonio.kernel.articulated.flat_background import (
    NO_VALLEY,
    Valley,
    before_plane,
    check_rivals,
    check_valley,
    evidence,
    told_heights,
)
from gonio.kernel.articulated.growing import (
    FOCALS,
    LONGEST,
    MIN_COMMON,
    MIN_KNOWN,
    WIDEST,
    adjust_inside,
    extend,
    grow,
    nothing_known,
    spread_points,
)
from gonio.kernel.articulated.two_views import (
    Epipolar,
    evenness,
    fit_epipolar,
    fit_homography,
    homography_rms_px,
    relative_poses,
    triangulate_rays,
)
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import UNKNOWNS, Background, Camera, LocatedPictures

CORE = 5
"""So many pictures tell which focal lengths are right; more follow them."""

FLAT = 1.5
"""A homography that leaves no more than this multiple of the noise explains a pair."""

PLANE = 0.6
"""A plane that explains this share of the best pair's good marks is tried as the background."""

ANY_TWO, CHANCE, STILL = 2, 0.05, 0.2
"""An epipolar geometry of a plane fits any two wrong marks and this share by chance; so many don't speak against a turn."""

REJECT = 4.5
FINEST_PX = 1e-2
LINE = 0.06
UNSURE_LOG_F = 0.25
"""A focal length that is not known to a quarter is not known."""


@dataclass(frozen=True)
class _Pair:
    first: int
    second: int
    epipolar: Epipolar
    common: Bool[np.ndarray, " point"]
    parallax: float


def locate_pictures(background: Background, *, expected_noise_px: float = 1.0, seed: int = 0) -> LocatedPictures:
    """Find where the camera was for each picture, and its focal length, in metres.

    Args:
        background: The marks, the lens as far as it is known, and what gives a measure.
        expected_noise_px: A first idea of the marks' noise; the result tells its own.
        seed: Of the random samples.

    Raises:
        CaptureError: One of :data:`~gonio.kernel.articulated.background_refusals.REFUSALS`.
    """
    used = np.isfinite(background.uv_px).all(axis=-1)
    used &= used.sum(axis=0) >= 2
    problem = Problem(background, used, np.full(used.shape[1], expected_noise_px))
    answers, refused = [], None
    guesses, valley = _first_guesses(problem, seed)
    for believed, guess in guesses:
        try:
            answers.append(_measured(replace(problem, used=believed), guess))
        except CaptureError as error:
            refused = refused or error
    if not answers and refused:
        raise refused
    answers = sorted(answers, key=lambda each: evidence(each[0]), reverse=True)
    problem, guess = answers[0]
    spread = covariance(problem, told_heights(problem, guess))
    _check(problem, guess, spread)
    check_rivals(answers, spread)
    check_valley(problem, guess, spread, valley)
    return _packed(problem, guess, spread)


def _measured(problem: Problem, guess: Guess) -> tuple[Problem, Guess]:
    """Throw out what is wrong, give the world its measure, and adjust all."""
    problem, guess = _purged(problem, guess)
    measure = _measure(problem.background, problem.used)
    problem, guess = _purged(replace(problem, measure=measure), _metric(problem.background, measure, guess))
    if (problem.used[:, measure.kept].sum(axis=0) < 2).any():
        raise refuse("background-measure-unseen")
    return problem, guess


def _first_guesses(problem: Problem, seed: int) -> tuple[list[tuple[Bool[np.ndarray, "picture point"], Guess]], Valley]:
    """Give guesses with the marks to begin with, several where the background is flat, and what was passed there."""
    background, used = problem.background, problem.used
    for i, name in enumerate(background.pictures):
        if max((used[i] & used[j]).sum() for j in range(len(used)) if j != i) < MIN_COMMON:
            raise refuse("background-pictures-apart", f"picture {name}")
    uv = background.uv_px - background.lens.principal_px
    pairs = [
        _pair(uv, used, i, j, seed)
        for i, j in combinations(range(len(used)), 2)
        if (used[i] & used[j]).sum() >= MIN_COMMON
    ]
    best = max(pairs, key=lambda pair: pair.parallax)
    common = np.flatnonzero(used[best.first] & used[best.second])
    _, fits = fit_homography(uv[best.first, common], uv[best.second, common], seed)
    near, marks = best.parallax < FLAT * problem.sigma_px.max(), best.common.sum()
    beside = int(marks - best.common[common[fits]].sum()) - ANY_TWO
    flat = near or beside <= CHANCE * marks
    guesses, valley = [], NO_VALLEY
    if flat or fits.sum() > PLANE * marks:
        guesses, valley = before_plane(problem, uv, seed, still=near or beside <= STILL * marks)
    if not flat:
        valley = NO_VALLEY  # what lies beside the plane tells more
        try:
            guesses.append((used, _in_depth(problem, uv, best, seed)))
        except CaptureError:
            if not guesses:
                raise
    if not guesses:
        raise refuse("background-not-solved")
    return guesses, valley


def _in_depth(problem: Problem, uv: np.ndarray, best: _Pair, seed: int) -> Guess:
    """Find the cameras from the pair with most parallax."""
    used = problem.used
    core = _core(used, best)
    narrow = replace(problem, used=used & spread_points(used, best.common, seed))
    candidates = [
        found
        for focals in _focals(problem.background, best)
        for found in [_from_pair(narrow, uv, best, focals, core, seed)]
        if found is not None
    ]
    if not candidates:
        raise refuse("background-not-solved")
    shortlist = sorted(candidates, key=lambda each: each[1])[:3]
    guess, _ = min((adjust_inside(narrow, found, core, 60) for found, _ in shortlist), key=lambda each: each[1])
    return extend(problem, uv, guess, core, seed)


def _pair(uv: np.ndarray, used: np.ndarray, i: int, j: int, seed: int) -> _Pair:
    common = used[i] & used[j]
    epipolar = fit_epipolar(uv[i, common], uv[j, common], seed)
    good = np.flatnonzero(common)[epipolar.fits]
    flat = homography_rms_px(uv[i, good], uv[j, good]) if len(good) >= 8 else 0.0
    common = np.isin(np.arange(len(common)), good)
    return _Pair(i, j, epipolar, common, flat * np.sqrt(min(len(good), 50) / 50))


def _core(used: Bool[np.ndarray, "picture point"], pair: _Pair) -> list[int]:
    shared = (used & pair.common).sum(axis=1)
    order = [int(i) for i in np.argsort(-shared) if i not in (pair.first, pair.second) and shared[i] >= MIN_KNOWN]
    return [pair.first, pair.second, *order[: CORE - 2]]


def _focals(background: Background, pair: _Pair) -> list[tuple[float, float]]:
    lens, side = background.lens, max(background.lens.image_size_px)
    known = lens.focal_px[[pair.first, pair.second]]
    first = [known[0]] if np.isfinite(known[0]) else np.geomspace(WIDEST, LONGEST, FOCALS) * side
    second = [known[1]] if np.isfinite(known[1]) else np.geomspace(WIDEST, LONGEST, 4 * FOCALS) * side
    out = []
    for f1 in first:
        uneven = evenness(pair.epipolar.F, float(f1), np.array(second))
        lowest = [k for k in range(len(uneven)) if uneven[k] == uneven[max(0, k - 1) : k + 2].min()]
        out += [(float(f1), float(second[k])) for k in sorted(lowest, key=lambda k: uneven[k])[:2]]
    return out


def _from_pair(
    problem: Problem, uv: np.ndarray, pair: _Pair, focals: tuple[float, float], core: list[int], seed: int
) -> tuple[Guess, float] | None:
    """Build all pictures of the core on the pair's focal lengths; None if the cameras do not see the points before them."""
    i, j = pair.first, pair.second
    K1, K2 = np.diag([focals[0], focals[0], 1.0]), np.diag([focals[1], focals[1], 1.0])
    common = pair.common & problem.used[i] & problem.used[j]
    xy = np.where(common[:, None], uv[[i, j]] / np.array(focals)[:, None, None], np.nan)
    best, most = None, 0
    for R, t in relative_poses(K2 @ pair.epipolar.F @ K1):
        both_R, both_t = np.stack([np.eye(3), R]), np.stack([np.zeros(3), t])
        x_m = triangulate_rays(both_R, both_t, xy)
        ahead = int(((x_m[:, 2] > 0) & ((x_m @ R.T + t)[:, 2] > 0)).sum())
        if ahead > most:
            best, most = (both_R, both_t, x_m), ahead
    if best is None or most < 0.8 * common.sum():
        return None
    guess = replace(nothing_known(problem.used), x_m=best[2])
    guess.R[[i, j]], guess.t[[i, j]], guess.log_f[[i, j]] = best[0], best[1], np.log(focals)
    return grow(problem, uv, guess, core[:2], core[2:], seed)


def _purged(problem: Problem, guess: Guess) -> tuple[Problem, Guess]:
    """Throw out wrong marks until none is left, and tell the noise of the rest."""
    marked = np.isfinite(problem.background.uv_px).all(axis=-1) & np.isfinite(guess.x_m[:, 0])
    guess = replace(guess, x_m=np.nan_to_num(guess.x_m))
    problem = replace(problem, used=problem.used & marked)
    by_hand = np.arange(marked.shape[1]) < marked.shape[1] - problem.background.found
    groups = [group for group in (by_hand, ~by_hand) if marked[:, group].any()]
    for _ in range(6):
        guess, _ = adjust(problem, guess, 60)
        everything = replace(problem, used=marked, sigma_px=np.ones_like(problem.sigma_px))
        r, *_ = residuals(everything, guess)
        size = np.hypot(r[..., 0], r[..., 1])
        left = max(0.1, problem.freedom / max(2 * problem.used.sum(), 1))
        # Rayleigh's median is 1.1774 deviations; the unknowns took a share of what the marks were off by.
        sigma = problem.sigma_px.copy()
        for group in groups:
            if problem.used[:, group].any():
                sigma[group] = max(
                    np.median(size[:, group][problem.used[:, group]]) / 1.1774 / np.sqrt(left), FINEST_PX
                )
        believed = marked & (size < REJECT * sigma)
        believed &= believed.sum(axis=0) >= 2
        same = bool((believed == problem.used).all()) and np.abs(np.log(sigma / problem.sigma_px)).max() < 0.05
        problem = replace(problem, used=believed, sigma_px=sigma)
        if same:
            break
    if problem.used.sum() < 0.5 * marked.sum():
        raise refuse("background-not-solved")
    r, *_ = residuals(problem, guess)
    sigma = problem.sigma_px * np.sqrt((r**2).sum() / max(1, problem.freedom))
    return replace(problem, sigma_px=np.maximum(sigma, FINEST_PX)), guess


def _measure(background: Background, used: Bool[np.ndarray, "picture point"]) -> Measure:
    """Say what fixes the world; points of the floor that fewer than two pictures tell of are done without."""
    floor = tuple(point for point in background.floor_points if used[:, point].sum() >= 2)
    lengths = {point for each in background.lengths for point in (each.first, each.second)}
    if len(floor) < min(3, len(background.floor_points)) or any(used[:, point].sum() < 2 for point in lengths):
        raise refuse("background-measure-unseen")
    return Measure(
        floor,
        tuple((each.first, each.second, each.length_m, each.sd_m) for each in background.lengths),
        tuple((each.picture, each.height_m, each.sd_m) for each in background.heights),
        None if background.floor_points else background.reference,
    )


def _metric(background: Background, measure: Measure, guess: Guess) -> Guess:
    """Turn, shift and scale the world as the measure asks."""
    if not np.isfinite(guess.x_m[measure.kept]).all():
        raise refuse("background-measure-unseen")
    if measure.floor:
        floor = guess.x_m[list(measure.floor)]
        middle = floor.mean(axis=0)
        _, extent, axes = np.linalg.svd(floor - middle)
        if extent[1] < LINE * extent[0]:
            raise refuse("floor-points-collinear")
        up = axes[2] * np.sign(((guess.centres_m - middle) @ axes[2]).mean())
        x = floor[1] - floor[0]
        x = (x - (x @ up) * up) / np.linalg.norm(x - (x @ up) * up)
        to_world, origin = np.stack([x, up, np.cross(x, up)]), floor[0] + ((middle - floor[0]) @ up) * up
    else:
        to_world = np.diag([1.0, -1.0, -1.0]) @ guess.R[background.reference]
        origin = guess.centres_m[background.reference]
    guess = guess.scaled(1.0, to_world, origin)
    factors = [length / np.linalg.norm(guess.x_m[a] - guess.x_m[b]) for a, b, length, _ in measure.lengths]
    factors += [height / guess.centres_m[picture, 1] for picture, height, _ in measure.heights]
    return guess.scaled(float(np.median(factors)), np.eye(3), np.zeros(3))


def _check(problem: Problem, guess: Guess, spread: Float[np.ndarray, "unknown unknown"]) -> None:
    sd = np.sqrt(np.diag(spread)[:-SHARED].reshape(-1, EACH))
    far = np.median(np.linalg.norm(guess.x_m[problem.used.any(axis=0)] - guess.centres_m.mean(axis=0), axis=1))
    worst = np.array([sd[:, :3].max(axis=1), sd[:, 3:6].max(axis=1) / far, sd[:, 6]]).max(axis=0)
    if not np.isfinite(worst).all() or worst.max() > UNSURE_LOG_F:
        raise refuse("background-not-observable", f"picture {problem.background.pictures[int(np.argmax(worst))]}")
    few = problem.used.sum(axis=1)
    if few.min() < MIN_KNOWN:
        raise refuse("background-pictures-apart", f"picture {problem.background.pictures[int(np.argmin(few))]}")


def _packed(problem: Problem, guess: Guess, spread: Float[np.ndarray, "unknown unknown"]) -> LocatedPictures:
    background, lens = problem.background, problem.background.lens
    cameras = []
    for i, name in enumerate(background.pictures):
        f = np.exp(guess.log_f[i])
        cx, cy = lens.principal_px + guess.shared[:2]
        R = Rotation.from_matrix(guess.R[i]).as_matrix()
        cameras.append(
            Camera(
                name=name,
                image_size_px=lens.image_size_px,
                intrinsic_px=np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]),
                distortion=lens.distortion + np.array([guess.shared[2], 0, 0, 0, 0]),
                T_lab_cam=inverse(transform(R, guess.t[i])),
            )
        )
    pictures, width = len(cameras), len(UNKNOWNS)
    named = [UNKNOWNS.index(name) for name in ("focal_px", "cx_px", "cy_px", "k1")]
    to = np.zeros((pictures * width, len(spread)))
    for i in range(pictures):
        to[width * i : width * i + 6, EACH * i : EACH * i + 6] = np.eye(6)
        to[width * i + named[0], EACH * i + 6] = np.exp(guess.log_f[i])
        to[[width * i + at for at in named[1:]], range(EACH * pictures, EACH * pictures + SHARED)] = 1.0
    r, *_ = residuals(replace(problem, sigma_px=np.ones_like(problem.sigma_px)), guess)
    return LocatedPictures(
        cameras=tuple(cameras), covariance=to @ spread @ to.T, uv_px=background.uv_px,
        xyz_m=np.where(np.asarray(problem.used.any(axis=0))[:, None], guess.x_m, np.nan), used=problem.used,
        residual_px=np.where(problem.used[..., None], r, np.nan), sigma_px=float(problem.sigma_px[0]),
    )  # fmt: skip
