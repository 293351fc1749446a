"""One point from several cameras, compiled: linear start, pair hypotheses, Levenberg-Marquardt.

Everything here works on a single point, in scalar code that numba compiles; :mod:`gonio.kernel.triangulation.points`
runs it over all frames and keypoints. Image points are undistorted pixels; ``projections`` are ``K [R|t]``. Symmetric
3 × 3 matrices are their lower triangles, row by row: 00, 10, 11, 20, 21, 22.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

SOLVED, TOO_FEW_CAMERAS, NOT_CONVERGED, BEHIND_CAMERA = 0, 1, 2, 3
"""How a point's solution ended."""

NEAREST_M = 1e-6
"""What is nearer to a camera's plane counts as behind it."""

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
    rays: Array  # (camera, 9): the normal matrix of each camera's ray, then its right side
    sharpness: Array  # (camera,): 1 / scale², px⁻²; 0 is a plain square
    normal: Array  # (15,): Hessian, curvature, gradient
    trial_normal: Array  # (15,)


HESSIAN, CURVATURE, GRADIENT = 0, 6, 12
"""Where they begin in ``normal``."""


@njit(cache=True, nogil=True, error_model="numpy")
def make_workspace(cameras: int) -> Workspace:
    """Allocate what one thread needs."""
    return Workspace(
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((cameras, 9)), np.zeros(cameras), np.zeros(15), np.zeros(15)
    )


@njit(cache=True, error_model="numpy")
def copy_values(source: Array, target: Array) -> None:
    """Copy one vector into another of its length."""
    for i in range(len(source)):
        target[i] = source[i]


@njit(cache=True, error_model="numpy")
def solve_3x3(matrix: Array, right: Array, x: Array) -> bool:
    """Solve a symmetric positive definite 3 × 3 system by Cholesky, into ``x``; False where it is not definite."""
    l00 = matrix[0]
    if not l00 > 0.0:
        return False
    l00 = np.sqrt(l00)
    l10, l20 = matrix[1] / l00, matrix[3] / l00
    l11 = matrix[2] - l10 * l10
    # Relative to the diagonal, so that the test means the same in pixels and in metres.
    if not l11 > 1e-12 * matrix[2]:
        return False
    l11 = np.sqrt(l11)
    l21 = (matrix[4] - l20 * l10) / l11
    l22 = matrix[5] - l20 * l20 - l21 * l21
    if not l22 > 1e-12 * matrix[5]:
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
    """Fill the full inverse of a symmetric matrix; it stays as it is where there is none."""
    a, b, d, c, e, f = matrix[0], matrix[1], matrix[2], matrix[3], matrix[4], matrix[5]
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
def add_outer(normal: Array, first: int, weight: float, x: float, y: float, z: float) -> None:
    """Add the weighted outer product of a vector with itself to a symmetric matrix that begins at ``first``."""
    normal[first] += weight * x * x
    normal[first + 1] += weight * y * x
    normal[first + 2] += weight * y * y
    normal[first + 3] += weight * z * x
    normal[first + 4] += weight * z * y
    normal[first + 5] += weight * z * z


@njit(cache=True, error_model="numpy")
def ray_equations(projections: Array, uv_px: Array, weight: Array, rays: Array) -> None:
    """Fill the normal equations of each camera's ray [DLT, Hartley & Sturm 1997, inhomogeneous form].

    An observation gives the rows ``(u p3 - p1) X = 0`` and ``(v p3 - p2) X = 0``. They are scaled to unit length of their
    direction part, so that cameras of different focal lengths count alike; no confidence is in them yet.
    """
    for c in range(projections.shape[0]):
        for k in range(9):
            rays[c, k] = 0.0
        if weight[c] <= 0.0:
            continue
        p = projections[c]
        for axis in range(2):
            at = uv_px[c, axis]
            r0, r1, r2 = at * p[2, 0] - p[axis, 0], at * p[2, 1] - p[axis, 1], at * p[2, 2] - p[axis, 2]
            scale = 1.0 / (r0 * r0 + r1 * r1 + r2 * r2)
            offset = scale * (at * p[2, 3] - p[axis, 3])
            add_outer(rays[c], 0, scale, r0, r1, r2)
            rays[c, 6] -= offset * r0
            rays[c, 7] -= offset * r1
            rays[c, 8] -= offset * r2


