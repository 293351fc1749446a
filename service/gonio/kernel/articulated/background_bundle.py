"""Bundle adjustment of one moving, zooming camera over a still background, with what gives it a measure.

Unknown are each picture's pose and the logarithm of its focal length, the principal point and k1 that all share, and the
points. The points are eliminated (Schur's complement) but for those that the measure hangs on: heights of floor points,
lengths and camera heights are residuals like the marks, so that the covariance holds what they tell, and nothing else.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.articulated.bundle import HUBER, NEAREST_M
from gonio.kernel.articulated.motion import cross, turn
from gonio.kernel.geometry.cameras import distort
from gonio.records import Background

EACH, SHARED = 7, 3
"""A picture's unknowns: turn and shift of ``T_cam_world``, log focal length. All pictures': principal point, k1."""

FLOOR_SD_M = 1e-3
"""How well a point of the floor lies in its plane."""

GAUGE_SD_M = 1e-5
"""How strictly the world's origin and direction are held where they are free to choose."""

SMALLEST_LENGTH_SD = 1e-4
"""A length is known to no smaller share of itself than this."""


@dataclass(frozen=True)
class Guess:
    """Where everything is believed to be: ``x_cam = R X + t``; ``shared`` is (cx, cy, k1) against what is given."""

    R: Float[np.ndarray, "picture 3 3"]
    t: Float[np.ndarray, "picture 3"]
    log_f: Float[np.ndarray, " picture"]
    shared: Float[np.ndarray, "3"]
    x_m: Float[np.ndarray, "point 3"]

    def scaled(self, factor: float, R: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]) -> "Guess":
        """Change the world: its points become ``factor · R (X − origin)``."""
        return replace(
            self, R=self.R @ R.T, t=factor * (self.t + self.R @ origin), x_m=factor * (self.x_m - origin) @ R.T
        )

    @property
    def centres_m(self) -> Float[np.ndarray, "picture 3"]:
        """Where the camera was for each picture."""
        return -(self.R.swapaxes(-1, -2) @ self.t[..., None])[..., 0]


@dataclass(frozen=True)
class Measure:
    """What fixes the world. ``held`` is a picture whose pose does not change: for a world without a floor."""

    floor: tuple[int, ...]
    lengths: tuple[tuple[int, int, float, float], ...]
    heights: tuple[tuple[int, float, float], ...]
    held: int | None

    @property
    def kept(self) -> list[int]:
        """The points that it names."""
        return sorted({*self.floor, *(point for a, b, *_ in self.lengths for point in (a, b))})


NO_MEASURE = Measure((), (), (), None)


@dataclass(frozen=True)
class Problem:
    """The marks that are believed, what is known of the lens, and the measure."""

    background: Background
    used: Bool[np.ndarray, "picture point"]
    sigma_px: Float[np.ndarray, " point"]
    measure: Measure = NO_MEASURE

    @property
    def free_focals(self) -> Bool[np.ndarray, " picture"]:
        """Of which pictures the focal length is not held."""
        return np.isnan(self.background.lens.focal_px) | (self.background.lens.focal_sd_px > 0)

    @property
    def freedom(self) -> int:
        """Count the marks' coordinates less the unknowns, seven of which are the world's."""
        return int(2 * self.used.sum() - 3 * self.used.any(axis=0).sum() - EACH * len(self.used) + 7)

    @property
    def free(self) -> Bool[np.ndarray, " unknown"]:
        """Which of the pictures' unknowns are not held."""
        lens = self.background.lens
        pictures = len(self.used)
        each = np.ones((pictures, EACH), dtype=bool)
        each[:, 6] = self.free_focals
        if self.measure.held is not None:
            each[self.measure.held, :6] = False
        return np.append(each.ravel(), [lens.principal_sd_px > 0, lens.principal_sd_px > 0, lens.k1_sd > 0])


def residuals(
    problem: Problem, guess: Guess
) -> tuple[
    Float[np.ndarray, "picture point 2"],
    Float[np.ndarray, "picture point 2 10"],
    Float[np.ndarray, "picture point 2 3"],
]:
    """Give the whitened residuals of the marks, their slopes by the picture's and the shared unknowns, and by the points.

    Marks that are not used are 0; a point behind its camera has infinite residuals.
    """
    lens = problem.background.lens
    Z = guess.x_m @ guess.R.swapaxes(-1, -2) + guess.t[:, None]
    behind = Z[..., 2] < NEAREST_M
    depth = np.where(behind, 1.0, Z[..., 2])
    xy = Z[..., :2] / depth[..., None]
    distortion = lens.distortion + np.array([guess.shared[2], 0, 0, 0, 0])
    bent, by_xy = distort(xy, distortion)
    f = np.exp(guess.log_f)[:, None, None]
    r = f * bent + lens.principal_px + guess.shared[:2] - np.nan_to_num(problem.background.uv_px)
    r = np.where(behind[..., None], np.inf, r)
    by_Z = np.zeros((*xy.shape, 3))
    by_Z[..., :2] = by_xy
    by_Z[..., 2] = -(by_xy @ xy[..., None])[..., 0]
    by_Z *= (f / depth[..., None])[..., None]
    slopes = np.zeros((*xy.shape, EACH + SHARED))
    slopes[..., :3] = -by_Z @ cross(Z)
    slopes[..., 3:6] = by_Z
    slopes[..., 6] = f * bent
    slopes[..., 7:9] = np.eye(2)
    slopes[..., 9] = f * xy * (xy**2).sum(axis=-1, keepdims=True)
    weight = problem.used / problem.sigma_px
    r = np.where(problem.used[..., None], r / problem.sigma_px[:, None], 0.0)
    return r, slopes * weight[..., None, None], (by_Z @ guess.R[:, None]) * weight[..., None, None]


