"""One point from several cameras, compiled: linear start, pair hypotheses, Levenberg-Marquardt.

Everything here works on a single point, in scalar code that numba compiles; :mod:`gonio.kernel.triangulation.points`
runs it over all frames and keypoints. Image points are undistorted pixels; ``projections`` are ``K [R|t]``.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

SOLVED, TOO_FEW_CAMERAS, NOT_CONVERGED, BEHIND_CAMERA = 0, 1, 2, 3
"""How a point's solution ended."""

STEP_TOLERANCE_M = 1e-6  # a thousandth of what the best keypoint detector resolves
MAX_ITERATIONS = 50


@njit(cache=True)
def linear_point(projections: Array, uv_px: Array, weight: Array) -> tuple[Array, bool]:
    """Solve one point by weighted linear least squares (DLT) [Hartley & Sturm 1997, inhomogeneous form].

    Each observation gives the rows ``(u p3 - p1) X = 0`` and ``(v p3 - p2) X = 0``. The rows are scaled to unit length of
    their direction part, so that cameras of different focal lengths count alike. Returns the point and whether it is
    determined (at least two rays that are not parallel).
    """
    normal = np.zeros((3, 3))
    right, row = np.zeros(3), np.empty(4)
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
    return solve_3x3(normal, right)


@njit(cache=True)
def solve_3x3(matrix: Array, right: Array) -> tuple[Array, bool]:
    """Solve a symmetric positive definite 3 × 3 system by Cholesky; the second value is False where it is not definite."""
    x = np.zeros(3)
    l00 = matrix[0, 0]
    if not l00 > 0.0:
        return x, False
    l00 = np.sqrt(l00)
    l10, l20 = matrix[1, 0] / l00, matrix[2, 0] / l00
    l11 = matrix[1, 1] - l10 * l10
    # Relative to the diagonal, so that the test means the same in pixels and in metres.
    if not l11 > 1e-12 * matrix[1, 1]:
        return x, False
    l11 = np.sqrt(l11)
    l21 = (matrix[2, 1] - l20 * l10) / l11
    l22 = matrix[2, 2] - l20 * l20 - l21 * l21
    if not l22 > 1e-12 * matrix[2, 2]:
        return x, False
    l22 = np.sqrt(l22)
    y0 = right[0] / l00
    y1 = (right[1] - l10 * y0) / l11
    y2 = (right[2] - l20 * y0 - l21 * y1) / l22
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return x, True


@njit(cache=True)
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


@njit(cache=True)
def scale_in_image(depth_m: Array, focal_px: Array, scale_m: float) -> Array:
    """Give the robust scale in each camera's pixels: ``scale_m`` as seen at the point's depth.

    So what counts as an outlier is a distance in the lab, the same for a near and a far camera and for any image size.
    """
    scale_px = np.full(depth_m.shape[0], np.inf)
    for c in range(depth_m.shape[0]):
        if not np.isinf(scale_m) and depth_m[c] > 0.0:
            scale_px[c] = focal_px[c] * scale_m / depth_m[c]
    return scale_px


@njit(cache=True)
def cost_of(residual_px: Array, weight: Array, scale_px: Array) -> float:
    """Sum the cost of the residuals: ``w s² log(1 + (r/s)²)`` (Cauchy), or ``w r²`` where the scale is infinite."""
    total = 0.0
    for c in range(weight.shape[0]):
        if weight[c] <= 0.0:
            continue
        r2 = residual_px[c, 0] ** 2 + residual_px[c, 1] ** 2
        if np.isinf(scale_px[c]):
            total += weight[c] * r2
        else:
            total += weight[c] * scale_px[c] ** 2 * np.log1p(r2 / scale_px[c] ** 2)
    return total


@njit(cache=True)
def normal_equations(  # noqa: PLR0913 - what it fills is passed in: a compiled inner loop allocates nothing
    projections: Array,
    residual_px: Array,
    depth_m: Array,
    weight: Array,
    scale_px: Array,
    x: Array,
    hessian: Array,
    curvature: Array,
    gradient: Array,
) -> None:
    """Fill the derivatives of :func:`cost_of` (halved) at ``x``.

    ``hessian`` is the Gauss-Newton one with the loss's weights: the information that the observations carry.
    ``curvature`` adds the loss's second derivative along each residual [Triggs et al. 2000, §4.3], which may leave it
    indefinite: without it the iteration converges linearly, in up to a hundred steps.
    """
    hessian[:] = 0.0
    curvature[:] = 0.0
    gradient[:] = 0.0
    rows = np.zeros((2, 3))
    pull = np.zeros(3)
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