@njit(cache=True, error_model="numpy")
def linear_point(projections: Array, uv_px: Array, weight: Array, x: Array, work: Workspace) -> bool:
    """Solve one point by weighted linear least squares into ``x``; False if no two rays that aren't parallel determine it."""
    ray_equations(projections, uv_px, weight, work.rays)
    total = work.normal
    for k in range(9):
        total[k] = 0.0
        for c in range(len(weight)):
            total[k] += weight[c] * work.rays[c, k]
    return solve_3x3(total, total[6:], x)


@njit(cache=True, error_model="numpy")
def find_residuals(projections: Array, uv_px: Array, weight: Array, x: Array, residual_px: Array) -> bool:
    """Fill ``residual_px`` (observed minus projected), 0 for a camera without weight; False if ``x`` is behind a camera."""
    in_front = True
    for c in range(projections.shape[0]):
        residual_px[c, 0] = residual_px[c, 1] = 0.0
        if weight[c] <= 0.0:
            continue
        p = projections[c]
        depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
        in_front &= depth > NEAREST_M
        residual_px[c, 0] = uv_px[c, 0] - (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3]) / depth
        residual_px[c, 1] = uv_px[c, 1] - (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3]) / depth
    return in_front


@njit(cache=True, error_model="numpy")
def set_scale(projections: Array, focal_px: Array, weight: Array, scale_m: float, x: Array, sharpness: Array) -> None:
    """Fill the robust scale in each camera's pixels, as ``1 / scale²``: ``scale_m`` as seen at the point's depth.

    So what counts as an outlier is a distance in the lab, the same for a near and a far camera and for any image size.
    """
    for c in range(projections.shape[0]):
        p = projections[c, 2]
        depth = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3]
        sharpness[c] = (depth / (focal_px[c] * scale_m)) ** 2 if weight[c] > 0.0 and depth > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def loss(r2: float, sharpness: float) -> float:
    """Give ``s² log(1 + (r/s)²)`` (Cauchy), or ``r²`` for an infinite scale."""
    return np.log(1.0 + r2 * sharpness) / sharpness if sharpness > 0.0 else r2


@njit(cache=True, error_model="numpy")
def cost_of_pair(
    projections: Array, focal_px: Array, uv_px: Array, weight: Array, scale_m: float, x: Array, enough: float
) -> float:
    """Sum the robust cost of all observations at ``x``; infinite behind a camera, or as soon as it is ``enough``."""
    total = 0.0
    for c in range(projections.shape[0]):
        if weight[c] <= 0.0:
            continue
        p = projections[c]
        depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
        if depth <= NEAREST_M:
            return np.inf
        u = uv_px[c, 0] - (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3]) / depth
        v = uv_px[c, 1] - (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3]) / depth
        total += weight[c] * loss(u * u + v * v, (depth / (focal_px[c] * scale_m)) ** 2)
        if total >= enough:
            return np.inf
    return total


@njit(cache=True, error_model="numpy")
def cost_and_derivatives(
    projections: Array, uv_px: Array, weight: Array, sharpness: Array, x: Array, enough: float, normal: Array
) -> float:
    """Sum the cost at ``x`` and fill its derivatives (halved) into ``normal``: Hessian, curvature, gradient.

    The Hessian is the Gauss-Newton one with the loss's weights: the information that the observations carry. The curvature
    adds the loss's second derivative along each residual [Triggs et al. 2000, §4.3], which may leave it indefinite: without
    it the iteration converges linearly, in up to a hundred steps. Infinite behind a camera, or as soon as the cost is more
    than ``enough``; ``normal`` is then of no use.
    """
    total = 0.0
    for k in range(15):
        normal[k] = 0.0
    for c in range(projections.shape[0]):
        if weight[c] <= 0.0:
            continue
        p = projections[c]
        depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
        if depth <= NEAREST_M:
            return np.inf
        near = 1.0 / depth
        u = (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3]) * near
        v = (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3]) * near
        off_u, off_v = uv_px[c, 0] - u, uv_px[c, 1] - v
        r2 = off_u * off_u + off_v * off_v
        total += weight[c] * loss(r2, sharpness[c])
        if total > enough:
            return np.inf
        kept = 1.0 / (1.0 + r2 * sharpness[c])
        w = weight[c] * kept
        bend = -2.0 * w * kept * sharpness[c]
        # The rows of d(projected)/dx.
        u0, u1, u2 = (p[0, 0] - u * p[2, 0]) * near, (p[0, 1] - u * p[2, 1]) * near, (p[0, 2] - u * p[2, 2]) * near
        v0, v1, v2 = (p[1, 0] - v * p[2, 0]) * near, (p[1, 1] - v * p[2, 1]) * near, (p[1, 2] - v * p[2, 2]) * near
        g0, g1, g2 = u0 * off_u + v0 * off_v, u1 * off_u + v1 * off_v, u2 * off_u + v2 * off_v
        add_outer(normal, HESSIAN, w, u0, u1, u2)
        add_outer(normal, HESSIAN, w, v0, v1, v2)
        add_outer(normal, CURVATURE, bend, g0, g1, g2)
        normal[12] += w * g0
        normal[13] += w * g1
        normal[14] += w * g2
    for k in range(6):
        normal[CURVATURE + k] += normal[HESSIAN + k]
    return total