class _Rows:
    """Collects whitened residuals and their slopes by the pictures' unknowns and the kept points."""

    def __init__(self, pictures: int, kept: list[int]) -> None:
        self._width, self._kept = EACH * pictures + SHARED, kept
        self._rows: list[tuple[float, np.ndarray]] = []

    def add(self, value: float, sd: float, unknowns: dict[int, float], points: dict[int, np.ndarray]) -> None:
        slopes = np.zeros(self._width + 3 * len(self._kept))
        for at, slope in unknowns.items():
            slopes[at] = slope
        for point, slope in points.items():
            at = self._width + 3 * self._kept.index(point)
            slopes[at : at + 3] = slope
        self._rows.append((value / sd, slopes / sd))

    def stacked(self) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row unknown"]]:
        width = self._width + 3 * len(self._kept)
        return np.array([r for r, _ in self._rows]), np.array([slopes for _, slopes in self._rows]).reshape(-1, width)


def _measured(problem: Problem, guess: Guess) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row unknown"]]:
    """Give the whitened residuals of the measure and the lens, and their slopes by pictures' unknowns and kept points."""
    measure, x_m, unit = problem.measure, guess.x_m, np.eye(3)
    rows = _Rows(len(guess.R), measure.kept)
    for point in measure.floor:
        rows.add(x_m[point, 1], FLOOR_SD_M, {}, {point: unit[1]})
    for point, axis in zip((*measure.floor[:1], *measure.floor[:2]), (0, 2, 2), strict=False):
        rows.add(x_m[point, axis], GAUGE_SD_M, {}, {point: unit[axis]})
    for a, b, length, sd in measure.lengths:
        gap = x_m[a] - x_m[b]
        far = float(np.linalg.norm(gap))
        rows.add(far - length, max(sd, SMALLEST_LENGTH_SD * length), {}, {a: gap / far, b: -gap / far})
    for picture, height, sd in measure.heights:
        slopes = {EACH * picture + 3 + at: float(-guess.R[picture, at, 1]) for at in range(3)}
        off = guess.centres_m[picture, 1] - height
        rows.add(off, max(sd, SMALLEST_LENGTH_SD * height), slopes, {})
    _expect_lens(problem, guess, rows)
    return rows.stacked()


def _expect_lens(problem: Problem, guess: Guess, rows: _Rows) -> None:
    lens, pictures = problem.background.lens, len(guess.R)
    if lens.focal_sd_px > 0:
        for i in np.flatnonzero(np.isfinite(lens.focal_px)):
            off = guess.log_f[i] - np.log(lens.focal_px[i])
            rows.add(off, lens.focal_sd_px / lens.focal_px[i], {EACH * int(i) + 6: 1.0}, {})
    for at, sd in enumerate((lens.principal_sd_px, lens.principal_sd_px, lens.k1_sd)):
        if sd > 0:
            rows.add(guess.shared[at], sd, {EACH * pictures + at: 1.0}, {})


def loss(problem: Problem, guess: Guess) -> float:
    """Sum Huber's loss of the marks, and the squares of the measure."""
    r, *_ = residuals(problem, guess)
    size = np.hypot(r[..., 0], r[..., 1])
    return float(
        np.where(size <= HUBER, size**2, 2 * HUBER * size - HUBER**2).sum() + (_measured(problem, guess)[0] ** 2).sum()
    )


@dataclass(frozen=True)
class _Reduced:
    """The normal equations with most points eliminated: matrix and gradient of what is kept, and the way back."""

    S: Float[np.ndarray, "kept kept"]
    g: Float[np.ndarray, " kept"]
    others: Int[np.ndarray, " other"]
    inner: Float[np.ndarray, "other 3 3"]
    coupling: Float[np.ndarray, "other kept 3"]
    gx: Float[np.ndarray, "other 3"]


