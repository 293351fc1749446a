"""One keypoint's track and its constant errors, compiled: reweighted least squares with a banded matrix and a border.

The unknowns are the points of all frames, whose normal equations are a band, and a constant displacement (two numbers) for
each camera, which border it. With A the band, B the border's columns, D its corner and r, q the two right sides

    [A  B] [x]   [r]        S = D − Bᵀ A⁻¹ B,   b = S⁻¹ (q − Bᵀ A⁻¹ r),   x = A⁻¹ (r − B b)
    [Bᵀ D] [b] = [q]

and the block of the inverse that belongs to a frame is that of A⁻¹ plus Z S⁻¹ Zᵀ, with Z the frame's rows of A⁻¹ B.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from gonio.kernel.body.tree import Array
from gonio.kernel.optimize.banded import factorise, invert_within, substitute_back, substitute_forward

SIGMA_PX = 6.0
"""A detector's error at confidence 1: it weighs the observations against the smoothness, as the cutoff says."""

BAND = 12  # three coordinates a frame, coupled with the three frames before: 3 · 3 + 3
LOWEST_INFORMATION = 1e-6  # 1/m²: a track without any observation stays where it started

KEPT = 0.25
"""A camera counts as having seen a point where the loss leaves it more than this share of its weight."""

MOST_JUDGED = 25
"""Moments of which it is computed what they would say alone."""


class Track(NamedTuple):
    """One keypoint's observations, and what is believed of their errors.

    ``lasting`` is by how many frames errors repeat each other, and ``excess`` is how much larger the variance of a mean of
    many of them is than one takes it for that believes in errors of :data:`SIGMA_PX` that are new in every frame.
    """

    projections: Array  # (camera, 3, 4)
    px_per_m: Array  # (camera, frame)
    uv_px: Array  # (camera, frame, 2)
    weight: Array  # (camera, frame), of the observations; 0 is missing
    trust: Array  # (camera,): the mean weight of its observations, 1 without any
    stiffness: float  # of the penalty on third differences, 1/m²
    bias_sd_m: float  # of a constant error where the trust is 1, its variance going with the inverse; 0 holds them
    spread: float  # how many times larger constant errors are than believed, as the trial's residuals tell
    lasting: float
    excess: float


class _Equations(NamedTuple):
    """Scratch: the normal equations in parts, as the module says; one column of ``right`` is r, those before it B."""

    band: Array  # (3 frame, BAND)
    right: Array  # (3 frame, 2 camera + 1), or (3 frame, 1) where the constant errors are held
    corner: Array  # (2 camera, 2 camera), or (0, 0)
    below: Array  # (2 camera,), or (0,)
    kept: Array  # (camera, frame): the share of its weight that the loss leaves to an observation
    squared: Array  # (camera, frame): its error in standard deviations, squared
    slope: Array  # (2, 3)
    error: Array  # (2,)


@njit(cache=True, nogil=True, error_model="numpy")
def descend(track: Track, start: Array, start_m: Array, scales: Array) -> tuple[Array, Array, Array, Array]:
    """Go down from points (frame, 3) and constant errors (camera, 2) with one step for each of the loss's scales.

    Gives the points, the constant errors, the share of its weight that the last step left to each observation, and the
    points' covariance (frame, 3, 3) by the equations of the last step: NaN where there is none, and where the constant errors
    are held, since without them it would be too small.
    """
    x, bias_m, covariance = start.copy(), start_m.copy(), np.full((len(start), 3, 3), np.nan)
    equations = _allocate(track)
    for number, scale_m in enumerate(scales):
        _assemble(track, x, bias_m, scale_m, equations)
        if not factorise(equations.band):
            break
        substitute_forward(equations.band, equations.right)
        border, step = equations.right[:, :-1].copy(), equations.right[:, -1].copy()
        if len(equations.below):
            shared = np.linalg.inv(equations.corner - border.T @ border)
            change = shared @ (equations.below - border.T @ step)
            step -= border @ change
            bias_m += change.reshape(bias_m.shape)
            if number == len(scales) - 1:
                _describe(track, x, equations, border, shared, covariance)
        column = step.reshape(-1, 1)
        substitute_back(equations.band, column)
        x += column.reshape(x.shape)
    return x, bias_m, equations.kept, covariance


@njit(cache=True, nogil=True, error_model="numpy")
def _describe(track: Track, x: Array, equations: _Equations, border: Array, shared: Array, covariance: Array) -> None:
    """Fill the points' covariance, with ``border`` after the first half of solving and ``shared`` the inverse of S.

    The track's own part is the posterior's, made as large as the residuals say (:func:`_inflation`); what constant errors add
    is known as well as the trial's residuals tell them.
    """
    inverse = np.zeros_like(equations.band)
    invert_within(equations.band, inverse)
    factor = _inflation(track, x, equations, inverse)
    substitute_back(equations.band, border)
    carried = border @ (track.excess * track.spread**2 * shared)
    for t in range(len(x)):
        for i in range(3):
            for j in range(i + 1):
                entry = factor * inverse[3 * t + i, i - j]
                for column in range(border.shape[1]):
                    entry += carried[3 * t + i, column] * border[3 * t + j, column]
                covariance[t, i, j] = covariance[t, j, i] = entry