@njit(cache=True, error_model="numpy")
def damped_step(normal: Array, damping: float, work: Workspace) -> tuple[bool, bool]:
    """Fill the step by the damped normal equations: by the curvature if it is positive definite, else by the Hessian.

    Returns whether there is a step, and whether it is the curvature's.
    """
    damped, gradient = work.trial_normal, normal[GRADIENT:]
    for k in range(6):
        damped[k] = normal[CURVATURE + k]
    damped[0] += damping * normal[0]
    damped[2] += damping * normal[2]
    damped[5] += damping * normal[5]
    if solve_3x3(damped, gradient, work.step):
        return True, True
    for k in range(6):  # between two explanations of the observations; the reweighted Hessian still leads downhill
        damped[k] = normal[HESSIAN + k]
    damped[0] *= 1.0 + damping
    damped[2] *= 1.0 + damping
    damped[5] *= 1.0 + damping
    return solve_3x3(damped, gradient, work.step), False


@njit(cache=True, error_model="numpy")
def refine_point(
    projections: Array, focal_px: Array, uv_px: Array, weight: Array, scale_m: float, x: Array, work: Workspace
) -> int:
    """Refine one point ``x`` by Levenberg-Marquardt on the (robust) weighted reprojection error; gives its status.

    Overwrites ``x`` and leaves the Hessian at the solution in the workspace's ``normal``.
    """
    trial, step, normal = work.trial, work.step, work.normal
    # Held from here on: a scale that followed the point would reward moving away from a camera that disagrees.
    set_scale(projections, focal_px, weight, scale_m, x, work.sharpness)
    cost = cost_and_derivatives(projections, uv_px, weight, work.sharpness, x, np.inf, normal)
    if not np.isfinite(cost):
        return BEHIND_CAMERA
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        solvable, curved = damped_step(normal, damping, work)
        if not solvable:
            return TOO_FEW_CAMERAS
        for i in range(3):
            trial[i] = x[i] + step[i]
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        # Newton's steps square the error, in units of the loss's scale; the damping leaves its share of it.
        left = length * (CONTRACTION + 10.0 * damping + length / scale_m)
        trial_cost = cost_and_derivatives(projections, uv_px, weight, work.sharpness, trial, cost, work.trial_normal)
        if trial_cost <= cost:
            cost = trial_cost
            copy_values(trial, x)
            copy_values(work.trial_normal, normal)
            damping = max(damping / 10.0, 1e-12)
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
    x, both = work.x, work.normal
    ray_equations(projections, uv_px, weight, work.rays)
    for a in range(cameras):
        if weight[a] <= 0.0:
            continue
        for b in range(a + 1, cameras):
            if weight[b] <= 0.0:
                continue
            for k in range(9):
                both[k] = work.rays[a, k] + work.rays[b, k]
            if not solve_3x3(both, both[6:], x):
                continue
            cost = cost_of_pair(projections, focal_px, uv_px, weight, scale_m, x, best_cost)
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
            status[i] = refine_point(projections, focal_px, seen, trust, scale_m, xyz[i], work)
            invert_3x3(work.normal, inverse[i])
        in_front = find_residuals(projections, seen, trust, xyz[i], residual_px[i])
        if not refine:
            status[i] = SOLVED if in_front else BEHIND_CAMERA
