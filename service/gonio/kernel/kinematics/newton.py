"""One frame of inverse kinematics: the cost with its exact derivatives, and a bounded Newton descent. All compiled.

The markers are summed once per node, as if they were point masses of their weights ("composites", Featherstone 2008,
"Rigid body dynamics algorithms", ch. 6: what he does for mass, this does for weight). With the twist (ω, v) of each
node about the lab's origin, so that a point p moves by ω × p + v, and with r = p − observed, the composites of all
markers outwards of a node are

    m = Σ w      h = Σ w p      S = Σ w p pᵀ      f = Σ w r      G = Σ w p rᵀ

The gradient of ½ Σ w r² is ω·(Σ w p × r) + v·f. Its Gauss-Newton matrix is that of the kinetic energy of the point
masses, and what Newton's matrix has more, Σ w r·∂²p/∂qᵢ∂qⱼ = ωᵢ·(G ωⱼ − tr(G) ωⱼ + vⱼ × f), costs next to nothing. So
no marker's Jacobian is ever formed, and the descent converges quadratically though the residuals are centimetres.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from gonio.kernel.body.tree import COORDINATE_POSE, NODE_POSE, Array, Tree, couple_coordinates, place_marker, pose_nodes
from gonio.records import REVOLUTE

COORDINATE_TASK = np.dtype(
    [
        ("default", "f8"),
        ("lower", "f8"),  # ∓∞ where not clamped
        ("upper", "f8"),
        ("weight", "f8"),
        ("target", "f8"),
        ("movable", "?"),  # independent and not locked
        ("root", "?"),  # moves the whole body against the lab
    ],
    align=True,
)
COMPOSITE = np.dtype(
    [
        ("omega", "f8", 3),
        ("velocity", "f8", 3),
        ("weight", "f8"),
        ("first_moment", "f8", 3),
        ("second_moment", "f8", (3, 3)),
        ("force", "f8", 3),
        ("cross_moment", "f8", (3, 3)),
    ],
    align=True,
)
UNKNOWN = np.dtype(
    [
        ("gradient", "f8"),
        ("scale", "f8"),  # the diagonal of the Gauss-Newton matrix: the damping's unit
        ("step", "f8"),
    ],
    align=True,
)


class Problem(NamedTuple):
    """What stays the same over the frames."""

    tree: Tree
    coordinates: Array  # (coordinate,) COORDINATE_TASK
    heading: int  # the root coordinate that turns the body about the vertical, −1 if there is none
    trunk: Array  # (marker,) bool: on the trunk
    tolerance: float  # rad or m
    max_iterations: int


class Workspace(NamedTuple):
    """Scratch arrays of one thread."""

    coordinates: Array  # (coordinate,) COORDINATE_POSE
    nodes: Array  # (node,) NODE_POSE
    composites: Array  # (node,) COMPOSITE
    unknowns: Array  # (coordinate,) UNKNOWN
    trial: Array  # (coordinate,)
    hessian: Array  # (coordinate, coordinate)
    factor: Array  # (coordinate, coordinate)
    column: Array  # (coordinate,)
    free: Array  # (coordinate,): those that may move now come first


def make_workspace(tree: Tree) -> Workspace:
    """Allocate what one thread needs."""
    nodes, coordinates = len(tree.nodes), len(tree.couplings)
    return Workspace(
        coordinates=np.zeros(coordinates, dtype=COORDINATE_POSE),
        nodes=np.zeros(nodes, dtype=NODE_POSE),
        composites=np.zeros(nodes, dtype=COMPOSITE),
        unknowns=np.zeros(coordinates, dtype=UNKNOWN),
        trial=np.zeros(coordinates),
        hessian=np.zeros((coordinates, coordinates)),
        factor=np.zeros((coordinates, coordinates)),
        column=np.zeros(coordinates),
        free=np.zeros(coordinates, dtype=np.int64),
    )


@njit(cache=True, error_model="numpy")
def descend(
    problem: Problem, observed: Array, weights: Array, root_only: bool, warm: bool, q: Array, work: Workspace
) -> tuple[float, int, bool]:
    """Minimise the cost of one frame from ``q`` (coordinate,), which is overwritten by the solution.

    ``observed`` (marker, 3) has NaN for a marker that was not seen, ``weights`` is (marker,). ``root_only`` moves the
    body as a whole; ``warm`` says that the start is a good guess, so that Newton's matrix serves at once.

    Levenberg-Marquardt on Newton's matrix; on Gauss and Newton's while the last step was large. Bounds by projection: a
    coordinate at its bound that would go on outwards is held. Gives the cost, the number of iterations, and whether it
    converged.
    """
    for c in range(len(q)):
        q[c] = min(max(q[c], problem.coordinates[c].lower), problem.coordinates[c].upper)
    exact, damping = warm, 0.0
    cost = linearise(problem, observed, weights, q, exact, work)
    for iteration in range(1, problem.max_iterations + 1):
        count = _choose_free(problem, root_only, q, work)
        while not _newton_step(count, damping, work):
            if exact:  # far from the minimum Newton's matrix can be indefinite: Gauss and Newton's is not
                exact = False
                cost = linearise(problem, observed, weights, q, exact, work)
            elif damping > 1e9:
                return cost, iteration, False
            else:
                damping = max(10.0 * damping, 1e-9)
        size, clipped = _step_within_bounds(problem, count, q, work)
        if exact and not clipped and damping == 0.0 and 10.0 * size * size < problem.tolerance:
            # An undamped Newton step squares the error (for bodies it stayed below 10 · step²): no need to look again.
            copy_values(work.trial, q)
            couple_coordinates(problem.tree, q, work.coordinates)
            return cost - 0.5 * _decrease(count, work), iteration, True
        exact = size < 0.2
        trial_cost = linearise(problem, observed, weights, work.trial, exact, work)
        if trial_cost <= cost * (1.0 + 1e-12) + 1e-18:
            copy_values(work.trial, q)
            cost = trial_cost
            if size < problem.tolerance and damping < 1e-2:
                return cost, iteration, True
            damping = 0.01 * damping if damping > 1e-4 else 0.0
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e9:
                return cost, iteration, False
            cost = linearise(problem, observed, weights, q, exact, work)
    return cost, problem.max_iterations, False


@njit(cache=True, error_model="numpy")
def _decrease(count: int, work: Workspace) -> float:
    """Give −gradient · step: twice what a full Newton step takes off the cost."""
    decrease = 0.0
    for k in range(count):
        unknown = work.unknowns[work.free[k]]
        decrease -= unknown.gradient * unknown.step
    return decrease


@njit(cache=True, error_model="numpy")
def _step_within_bounds(problem: Problem, count: int, q: Array, work: Workspace) -> tuple[float, bool]:
    """Fill the trial point; give the largest change of a coordinate, and whether a bound cut one short."""
    size, clipped = 0.0, False
    copy_values(q, work.trial)
    for k in range(count):
        c = work.free[k]
        wanted = q[c] + work.unknowns[c].step
        work.trial[c] = min(max(wanted, problem.coordinates[c].lower), problem.coordinates[c].upper)
        clipped = clipped or work.trial[c] != wanted
        size = max(size, abs(work.trial[c] - q[c]))
    return size, clipped


@njit(cache=True, error_model="numpy")
def linearise(problem: Problem, observed: Array, weights: Array, q: Array, exact: bool, work: Workspace) -> float:
    """Give the cost at ``q`` and fill the workspace's gradient and matrix: Newton's if ``exact``, else Gauss-Newton's.

    Dependent coordinates in ``q`` are overwritten.
    """
    cost = _linearise_markers(problem.tree, observed, weights, q, exact, work)
    for c in range(len(q)):
        task, pose = problem.coordinates[c], work.coordinates[c]
        if task.weight > 0.0:
            driver = problem.tree.couplings[c].driver
            away = q[c] - task.target
            cost += 0.5 * task.weight * away * away
            work.unknowns[driver].gradient += task.weight * away * pose.first
            work.unknowns[driver].scale += task.weight * pose.first**2
            work.hessian[driver, driver] += task.weight * pose.first**2
            if exact:
                work.hessian[driver, driver] += task.weight * away * pose.second
    return cost


@njit(cache=True, error_model="numpy")
def measure(problem: Problem, observed: Array, weights: Array, q: Array, told: Array, work: Workspace) -> float:
    """Give the root mean square distance of the weighted markers from where they were seen, metres.

    Also fill ``told`` (coordinate,): whether any of these markers moves with the coordinate.
    """
    tree = problem.tree
    couple_coordinates(tree, q, work.coordinates)
    pose_nodes(tree, q, work.coordinates, work.nodes)
    for node in range(len(tree.nodes)):
        work.composites[node].weight = 0.0
    count, square, point = 0, 0.0, np.empty(3)
    for marker in range(len(observed)):
        given = tree.markers[marker]
        if weights[marker] > 0.0 and is_seen(observed[marker]):
            place_marker(work.nodes, given, point)
            count += 1
            for i in range(3):
                square += (point[i] - observed[marker, i]) ** 2
            if given.node >= 0:
                work.composites[given.node].weight += 1.0
    for c in range(len(q)):
        told[c] = False
    for node in range(len(tree.nodes) - 1, -1, -1):
        given, seen = tree.nodes[node], work.composites[node].weight > 0.0
        if given.parent >= 0 and seen:
            work.composites[given.parent].weight += 1.0
        if given.driver >= 0 and seen:
            told[given.driver] = True
    for c in tree.coupling_order:
        told[c] = told[tree.couplings[c].driver]
    return np.sqrt(square / count)


@njit(cache=True, error_model="numpy")
def copy_values(source: Array, target: Array) -> None:
    """Copy one array into another of its length; numba takes far longer to compile ``target[:] = source``."""
    for i in range(len(source)):
        target[i] = source[i]


@njit(cache=True, error_model="numpy")
def is_seen(place: Array) -> bool:
    """Tell whether a point (3,) is known."""
    return not np.isnan(place[0] + place[1] + place[2])


@njit(cache=True, error_model="numpy")
def _linearise_markers(tree: Tree, observed: Array, weights: Array, q: Array, exact: bool, work: Workspace) -> float:
    """Fill gradient, matrix and scale from the markers alone; give their cost."""
    couple_coordinates(tree, q, work.coordinates)
    pose_nodes(tree, q, work.coordinates, work.nodes)
    _start_composites(tree, work)
    cost = _add_markers(tree, observed, weights, work)
    _hand_inwards(tree, work)
    for c in range(len(q)):
        work.unknowns[c].gradient = work.unknowns[c].scale = 0.0
        for d in range(len(q)):
            work.hessian[c, d] = 0.0
    _sum_nodes(tree, exact, work)
    return cost


@njit(cache=True, error_model="numpy")
def _start_composites(tree: Tree, work: Workspace) -> None:
    """Empty the composites, and fill in the twists about the lab's origin."""
    for index in range(len(tree.nodes)):
        node, sums = work.nodes[index], work.composites[index]
        sums.weight = 0.0
        turns = tree.nodes[index].kind == REVOLUTE
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            arm = node.p_lab_node[j] * node.axis_lab[k] - node.p_lab_node[k] * node.axis_lab[j]
            sums.omega[i] = node.axis_lab[i] if turns else 0.0
            sums.velocity[i] = arm if turns else node.axis_lab[i]
            sums.first_moment[i] = sums.force[i] = 0.0
            for n in range(3):
                sums.second_moment[i, n] = sums.cross_moment[i, n] = 0.0