@njit(cache=True)
def damped_step(hessian: Array, curvature: Array, gradient: Array, damping: float) -> tuple[Array, bool]:
    """Solve the damped normal equations, by the curvature if it is positive definite, else by the Hessian."""
    damped = curvature.copy()
    for i in range(3):
        damped[i, i] += damping * hessian[i, i]
    step, solvable = solve_3x3(damped, gradient)
    if not solvable:  # between two explanations of the observations; the reweighted Hessian still leads downhill
        damped[:] = hessian
        for i in range(3):
            damped[i, i] *= 1.0 + damping
        step, solvable = solve_3x3(damped, gradient)
    return step, solvable


@njit(cache=True)
def refine_point(
    projections: Array,
    focal_px: Array,
    uv_px: Array,
    weight: Array,
    start: Array,
    scale_m: float,
    residual_px: Array,
    hessian: Array,
) -> tuple[Array, int]:
    """Refine one point by Levenberg-Marquardt on the (robust) weighted reprojection error.

    Fills ``residual_px`` and the ``hessian`` at the solution. Returns the point and its status.
    """
    x = start.copy()
    depth_m = np.zeros(weight.shape[0])
    gradient = np.zeros(3)
    trial_residual = np.zeros_like(residual_px)
    trial_depth = np.zeros_like(depth_m)
    if not reprojection(projections, uv_px, weight, x, residual_px, depth_m):
        return x, BEHIND_CAMERA
    # Held from here on: a scale that followed the point would reward moving away from a camera that disagrees.
    scale_px = scale_in_image(depth_m, focal_px, scale_m)
    cost = cost_of(residual_px, weight, scale_px)
    damping = 1e-3
    curvature = np.empty((3, 3))
    normal_equations(projections, residual_px, depth_m, weight, scale_px, x, hessian, curvature, gradient)
    for _ in range(MAX_ITERATIONS):
        step, solvable = damped_step(hessian, curvature, gradient, damping)
        if not solvable:
            return x, TOO_FEW_CAMERAS
        trial = x + step
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        trial_cost = np.inf
        better = reprojection(projections, uv_px, weight, trial, trial_residual, trial_depth)
        if better:
            trial_cost = cost_of(trial_residual, weight, scale_px)
            better = trial_cost <= cost
        if better:
            x, cost = trial, trial_cost
            residual_px[:] = trial_residual
            depth_m[:] = trial_depth
            damping = max(damping / 10.0, 1e-12)
            normal_equations(projections, residual_px, depth_m, weight, scale_px, x, hessian, curvature, gradient)
        else:
            damping *= 10.0
        if length < STEP_TOLERANCE_M:
            return x, SOLVED
    return x, NOT_CONVERGED


@njit(cache=True)
def best_pair(projections: Array, focal_px: Array, uv_px: Array, weight: Array, scale_m: float) -> tuple[Array, bool]:
    """Give the point of the camera pair that explains all cameras best, by the robust cost.

    Two good cameras suffice, however wrong the others are: this start is what makes the robust refinement robust. The
    second value is False if no pair gives a point in front of all cameras.
    """
    cameras = weight.shape[0]
    best = np.zeros(3)
    best_cost = np.inf
    pair_weight = np.zeros(cameras)
    residual_px = np.zeros((cameras, 2))
    depth_m = np.zeros(cameras)
    for a in range(cameras):
        for b in range(a + 1, cameras):
            if weight[a] <= 0.0 or weight[b] <= 0.0:
                continue
            pair_weight[:] = 0.0
            pair_weight[a] = 1.0
            pair_weight[b] = 1.0
            x, determined = linear_point(projections, uv_px, pair_weight)
            if not determined or not reprojection(projections, uv_px, weight, x, residual_px, depth_m):
                continue
            cost = cost_of(residual_px, weight, scale_in_image(depth_m, focal_px, scale_m))
            if cost < best_cost:
                best_cost = cost
                best = x
    return best, np.isfinite(best_cost)


@njit(cache=True, nogil=True)
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
    hessian: Array,
    residual_px: Array,
    status: npt.NDArray[np.uint8],
) -> None:
    """Solve the points from ``start`` to ``stop``: ``uv_px`` (point, camera, 2), ``weight`` (point, camera)."""
    depth_m = np.zeros(weight.shape[1])
    for i in range(start, stop):
        xyz[i] = np.nan
        status[i] = TOO_FEW_CAMERAS
        if (weight[i] > 0.0).sum() < 2:
            continue
        if from_pairs:
            first, determined = best_pair(projections, focal_px, uv_px[i], weight[i], scale_m)
        else:
            first, determined = linear_point(projections, uv_px[i], weight[i])
        if not determined:
            continue
        if refine:
            xyz[i], status[i] = refine_point(
                projections, focal_px, uv_px[i], weight[i], first, scale_m, residual_px[i], hessian[i]
            )
        else:
            xyz[i] = first
            in_front = reprojection(projections, uv_px[i], weight[i], first, residual_px[i], depth_m)
            status[i] = SOLVED if in_front else BEHIND_CAMERA
