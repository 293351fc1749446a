"""Inverse kinematics: the coordinates that put a model's markers where they were seen, frame by frame.

The frames are solved in chunks of fixed length, all cores at once: the first frame of a chunk is searched for from the
model's default pose, the others start from the frame before. Afterwards neighbours learn from each other, so that no
frame stays in a worse minimum than the next one knows. The result does not depend on the number of cores.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from gonio.errors import InputError
from gonio.kernel.body.tree import Array, Tree, flatten
from gonio.kernel.kinematics.newton import (
    COORDINATE_TASK,
    Problem,
    Workspace,
    copy_values,
    descend,
    is_seen,
    make_workspace,
    measure,
)
from gonio.kernel.parallel import over_blocks
from gonio.records import (
    GROUND,
    NOT_CONVERGED,
    PARTIAL,
    REVOLUTE,
    SOLVED,
    TOO_FEW_MARKERS,
    BodyModel,
    Motion,
    Tasks,
)

_CHUNK = 64  # frames: long enough that the search at its start is cheap, short enough to feed many cores
_FEWEST_MARKERS = 3
_HEADINGS = 4


class Answer(NamedTuple):
    """What the compiled loops fill, frame by frame."""

    q: Array  # (frame, coordinate)
    cost: Array
    iterations: Array
    status: Array
    residual_m: Array  # root mean square
    told: Array  # (frame, coordinate) bool: whether a marker that was seen moves with the coordinate


def solve_motion(
    model: BodyModel,
    tasks: Tasks,
    xyz_lab_m: Float[np.ndarray, "frame marker 3"],
    times_s: Float[np.ndarray, " frame"],
    *,
    tolerance: float = 1e-5,
    max_iterations: int = 100,
) -> Motion:
    """Find the coordinates of every frame by weighted least squares.

    The cost is OpenSim's (see :class:`gonio.records.Tasks`), minimised by Newton's method with the exact derivatives.
    Clamped coordinates stay in their range, locked ones at their default.

    Args:
        model: The body, scaled to the subject.
        tasks: The weights of its markers and coordinates.
        xyz_lab_m: Where the markers were seen, in the order of ``model.markers``; NaN where not.
        times_s: When.
        tolerance: A frame has converged when the error that is left is estimated to be smaller, rad or m.
        max_iterations: The limit for one frame.

    Returns:
        The motion, one column for each coordinate of the model, dependent ones included. A frame with fewer than
        three markers is NaN. A coordinate that no marker seen in a frame depends on is NaN there; one that no weighted
        marker depends on at all takes the target of its own task, and is NaN if it has none.

    Raises:
        InputError: shapes that don't fit the model, or no marker with a weight.
    """
    _check(model, tasks, xyz_lab_m)
    problem = pose_problem(model, tasks, tolerance, max_iterations)
    observed, weights, frames = np.array(xyz_lab_m, dtype=float, order="C"), tasks.marker_weights.copy(), len(xyz_lab_m)
    answer = Answer(
        q=np.empty((frames, len(problem.coordinates))),
        cost=np.full(frames, np.inf),
        iterations=np.zeros(frames, dtype=np.int64),
        status=np.full(frames, TOO_FEW_MARKERS, dtype=np.uint8),
        residual_m=np.full(frames, np.nan),
        told=np.zeros((frames, len(problem.coordinates)), dtype=bool),
    )

    def solve(start: int, stop: int) -> None:
        _solve_chunk(problem, observed, weights, start, stop, answer, make_workspace(problem.tree))

    def measure_block(start: int, stop: int) -> None:
        _measure_chunk(problem, observed, weights, start, stop, answer, make_workspace(problem.tree))

    over_blocks(solve, frames, _CHUNK)
    _mend(problem, observed, weights, answer, make_workspace(problem.tree))
    over_blocks(measure_block, frames, _CHUNK)
    q, status = answer.q, answer.status
    if problem.heading >= 0:
        _unwrap(q[:, problem.heading], status != TOO_FEW_MARKERS)
    assumed = model.coordinates.locked | (~_tellable(problem, weights) & (tasks.coordinate_weights > 0))
    known = (answer.told | assumed) & (status != TOO_FEW_MARKERS)[:, None]
    status[(status == SOLVED) & ~known.all(axis=1)] = PARTIAL
    return Motion(
        coordinate_names=model.coordinates.names,
        rotational=model.coordinates.rotational,
        times_s=times_s,
        values=np.where(known, q, np.nan),
        status=status,
        iterations=answer.iterations,
        residual_rms_m=answer.residual_m,
    )


def _check(model: BodyModel, tasks: Tasks, xyz_lab_m: Float[np.ndarray, "frame marker 3"]) -> None:
    markers, coordinates = len(model.markers.names), len(model.coordinates.names)
    if xyz_lab_m.shape[1] != markers or len(tasks.marker_weights) != markers:
        raise InputError(
            f"The model has {markers} markers, the trial {xyz_lab_m.shape[1]}, the tasks {len(tasks.marker_weights)}.",
            hint="Give one column and one weight for each marker of the model, in its order.",
        )
    if len(tasks.coordinate_weights) != coordinates:
        raise InputError(
            f"The model has {coordinates} coordinates, the tasks {len(tasks.coordinate_weights)}.",
            hint="Give one weight for each coordinate of the model, in its order.",
        )
    if not np.any(tasks.marker_weights > 0):
        raise InputError("No marker has a weight.", hint="Give at least three markers a weight above 0.")


def pose_problem(model: BodyModel, tasks: Tasks, tolerance: float, max_iterations: int) -> Problem:
    """Lay model and tasks out for the compiled solver."""
    given, tree = model.coordinates, flatten(model)
    of_ground = (model.joints.parent_body == GROUND) & (tree.nodes["driver"] >= 0)
    coordinates = np.zeros(len(given.names), dtype=COORDINATE_TASK)
    coordinates["default"] = given.default
    for bound, side, open_end in (("lower", 0, -np.inf), ("upper", 1, np.inf)):
        limit = np.where(given.clamped, given.range[:, side], open_end)
        coordinates[bound] = np.where(given.locked, given.default, limit)
    coordinates["weight"], coordinates["target"] = tasks.coordinate_weights, tasks.coordinate_targets
    coordinates["movable"] = (given.coupled_to < 0) & ~given.locked
    coordinates["root"][tree.nodes["driver"][of_ground]] = True
    return Problem(
        tree=tree,
        coordinates=coordinates,
        heading=_heading(model, tree, of_ground),
        trunk=_trunk(model),
        tolerance=tolerance,
        max_iterations=max_iterations,
    )


def _unwrap(heading: Array, solved: Bool[np.ndarray, " frame"]) -> None:
    """Let the heading start within half a turn of 0 and never jump by a turn, in place."""
    if np.any(solved):
        turns = np.unwrap(heading[solved])
        heading[solved] = turns - 2.0 * np.pi * np.round(turns[0] / (2.0 * np.pi))


def _tellable(problem: Problem, weights: Array) -> Bool[np.ndarray, " coordinate"]:
    """Mark the coordinates that some weighted marker moves with: what all of them together would tell of."""
    told, work = np.zeros(len(problem.coordinates), dtype=bool), make_workspace(problem.tree)
    measure(problem, np.zeros((len(weights), 3)), weights, problem.coordinates["default"].copy(), told, work)
    return told


def _heading(model: BodyModel, tree: Tree, of_ground: Bool[np.ndarray, " node"]) -> int:
    """Find the root coordinate that turns the body about the vertical: the one whose axis is nearest to gravity."""
    turning = np.flatnonzero(of_ground & (tree.nodes["kind"] == REVOLUTE))
    if len(turning) == 0:
        return -1
    upright = np.abs(tree.nodes["axis"][turning] @ model.gravity_m_s2)
    return int(tree.nodes["driver"][turning[np.argmax(upright)]])


def _trunk(model: BodyModel) -> Bool[np.ndarray, " marker"]:
    """Mark the markers of the trunk: the body that hangs on the lab, and the heaviest that hangs on it.

    Those show where a person is and which way they face, whatever the limbs do. Thighs would mislead: a seated person's
    knees and shoulders look like those of somebody who stands and leans.
    """
    parent_body = model.joints.parent_body[model.bodies.node]
    trunk = np.zeros(len(model.bodies.names) + 1, dtype=bool)  # the last one stands for the lab, body −1
    for root in np.flatnonzero(parent_body == GROUND):
        trunk[root] = True
        hanging = np.flatnonzero(parent_body == root)
        if len(hanging):
            trunk[hanging[np.argmax(model.bodies.mass_kg[hanging])]] = True
    return trunk[model.markers.body]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_chunk(
    problem: Problem, observed: Array, weights: Array, start: int, stop: int, answer: Answer, work: Workspace
) -> None:
    """Solve the frames from ``start`` to ``stop``, one after the other."""
    q, status = answer.q, answer.status
    for frame in range(start, stop):
        for c in range(q.shape[1]):
            q[frame, c] = problem.coordinates[c].default
        if _count_seen(observed[frame], weights) < _FEWEST_MARKERS:
            continue
        warm = frame > start and status[frame - 1] == SOLVED
        if warm:
            _predict(q, frame - 1, frame > start + 1 and status[frame - 2] == SOLVED, q[frame])
        else:
            _search(problem, observed[frame], weights, q[frame], work)
        result = descend(problem, observed[frame], weights, False, warm, q[frame], work)
        answer.cost[frame], answer.iterations[frame] = result[0], result[1]
        status[frame] = SOLVED if result[2] else NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def _predict(q: Array, before: int, moving: bool, start: Array) -> None:
    """Start from the frame before, carried on by its last change where there is one."""
    for c in range(len(start)):
        start[c] = 2.0 * q[before, c] - q[before - 1, c] if moving else q[before, c]


@njit(cache=True, error_model="numpy")
def _count_seen(observed: Array, weights: Array) -> int:
    count = 0
    for marker in range(len(weights)):
        if weights[marker] > 0.0 and is_seen(observed[marker]):
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _search(problem: Problem, observed: Array, weights: Array, q: Array, work: Workspace) -> None:
    """Find a start without knowing anything: ``q``, the default pose, moved as a whole to the markers of the trunk.

    People face any way, and a body turned by 180° is a minimum too: the root is fitted from four headings, and the best
    one wins.
    """
    near = np.empty(len(weights))
    for marker in range(len(weights)):
        near[marker] = weights[marker] if problem.trunk[marker] else 0.0
    if _count_seen(observed, near) < _FEWEST_MARKERS:
        near = weights
    default, best_cost = q.copy(), np.inf
    for attempt in range(_HEADINGS if problem.heading >= 0 else 1):
        trial = default.copy()
        if problem.heading >= 0:
            trial[problem.heading] += attempt * 2.0 * np.pi / _HEADINGS
        cost = descend(problem, observed, near, True, False, trial, work)[0]
        if cost < best_cost:
            best_cost = cost
            copy_values(trial, q)


@njit(cache=True, nogil=True, error_model="numpy")
def _mend(problem: Problem, observed: Array, weights: Array, answer: Answer, work: Workspace) -> None:
    """Let frames learn from their neighbours, forwards and then backwards, so that none stays in a wrong minimum.

    A frame is solved again from its neighbour's solution where two chunks meet, and where its cost is more than twice
    the neighbour's. If that is better, it replaces what was found.
    """
    frames, trial = len(answer.q), np.empty(answer.q.shape[1])
    for direction in (1, -1):
        for step in range(1, frames):
            frame = step if direction == 1 else frames - 1 - step
            neighbour = frame - direction
            if answer.status[frame] == TOO_FEW_MARKERS or answer.status[neighbour] != SOLVED:
                continue
            at_seam = max(frame, neighbour) % _CHUNK == 0
            if at_seam or answer.status[frame] != SOLVED or answer.cost[frame] > 2.0 * answer.cost[neighbour] + 1e-12:
                copy_values(answer.q[neighbour], trial)
                result = descend(problem, observed[frame], weights, False, True, trial, work)
                better = answer.status[frame] != SOLVED or result[0] < answer.cost[frame] * (1.0 - 1e-6)
                if result[2] and better:
                    copy_values(trial, answer.q[frame])
                    answer.cost[frame], answer.iterations[frame], answer.status[frame] = result[0], result[1], SOLVED


@njit(cache=True, nogil=True, error_model="numpy")
def _measure_chunk(
    problem: Problem, observed: Array, weights: Array, start: int, stop: int, answer: Answer, work: Workspace
) -> None:
    """Fill each frame's root mean square residual, and which coordinates its markers tell of."""
    for frame in range(start, stop):
        if answer.status[frame] != TOO_FEW_MARKERS:
            q, told = answer.q[frame], answer.told[frame]
            answer.residual_m[frame] = measure(problem, observed[frame], weights, q, told, work)