@njit(cache=True, error_model="numpy")
def _add_markers(tree: Tree, observed: Array, weights: Array, work: Workspace) -> float:
    """Add the observed markers, their weights normalised to 1, to their nodes' composites; give ½ Σ w r²."""
    point, residual = np.empty(3), np.empty(3)
    total = cost = 0.0
    for marker in range(len(observed)):
        if is_seen(observed[marker]):
            total += weights[marker]
    for marker in range(len(observed)):
        if weights[marker] > 0.0 and is_seen(observed[marker]):
            given, w = tree.markers[marker], weights[marker] / total
            place_marker(work.nodes, given, point)
            for i in range(3):
                residual[i] = point[i] - observed[marker, i]
                cost += 0.5 * w * residual[i] ** 2
            if given.node >= 0:
                sums = work.composites[given.node]
                sums.weight += w
                for i in range(3):
                    sums.first_moment[i] += w * point[i]
                    sums.force[i] += w * residual[i]
                    for j in range(3):
                        sums.second_moment[i, j] += w * point[i] * point[j]
                        sums.cross_moment[i, j] += w * point[i] * residual[j]
    return cost


@njit(cache=True, error_model="numpy")
def _hand_inwards(tree: Tree, work: Workspace) -> None:
    """Add each node's composite to its parent's."""
    for index in range(len(tree.nodes) - 1, -1, -1):
        if tree.nodes[index].parent >= 0:
            own, parent = work.composites[index], work.composites[tree.nodes[index].parent]
            parent.weight += own.weight
            for i in range(3):
                parent.first_moment[i] += own.first_moment[i]
                parent.force[i] += own.force[i]
                for j in range(3):
                    parent.second_moment[i, j] += own.second_moment[i, j]
                    parent.cross_moment[i, j] += own.cross_moment[i, j]


