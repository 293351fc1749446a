"""One point from several cameras, compiled: linear start, pair hypotheses, Levenberg-Marquardt.

Everything here works on a single point, in scalar code that numba compiles; :mod:`gonio.kernel.triangulation.points`
runs it over all frames and keypoints. Image points are undistorted pixels; ``projections`` are ``K [R|t]``.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

SOLVED, TOO_FEW_CAMERAS, NOT_CONVERGED, BEHIND_CAMERA = 0, 1, 2, 3
"""How a point's solution ended."""

STEP_TOLERANCE_M = 1e-6  # a thousandth of what the best keypoint detector resolves
MAX_ITERATIONS = 50

CONTRACTION = 0.02
"""What a step leaves of the error at the best: the normal equations leave out the projection's curvature, which is worth the
residual over the depth (2 cm at 4 m are 0.5 %)."""


class Workspace(NamedTuple):
    """Scratch arrays of one thread: to allocate small arrays for each point would take longer than to solve it."""

    x: Array  # (3,)
    trial: Array  # (3,)
    step: Array  # (3,)
    gradient: Array  # (3,)
    matrix: Array  # (3, 3)
    curvature: Array  # (3, 3)
    rows: Array  # (2, 4)
    pull: Array  # (3,)
    depth_m: Array  # (camera,)
    trial_depth_m: Array  # (camera,)
    trial_residual_px: Array  # (camera, 2)
    scale_px: Array  # (camera,)
    pair_weight: Array  # (camera,)


@njit(cache=True, nogil=True, error_model="numpy")
def make_workspace(cameras: int) -> Workspace:
    """Allocate what one thread needs."""
    return Workspace(
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((2, 4)),
        np.zeros(3), np.zeros(cameras), np.zeros(cameras), np.zeros((cameras, 2)), np.zeros(cameras), np.zeros(cameras),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def copy_values(source: Array, target: Array) -> None:
    """Copy one vector into another of its length."""
    for i in range(len(source)):
        target[i] = source[i]


@njit(cache=True, error_model="numpy")
def linear_point(projections: Array, uv_px: Array, weight: Array, x: Array, work: Workspace) -> bool:
    """Solve one point by weighted linear least squares (DLT) [Hartley & Sturm 1997, inhomogeneous form].

    Each observation gives the rows ``(u p3 - p1) X = 0`` and ``(v p3 - p2) X = 0``. The rows are scaled to unit length of
    their direction part, so that cameras of different focal lengths count alike. Fills ``x``; False if it is not determined
    (by at least two rays that are not parallel).
    """
    normal, right, row = work.matrix, work.gradient, work.rows[0]
    for i in range(3):
        right[i] = 0.0
        for j in range(3):
            normal[i, j] = 0.0
    for c in range(projections.shape[0]):
        if weight[c] <= 0.0:
            continue
        for axis in range(2):
            for i in range(4):
                row[i] = uv_px[c, axis] * projections[c, 2, i] - projections[c, axis, i]
            scale = weight[c] / (row[0] * row[0] + row[1] * row[1] + row[2] * row[2])
            for i in range(3):
                right[i] -= scale * row[i] * row[3]
                for j in range(3):
                    normal[i, j] += scale * row[i] * row[j]
    return solve_3x3(normal, right, x)


@njit(cache=True, error_model="numpy")
def solve_3x3(matrix: Array, right: Array, x: Array) -> bool:
    """Solve a symmetric positive definite 3 × 3 system by Cholesky, into ``x``; False where it is not definite."""
    l00 = matrix[0, 0]
    if not l00 > 0.0:
        return False
    l00 = np.sqrt(l00)
    l10, l20 = matrix[1, 0] / l00, matrix[2, 0] / l00
    l11 = matrix[1, 1] - l10 * l10
    # Relative to the diagonal, so that the test means the same in pixels and in metres.
    if not l11 > 1e-12 * matrix[1, 1]:
        return False
    l11 = np.sqrt(l11)
    l21 = (matrix[2, 1] - l20 * l10) / l11
    l22 = matrix[2, 2] - l20 * l20 - l21 * l21
    if not l22 > 1e-12 * matrix[2, 2]:
        return False
    l22 = np.sqrt(l22)
    y0 = right[0] / l00
    y1 = (right[1] - l10 * y0) / l11
    y2 = (right[2] - l20 * y0 - l21 * y1) / l22
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return True


@njit(cache=True, error_model="numpy")
def invert_3x3(matrix: Array, inverse: Array) -> None:
    """Fill the inverse of a symmetric matrix; it stays as it is where there is none."""
    a, b, c, d, e, f = matrix[0, 0], matrix[1, 0], matrix[2, 0], matrix[1, 1], matrix[2, 1], matrix[2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * first + b * second + c * third
    if determinant != 0.0:
        inverse[0, 0] = first / determinant
        inverse[1, 0] = inverse[0, 1] = second / determinant
        inverse[2, 0] = inverse[0, 2] = third / determinant
        inverse[1, 1] = (a * f - c * c) / determinant
        inverse[2, 1] = inverse[1, 2] = (b * c - a * e) / determinant
        inverse[2, 2] = (a * d - b * b) / determinant


@njit(cache=True, error_model="numpy")
def reprojection(projections: Array, uv_px: Array, weight: Array, x: Array, residual_px: Array, depth_m: Array) -> bool:
    """Fill ``residual_px`` (observed minus projected) and ``depth_m`` of each camera; False if one is behind its camera."""
    for c in range(projections.shape[0]):
        p = projections[c]
        w = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
        depth_m[c] = w
        if weight[c] <= 0.0:
            residual_px[c, 0] = 0.0
            residual_px[c, 1] = 0.0
            continue
        if w <= 1e-6:
            return False
        residual_px[c, 0] = uv_px[c, 0] - (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3]) / w
        residual_px[c, 1] = uv_px[c, 1] - (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3]) / w
    return True


