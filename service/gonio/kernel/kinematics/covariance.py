"""How far an inverse kinematics can be trusted: the covariance of the coordinates.

The solution makes the cost's gradient vanish, so errors of the observed points and of the targets move it, by the
implicit function theorem, by δq = H⁻¹ (Σ wᵢ Jᵢᵀ δpᵢ / Σ w + Σ W_c δtarget_c), with the exact Hessian H at the solution.
With independent errors of covariance Cᵢ (points) and σ_c² (targets)

    cov q = H⁻¹ (Σ wᵢ² Jᵢᵀ Cᵢ Jᵢ / (Σ w)² + Σ W_c² σ_c² e_c e_cᵀ) H⁻¹

Weights need not be the inverse of the variances for that, and the marker residuals of a wrong body don't enter.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numba import njit

from gonio.errors import InputError
from gonio.kernel.body.forward import couple, differentiate_marker, marker_positions
from gonio.kernel.body.tree import Array
from gonio.kernel.kinematics.inverse import pose_problem
from gonio.kernel.kinematics.newton import (
    Problem,
    Workspace,
    factorise,
    is_seen,
    linearise,
    make_workspace,
)
from gonio.kernel.parallel import over_blocks
from gonio.records import TOO_FEW_MARKERS, BodyModel, Motion, Tasks

_BLOCK = 64


def add_covariance(
    motion: Motion,
    model: BodyModel,
    tasks: Tasks,
    xyz_lab_m: Float[np.ndarray, "frame marker 3"],
    covariance_m2: Float[np.ndarray, "frame marker 3 3"],
    *,
    whole: bool = True,
) -> Motion:
    """Give the motion with the covariance of its coordinates in each frame.

    Args:
        motion: What :func:`gonio.kernel.kinematics.inverse.solve_motion` found.
        model: The model it was found with.
        tasks: The tasks it was found with; their ``target_sd`` counts.
        xyz_lab_m: The points it was found from.
        covariance_m2: Their covariances; what is NaN for a point that was seen makes its frame's covariance NaN.
        whole: Give the covariance; else the standard deviations only.

    Returns:
        The motion with its covariance, rad² and m²: NaN where the motion is, 0 for locked coordinates. A coordinate at
        the end of its range has the covariance that it would have without the bound.

    Raises:
        InputError: arrays that don't fit each other.
    """
    if covariance_m2.shape[:2] != xyz_lab_m.shape[:2] or len(motion.times_s) != len(xyz_lab_m):
        raise InputError(
            f"{len(motion.times_s)} frames were solved, {xyz_lab_m.shape[:2]} points are given, "
            f"{covariance_m2.shape[:2]} covariances.",
            hint="Give one covariance for each point of each solved frame.",
        )
    problem = pose_problem(model, tasks, 1e-6, 1)
    q = np.where(np.isnan(motion.values), model.coordinates.default, motion.values)
    weights, target_variance = tasks.marker_weights.copy(), tasks.target_sd**2
    count = q.shape[1]
    found = np.empty((len(q), count, count) if whole else (len(q), count))

    def propagate(start: int, stop: int) -> None:
        work, block = make_workspace(problem.tree), slice(start, stop)
        points, noise = (np.array(array[block], dtype=float, order="C") for array in (xyz_lab_m, covariance_m2))
        covariance = np.full((stop - start, count, count), np.nan)
        for row in np.flatnonzero(motion.status[block] != TOO_FEW_MARKERS):
            _propagate(
                problem, points[row], noise[row], weights, target_variance, q[start + row], covariance[row], work
            )
        unknown = np.isnan(motion.values[block])
        covariance[unknown[:, :, None] | unknown[:, None, :]] = np.nan
        found[block] = covariance if whole else np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))

    over_blocks(propagate, len(q), _BLOCK)
    found.setflags(write=False)  # so the record takes it as it is
    return replace(motion, covariance=found) if whole else replace(motion, sd=found)


def place_covariance_m2(model: BodyModel, motion: Motion) -> Float[np.ndarray, "frame marker 3 3"]:
    """Give the covariance of the markers' places that the coordinates' covariance makes; NaN where that is not known."""
    assert motion.covariance is not None  # a fit to pixels always has one
    known = np.asarray(np.isfinite(motion.values).all(axis=1))
    q = np.where(known[:, None], motion.values, model.coordinates.default)
    free = np.flatnonzero(model.coordinates.coupled_to < 0)
    step = 1e-5  # rad or m: the places are smooth, and 1e-5 of them is far above rounding
    here = marker_positions(model, couple(model, q))
    by = np.empty((*here.shape, len(free)))
    for column, coordinate in enumerate(free):
        moved = q.copy()
        moved[:, coordinate] += step
        by[..., column] = (marker_positions(model, couple(model, moved)) - here) / step
    own = motion.covariance[:, free[:, None], free]
    return np.where(known[:, None, None, None], np.einsum("fkia,fab,fkjb->fkij", by, own, by, optimize=True), np.nan)


@njit(cache=True, nogil=True, error_model="numpy")
def _propagate(
    problem: Problem,
    observed: Array,
    noise: Array,
    weights: Array,
    target_variance: Array,
    q: Array,
    covariance: Array,
    work: Workspace,
) -> None:
    """Fill the covariance (coordinate, coordinate) of one frame."""
    linearise(problem, observed, weights, q, True, work)
    count = 0
    for c in range(len(q) - 1, -1, -1):  # distal ones first, as ``factorise`` has them
        if problem.coordinates[c].movable and work.unknowns[c].scale > 0.0:
            work.free[count] = c
            count += 1
    if not factorise(count, 0.0, work):
        linearise(problem, observed, weights, q, False, work)
        if not factorise(count, 0.0, work):
            return  # a direction that nothing holds: NaN
    noisy = _perturb(problem, observed, noise, weights, target_variance, work)
    place, middle = np.full(len(q), -1), np.empty((count, count))
    for a in range(count):
        place[work.free[a]] = a
        for b in range(count):
            middle[a, b] = noisy[work.free[a], work.free[b]]
    _substitute_rows(work.factor, middle)
    middle = middle.T.copy()  # H⁻¹ middle was that, and what stands in the middle is symmetric
    _substitute_rows(work.factor, middle)
    couplings, pose = problem.tree.couplings, work.coordinates
    for a in range(len(q)):
        for b in range(len(q)):
            first, second = place[couplings[a].driver], place[couplings[b].driver]
            known = first >= 0 and second >= 0
            covariance[a, b] = pose[a].first * pose[b].first * middle[first, second] if known else 0.0


@njit(cache=True, error_model="numpy")
def _substitute_rows(U: Array, right: Array) -> None:
    """Replace many right sides, side by side, by the solutions of UᵀU x = right; what is 0 in U is skipped."""
    count, columns = right.shape
    for i in range(count):
        for r in range(columns):
            right[i, r] /= U[i, i]
        for k in range(i + 1, count):
            if U[i, k] != 0.0:
                for r in range(columns):
                    right[k, r] -= U[i, k] * right[i, r]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            if U[i, k] != 0.0:
                for r in range(columns):
                    right[i, r] -= U[i, k] * right[k, r]
        for r in range(columns):
            right[i, r] /= U[i, i]


@njit(cache=True, error_model="numpy")
def _list_moving(jacobian: Array, moving: Array) -> int:
    """List the columns of a Jacobian (3, coordinate) that are not zero, and give their number."""
    found = 0
    for c in range(jacobian.shape[1]):
        if jacobian[0, c] != 0.0 or jacobian[1, c] != 0.0 or jacobian[2, c] != 0.0:
            moving[found] = c
            found += 1
    return found


@njit(cache=True, error_model="numpy")
def _perturb(
    problem: Problem, observed: Array, noise: Array, weights: Array, target_variance: Array, work: Workspace
) -> Array:
    """Give the covariance of the gradient: Σ w² Jᵀ C J / (Σ w)² over the points, W² σ² over the targets."""
    tree, count = problem.tree, len(target_variance)
    middle, jacobian, turned = np.zeros((count, count)), np.empty((3, count)), np.empty((3, count))
    moving = np.empty(count, dtype=np.int64)  # the coordinates that move a marker: a third of all at most
    total = 0.0
    for marker in range(len(observed)):
        if is_seen(observed[marker]):
            total += weights[marker]
    for marker in range(len(observed)):
        if weights[marker] > 0.0 and is_seen(observed[marker]):
            jacobian.fill(0.0)
            differentiate_marker(tree, work.nodes, tree.markers[marker], jacobian)
            w = weights[marker] / total
            found = _list_moving(jacobian, moving)
            for c in moving[:found]:
                for i in range(3):
                    turned[i, c] = 0.0
                    for j in range(3):
                        turned[i, c] += w * w * noise[marker, i, j] * jacobian[j, c]
            for a in moving[:found]:
                for b in moving[:found]:
                    for i in range(3):
                        middle[a, b] += jacobian[i, a] * turned[i, b]
    for c in range(count):
        driver, slope = tree.couplings[c].driver, work.coordinates[c].first
        middle[driver, driver] += (problem.coordinates[c].weight * slope) ** 2 * target_variance[c]
    return middle