@njit(cache=True, error_model="numpy")
def _sum_nodes(tree: Tree, exact: bool, work: Workspace) -> None:
    """Fill gradient, matrix and scale from the composites, by the chain rule through the coupling."""
    angular, linear = np.empty(3), np.empty(3)
    for index in range(len(tree.nodes)):
        column, first, sums = tree.nodes[index].driver, work.nodes[index].first, work.composites[index]
        if column < 0 or sums.weight == 0.0:
            continue
        slope = _slope(sums)
        work.unknowns[column].gradient += first * slope
        _momentum(sums, False, angular, linear)
        work.unknowns[column].scale += first * first * _power(sums, angular, linear)
        if exact:
            work.hessian[column, column] += work.nodes[index].second * slope
            _momentum(sums, True, angular, linear)
        other = index
        while other >= 0:
            row = tree.nodes[other].driver
            if row >= 0:
                entry = first * work.nodes[other].first * _power(work.composites[other], angular, linear)
                work.hessian[row, column] += entry
                if other != index:
                    work.hessian[column, row] += entry
            other = tree.nodes[other].parent


@njit(cache=True, error_model="numpy")
def _power(sums: Array, angular: Array, linear: Array) -> float:
    """Multiply a node's twist with a momentum."""
    turning = sums.omega[0] * angular[0] + sums.omega[1] * angular[1] + sums.omega[2] * angular[2]
    return turning + sums.velocity[0] * linear[0] + sums.velocity[1] * linear[1] + sums.velocity[2] * linear[2]