@njit(cache=True, error_model="numpy")
def scale_in_image(depth_m: Array, focal_px: Array, scale_m: float, scale_px: Array) -> None:
    """Fill the robust scale in each camera's pixels: ``scale_m`` as seen at the point's depth.

    So what counts as an outlier is a distance in the lab, the same for a near and a far camera and for any image size.
    """
    for c in range(len(depth_m)):
        scale_px[c] = np.inf
        if not np.isinf(scale_m) and depth_m[c] > 0.0:
            scale_px[c] = focal_px[c] * scale_m / depth_m[c]


@njit(cache=True, error_model="numpy")
def cost_of(residual_px: Array, weight: Array, scale_px: Array, enough: float) -> float:
    """Sum the cost of the residuals: ``w s² log(1 + (r/s)²)`` (Cauchy), or ``w r²`` where the scale is infinite.

    Infinite as soon as it is more than ``enough``.
    """
    total = 0.0
    for c in range(len(weight)):
        if weight[c] <= 0.0:
            continue
        r2 = residual_px[c, 0] ** 2 + residual_px[c, 1] ** 2
        if np.isinf(scale_px[c]):
            total += weight[c] * r2
        else:
            total += weight[c] * scale_px[c] ** 2 * np.log1p(r2 / scale_px[c] ** 2)
        if total > enough:
            return np.inf
    return total


@njit(cache=True, error_model="numpy")
def normal_equations(
    projections: Array,
    residual_px: Array,
    depth_m: Array,
    weight: Array,
    scale_px: Array,
    x: Array,
    hessian: Array,
    work: Workspace,
) -> None:
    """Fill the derivatives of :func:`cost_of` (halved) at ``x``: ``hessian``, the workspace's ``curvature`` and ``gradient``.

    ``hessian`` is the Gauss-Newton one with the loss's weights: the information that the observations carry.
    ``curvature`` adds the loss's second derivative along each residual [Triggs et al. 2000, §4.3], which may leave it
    indefinite: without it the iteration converges linearly, in up to a hundred steps.
    """
    curvature, gradient, rows, pull = work.curvature, work.gradient, work.rows, work.pull
    for i in range(3):
        gradient[i] = 0.0
        for j in range(3):
            hessian[i, j] = curvature[i, j] = 0.0
    for c in range(projections.shape[0]):
        if weight[c] <= 0.0:
            continue
        w = weight[c]
        correction = 0.0
        r2 = residual_px[c, 0] ** 2 + residual_px[c, 1] ** 2
        if not np.isinf(scale_px[c]):
            w /= 1.0 + r2 / scale_px[c] ** 2
            correction = -2.0 / (scale_px[c] ** 2 + r2) * w
        p = projections[c]
        for axis in range(2):
            projected = (p[axis, 0] * x[0] + p[axis, 1] * x[1] + p[axis, 2] * x[2] + p[axis, 3]) / depth_m[c]
            for i in range(3):
                rows[axis, i] = (p[axis, i] - projected * p[2, i]) / depth_m[c]  # d(projected)/dx
        for i in range(3):
            pull[i] = rows[0, i] * residual_px[c, 0] + rows[1, i] * residual_px[c, 1]
            gradient[i] += w * pull[i]
        for i in range(3):
            for j in range(3):
                information = w * (rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j])
                hessian[i, j] += information
                curvature[i, j] += information + correction * pull[i] * pull[j]


@njit(cache=True, error_model="numpy")
def damped_step(hessian: Array, damping: float, work: Workspace) -> tuple[bool, bool]:
    """Fill the step by the damped normal equations: by the curvature if it is positive definite, else by the Hessian.

    Returns whether there is a step, and whether it is the curvature's.
    """
    damped = work.matrix
    for i in range(3):
        for j in range(3):
            damped[i, j] = work.curvature[i, j]
        damped[i, i] += damping * hessian[i, i]
    if solve_3x3(damped, work.gradient, work.step):
        return True, True
    for i in range(3):  # between two explanations of the observations; the reweighted Hessian still leads downhill
        for j in range(3):
            damped[i, j] = hessian[i, j]
        damped[i, i] *= 1.0 + damping
    return solve_3x3(damped, work.gradient, work.step), False