def _reduced(problem: Problem, guess: Guess, damping: float) -> _Reduced:
    r, slopes, by_x = residuals(problem, guess)
    size = np.hypot(r[..., 0], r[..., 1])
    root = np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-12)))
    r, slopes, by_x = r * root[..., None], slopes * root[..., None, None], by_x * root[..., None, None]
    pictures, points = size.shape
    count, kept = EACH * pictures + SHARED, problem.measure.kept
    width = count + 3 * len(kept)
    matrix, g = np.zeros((width, width)), np.zeros(width)
    xx = np.einsum("ipau,ipav->puv", by_x, by_x)
    gx = np.einsum("ipau,ipa->pu", by_x, r)
    W = np.zeros((points, width, 3))
    pair = slopes.swapaxes(-1, -2) @ by_x
    for i in range(pictures):
        flat, rest = slopes[i].reshape(-1, EACH + SHARED), r[i].ravel()
        at = np.r_[EACH * i : EACH * i + EACH, count - SHARED : count]
        matrix[np.ix_(at, at)] += flat.T @ flat
        g[at] += flat.T @ rest
        W[:, at] += pair[i]
    value, extra = _measured(problem, guess)
    matrix += extra.T @ extra
    g += extra.T @ value
    for at, point in enumerate(kept):
        here = slice(count + 3 * at, count + 3 * at + 3)
        matrix[here, here] += xx[point]
        matrix[:, here] += W[point]
        matrix[here] += W[point].T
        g[here] += gx[point]
    matrix[range(width), range(width)] *= 1 + damping
    others = np.setdiff1d(np.flatnonzero(problem.used.sum(axis=0) >= 2), kept)
    inner, coupling, gx = xx[others], W[others], gx[others]
    inner[:, range(3), range(3)] *= 1 + damping
    inner[:, range(3), range(3)] += 1e-9
    inner = np.linalg.inv(inner)
    wide = (coupling @ inner).transpose(1, 0, 2).reshape(width, -1)
    S = matrix - wide @ coupling.transpose(1, 0, 2).reshape(width, -1).T
    return _Reduced(S, g - wide @ gx.ravel(), others, inner, coupling, gx)


def _free(problem: Problem) -> Int[np.ndarray, " free"]:
    return np.flatnonzero(np.append(problem.free, np.ones(3 * len(problem.measure.kept), dtype=bool)))


def adjust(problem: Problem, guess: Guess, iterations: int) -> tuple[Guess, float]:
    """Improve a guess by Levenberg and Marquardt's method; gives its loss too."""
    cost, damping, free = loss(problem, guess), 1e-3, _free(problem)
    if not np.isfinite(cost):
        return guess, cost
    for _ in range(iterations):
        reduced = _reduced(problem, guess, damping)
        width = len(reduced.g)
        change = np.zeros(width)
        ridge = 1e-12 * np.diag(reduced.S)[free].max() * np.eye(len(free))
        change[free] = -np.linalg.solve(reduced.S[np.ix_(free, free)] + ridge, reduced.g[free])
        tried = _moved(problem, guess, change, reduced)
        new = loss(problem, tried)
        if new < cost:
            calm = cost - new < 1e-10 * cost
            guess, cost, damping = tried, new, damping * 0.2
            if calm:
                break
        else:
            damping *= 8
            if damping > 1e9:
                break
    return guess, cost


def _moved(problem: Problem, guess: Guess, change: Float[np.ndarray, " kept"], reduced: _Reduced) -> Guess:
    pictures, kept = len(guess.R), problem.measure.kept
    count = EACH * pictures + SHARED
    each = change[: EACH * pictures].reshape(pictures, EACH)
    x_m = guess.x_m.copy()
    x_m[kept] += change[count:].reshape(-1, 3)
    rest = -reduced.gx - (reduced.coupling.swapaxes(-1, -2) @ change)
    x_m[reduced.others] += (reduced.inner @ rest[..., None])[..., 0]
    dR = turn(each[:, :3])
    return Guess(
        dR @ guess.R, (dR @ guess.t[..., None])[..., 0] + each[:, 3:6], guess.log_f + np.clip(each[:, 6], -1, 1),
        guess.shared + change[count - SHARED : count], x_m,
    )  # fmt: skip


def covariance(problem: Problem, guess: Guess) -> Float[np.ndarray, "unknown unknown"]:
    """Give the covariance of the pictures' unknowns and the shared ones, 0 for what is held; the measure must fix the world."""
    free, count = _free(problem), EACH * len(guess.R) + SHARED
    S = _reduced(problem, guess, 0.0).S[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-30))
    values, vectors = np.linalg.eigh(S * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, 1e-13)) @ vectors.T * scale * scale[:, None]
    whole = np.zeros((count + 3 * len(problem.measure.kept),) * 2)
    whole[np.ix_(free, free)] = inverse
    return whole[:count, :count]