@njit(cache=True, error_model="numpy")
def _slope(sums: Array) -> float:
    """Give the derivative of ½ Σ w r² with respect to a node's value: ω·(Σ w p × r) + v·f."""
    G, slope = sums.cross_moment, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        slope += sums.omega[i] * (G[j, k] - G[k, j]) + sums.velocity[i] * sums.force[i]
    return slope


@njit(cache=True, error_model="numpy")
def _momentum(sums: Array, exact: bool, angular: Array, linear: Array) -> None:
    """Fill the momenta of a composite that moves with its node's twist; ``exact`` adds Newton's part to the angular."""
    omega, v, h, S, G, f = (
        sums.omega,
        sums.velocity,
        sums.first_moment,
        sums.second_moment,
        sums.cross_moment,
        sums.force,
    )
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        linear[i] = sums.weight * v[i] + omega[j] * h[k] - omega[k] * h[j]
        angular[i] = h[j] * v[k] - h[k] * v[j] + trace * omega[i]
        for n in range(3):
            angular[i] -= S[i, n] * omega[n]
    if exact:
        trace = G[0, 0] + G[1, 1] + G[2, 2]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            angular[i] += v[j] * f[k] - v[k] * f[j] - trace * omega[i]
            for n in range(3):
                angular[i] += G[i, n] * omega[n]


@njit(cache=True, error_model="numpy")
def _choose_free(problem: Problem, root_only: bool, q: Array, work: Workspace) -> int:
    """List the coordinates that may move now, distal ones first: observable, and held by no bound. Gives their number."""
    count = 0
    for c in range(len(q) - 1, -1, -1):
        given, unknown = problem.coordinates[c], work.unknowns[c]
        movable = given.movable and (given.root or not root_only) and unknown.scale > 0.0
        held_below = q[c] <= given.lower and unknown.gradient > 0.0
        held_above = q[c] >= given.upper and unknown.gradient < 0.0
        if movable and not held_below and not held_above:
            work.free[count] = c
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _newton_step(count: int, damping: float, work: Workspace) -> bool:
    """Solve (H + damping · scale) step = −gradient for the free coordinates; False if that is not positive definite."""
    if not factorise(count, damping, work):
        return False
    for i in range(count):
        work.column[i] = -work.unknowns[work.free[i]].gradient
    substitute(count, work)
    for i in range(count):
        work.unknowns[work.free[i]].step = work.column[i]
    return True


@njit(cache=True, error_model="numpy")
def factorise(count: int, damping: float, work: Workspace) -> bool:
    """Factorise H + damping · scale of the free coordinates as Uᵀ U; False if that is not positive definite.

    Rows are taken off the rows below them: that runs along memory, and where a limb has nothing to do with another one
    the factor is 0 and the row is skipped. Distal coordinates come first (see :func:`_choose_free`), so that no such
    zeros are lost (Featherstone 2008, ch. 8.5).
    """
    U, free = work.factor, work.free
    for i in range(count):
        for j in range(i, count):
            U[i, j] = work.hessian[free[i], free[j]]
        U[i, i] += (damping + 1e-12) * work.unknowns[free[i]].scale
    for i in range(count):
        if not U[i, i] > 1e-14 * work.unknowns[free[i]].scale:
            return False
        inverse = 1.0 / np.sqrt(U[i, i])
        for j in range(i, count):
            U[i, j] *= inverse
        for k in range(i + 1, count):
            factor = U[i, k]
            if factor != 0.0:
                for j in range(k, count):
                    U[k, j] -= factor * U[i, j]
    return True


@njit(cache=True, error_model="numpy")
def substitute(count: int, work: Workspace) -> None:
    """Replace ``work.column`` by the solution of the factorised system with it on the right."""
    U, column = work.factor, work.column
    for i in range(count):
        column[i] /= U[i, i]
        for k in range(i + 1, count):
            column[k] -= U[i, k] * column[i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            column[i] -= U[i, k] * column[k]
        column[i] /= U[i, i]