@njit(cache=True, error_model="numpy")
def refine_point(  # noqa: PLR0913 - what it fills is passed in
    projections: Array,
    focal_px: Array,
    uv_px: Array,
    weight: Array,
    scale_m: float,
    x: Array,
    residual_px: Array,
    hessian: Array,
    work: Workspace,
) -> int:
    """Refine one point ``x`` by Levenberg-Marquardt on the (robust) weighted reprojection error.

    Overwrites ``x`` and fills ``residual_px`` and the ``hessian`` at the solution. Returns its status.
    """
    trial, step, scale_px = work.trial, work.step, work.scale_px
    if not reprojection(projections, uv_px, weight, x, residual_px, work.depth_m):
        return BEHIND_CAMERA
    # Held from here on: a scale that followed the point would reward moving away from a camera that disagrees.
    scale_in_image(work.depth_m, focal_px, scale_m, scale_px)
    cost = cost_of(residual_px, weight, scale_px, np.inf)
    damping = 1e-3
    normal_equations(projections, residual_px, work.depth_m, weight, scale_px, x, hessian, work)
    for _ in range(MAX_ITERATIONS):
        solvable, curved = damped_step(hessian, damping, work)
        if not solvable:
            return TOO_FEW_CAMERAS
        for i in range(3):
            trial[i] = x[i] + step[i]
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        # Newton's steps square the error, in units of the loss's scale; the damping leaves its share of it.
        left = length * (CONTRACTION + 10.0 * damping + length / scale_m)
        trial_cost = np.inf
        if reprojection(projections, uv_px, weight, trial, work.trial_residual_px, work.trial_depth_m):
            trial_cost = cost_of(work.trial_residual_px, weight, scale_px, cost)
        if trial_cost <= cost:
            cost = trial_cost
            copy_values(trial, x)
            copy_values(work.trial_depth_m, work.depth_m)
            for c in range(len(weight)):
                copy_values(work.trial_residual_px[c], residual_px[c])
            damping = max(damping / 10.0, 1e-12)
            normal_equations(projections, residual_px, work.depth_m, weight, scale_px, x, hessian, work)
            if curved and left < 0.1 * STEP_TOLERANCE_M:
                return SOLVED
        else:
            damping *= 10.0
        if length < STEP_TOLERANCE_M:
            return SOLVED
    return NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def best_pair(
    projections: Array, focal_px: Array, uv_px: Array, weight: Array, scale_m: float, best: Array, work: Workspace
) -> bool:
    """Fill ``best`` with the point of the camera pair that explains all cameras best, by the robust cost.

    Two good cameras suffice, however wrong the others are: this start is what makes the robust refinement robust. False if
    no pair gives a point in front of all cameras.
    """
    cameras, best_cost = len(weight), np.inf
    x, residual_px, depth_m, pair_weight = work.x, work.trial_residual_px, work.depth_m, work.pair_weight
    for c in range(cameras):
        pair_weight[c] = 0.0
    for a in range(cameras):
        for b in range(a + 1, cameras):
            if weight[a] <= 0.0 or weight[b] <= 0.0:
                continue
            pair_weight[a] = pair_weight[b] = 1.0
            determined = linear_point(projections, uv_px, pair_weight, x, work)
            pair_weight[a] = pair_weight[b] = 0.0
            if not determined or not reprojection(projections, uv_px, weight, x, residual_px, depth_m):
                continue
            scale_in_image(depth_m, focal_px, scale_m, work.scale_px)
            cost = cost_of(residual_px, weight, work.scale_px, best_cost)
            if cost < best_cost:
                best_cost = cost
                copy_values(x, best)
    return np.isfinite(best_cost)


@njit(cache=True, nogil=True, error_model="numpy")
def solve_points(  # noqa: PLR0913 - what it fills is passed in
    projections: Array,
    focal_px: Array,
    uv_px: Array,
    weight: Array,
    from_pairs: bool,
    refine: bool,
    scale_m: float,
    start: int,
    stop: int,
    xyz: Array,
    inverse: Array,
    residual_px: Array,
    status: npt.NDArray[np.uint8],
) -> None:
    """Solve the points from ``start`` to ``stop``: ``uv_px`` (point, camera, 2), ``weight`` (point, camera).

    ``inverse`` (point, 3, 3) is that of the Hessian, NaN where there is none.
    """
    hessian = np.zeros((3, 3))
    work = make_workspace(weight.shape[1])
    for i in range(start, stop):
        xyz[i] = np.nan
        inverse[i] = np.nan
        status[i] = TOO_FEW_CAMERAS
        seen, trust = uv_px[i], weight[i]
        if (trust > 0.0).sum() < 2:
            continue
        if from_pairs:
            determined = best_pair(projections, focal_px, seen, trust, scale_m, xyz[i], work)
        else:
            determined = linear_point(projections, seen, trust, xyz[i], work)
        if not determined:
            xyz[i] = np.nan
            continue
        if refine:
            status[i] = refine_point(projections, focal_px, seen, trust, scale_m, xyz[i], residual_px[i], hessian, work)
            invert_3x3(hessian, inverse[i])
        else:
            in_front = reprojection(projections, seen, trust, xyz[i], residual_px[i], work.depth_m)
            status[i] = SOLVED if in_front else BEHIND_CAMERA