@njit(cache=True, nogil=True, error_model="numpy")
def _inflation(track: Track, x: Array, equations: _Equations, inverse: Array) -> float:
    """Give the factor by which the posterior covariance of a track is too small, or too large.

    The posterior takes every observation for one of :data:`SIGMA_PX` that errs by itself. The residuals tell how large the
    errors are. How long they last matters, too: a mean over less than that is no better than one moment. Of each moment's
    degrees of freedom the track has drawn off three where it is no better than one moment, and as much less as it is better:
    an error that it does not follow is still there to see.
    """
    cameras, frames = track.weight.shape
    squared, moments, better = np.empty(cameras * frames), 0, np.empty(frames)
    seen, judged, every = 0, 0, max(1, frames // MOST_JUDGED)
    for t in range(frames):
        count = 0
        for c in range(cameras):
            if equations.kept[c, t] > KEPT:
                squared[seen + count] = equations.squared[c, t]
                count += 1
        if count < 2:
            continue
        seen, moments = seen + count, moments + 1
        if t % every == 0:
            fused = inverse[3 * t, 0] + inverse[3 * t + 1, 0] + inverse[3 * t + 2, 0]
            better[judged] = np.trace(np.linalg.inv(_information(track, t, x[t], equations))) / fused
            judged += 1
    if judged == 0:
        return 1.0
    level = np.median(squared[:seen]) / 1.386  # half of all |e|² of two normals lie below
    most = max(1.0, np.median(better[:judged]))
    lasting = min(max(track.lasting, 1.0), most)
    freedom = 2.0 * seen / moments
    return level * lasting * freedom / (freedom - 3.0 * lasting / most)


@njit(cache=True, nogil=True, error_model="numpy")
def _information(track: Track, t: int, x: Array, equations: _Equations) -> Array:
    """Give what one moment's observations say alone of its point (3, 3)."""
    slope, information = equations.slope, LOWEST_INFORMATION * np.eye(3)
    for c in range(len(track.projections)):
        if track.weight[c, t] > 0.0 and _look(track, c, t, x, equations):
            precision = track.weight[c, t] * equations.kept[c, t] / SIGMA_PX**2
            for i in range(3):
                for j in range(3):
                    information[i, j] += precision * (slope[0, i] * slope[0, j] + slope[1, i] * slope[1, j])
    return information


@njit(cache=True, nogil=True, error_model="numpy")
def _allocate(track: Track) -> _Equations:
    cameras, frames = track.weight.shape
    biases = 2 * cameras if track.bias_sd_m > 0.0 else 0
    return _Equations(
        np.empty((3 * frames, BAND)),
        np.empty((3 * frames, biases + 1)),
        np.empty((biases, biases)),
        np.empty(biases),
        np.empty((cameras, frames)),
        np.empty((cameras, frames)),
        np.empty((2, 3)),
        np.empty(2),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _assemble(track: Track, x: Array, bias_m: Array, scale_m: float, equations: _Equations) -> None:
    """Fill the normal equations at ``x``: the observations', the penalty's, and what is believed of constant errors."""
    band, right = equations.band, equations.right
    band[:], right[:], equations.corner[:], equations.kept[:] = 0.0, 0.0, 0.0, 0.0
    frames = len(x)
    for i in range(len(equations.below)):
        precision = track.excess * track.trust[i // 2] / track.bias_sd_m**2
        equations.corner[i, i] = precision
        equations.below[i] = -precision * bias_m[i // 2, i % 2]
    for t in range(frames):
        for i in range(3):
            band[3 * t + i, 0] += LOWEST_INFORMATION
        for c in range(len(track.projections)):
            if track.weight[c, t] > 0.0:
                _add_observation(track, c, t, x[t], bias_m[c], scale_m, equations)
    signs = (-1.0, 3.0, -3.0, 1.0)
    for t in range(frames - 3):
        for i in range(3):
            jerk = x[t + 3, i] - 3.0 * x[t + 2, i] + 3.0 * x[t + 1, i] - x[t, i]
            for a in range(4):
                right[3 * (t + a) + i, -1] -= track.stiffness * signs[a] * jerk
                for b in range(a + 1):
                    band[3 * (t + a) + i, 3 * (a - b)] += track.stiffness * signs[a] * signs[b]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_observation(
    track: Track, c: int, t: int, x: Array, bias_m: Array, scale_m: float, equations: _Equations
) -> None:
    """Add one camera's observation of one frame, and note what the loss leaves of it."""
    band, right, slope, error = equations.band, equations.right, equations.slope, equations.error
    if not _look(track, c, t, x, equations):
        return
    row, px_per_m = 3 * t, track.px_per_m[c, t]
    for axis in range(2):
        error[axis] -= px_per_m * bias_m[axis]
    squared = error[0] ** 2 + error[1] ** 2
    share = 1.0 / (1.0 + squared / (px_per_m * scale_m) ** 2)
    equations.kept[c, t], equations.squared[c, t] = share, track.weight[c, t] * squared / SIGMA_PX**2
    precision = track.weight[c, t] * share / SIGMA_PX**2
    for axis in range(2):
        for i in range(3):
            right[row + i, -1] += precision * slope[axis, i] * error[axis]
            for j in range(i + 1):
                band[row + i, i - j] += precision * slope[axis, i] * slope[axis, j]
        if len(equations.below):
            column = 2 * c + axis
            equations.corner[column, column] += precision * px_per_m**2
            equations.below[column] += precision * px_per_m * error[axis]
            for i in range(3):
                right[row + i, column] = precision * px_per_m * slope[axis, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _look(track: Track, c: int, t: int, x: Array, equations: _Equations) -> bool:
    """Find how far a point's picture is from the observation, and how it moves with the point; False behind the camera."""
    p, slope, error = track.projections[c], equations.slope, equations.error
    depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
    if depth <= 0.05:  # m
        return False
    per_depth = 1.0 / depth
    for axis in range(2):
        projected = (p[axis, 0] * x[0] + p[axis, 1] * x[1] + p[axis, 2] * x[2] + p[axis, 3]) * per_depth
        error[axis] = track.uv_px[c, t, axis] - projected
        for i in range(3):
            slope[axis, i] = (p[axis, i] - projected * p[2, i]) * per_depth
    return True
