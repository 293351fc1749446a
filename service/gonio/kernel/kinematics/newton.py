"""One frame of inverse kinematics: the cost with its exact derivatives, and a bounded Newton descent. All compiled.

The markers are summed once per node, as if they were point masses of their weights ("composites", Featherstone 2008,
ch. 6: what he does for mass, this does for weight). With the twist (ω, v) of each node about the lab's origin, so
that a point p moves by ω × p + v, and with r = p − observed, the composites of all markers outwards of a node are

    m = Σ w      h = Σ w p      S = Σ w p pᵀ      f = Σ w r      G = Σ w p rᵀ

The gradient of ½ Σ w r² is ω·(Σ w p × r) + v·f. Its Gauss-Newton matrix is that of the kinetic energy of the point
masses, and what Newton's matrix has more, Σ w r·∂²p/∂qᵢ∂qⱼ = ωᵢ·(G ωⱼ − tr(G) ωⱼ + vⱼ × f), costs next to nothing. So
no marker's Jacobian is ever formed, and the descent converges quadratically though the residuals are centimetres.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from gonio.kernel.body.tree import Array, Tree, couple_coordinates, couple_nodes, place_point, pose_nodes
from gonio.records import REVOLUTE


class Problem(NamedTuple):
    """What stays the same over the frames; arrays over coordinates, where nothing else is said."""

    tree: Tree
    default: Array
    lower: Array
    upper: Array
    movable: Array  # bool: independent and not locked
    coordinate_weight: Array
    coordinate_target: Array
    root: Array  # bool: moves the whole body against the lab
    heading: int  # the root coordinate that turns the body about the vertical, −1 if there is none
    trunk: Array  # (marker,) bool: near the root
    tolerance: float  # rad or m
    max_iterations: int


class Workspace(NamedTuple):
    """Scratch arrays of one thread."""

    dq: Array
    ddq: Array
    value: Array
    first: Array
    second: Array
    rotation: Array
    position: Array
    omega: Array
    velocity: Array
    weight: Array
    first_moment: Array
    second_moment: Array
    force: Array
    cross_moment: Array
    gradient: Array
    hessian: Array
    scale: Array
    factor: Array
    step: Array
    trial: Array
    free: Array


@njit(cache=True)
def make_workspace(tree: Tree) -> Workspace:
    """Allocate what one thread needs."""
    nodes, coordinates = len(tree.parent), len(tree.coupled_to)
    return Workspace(
        np.empty(coordinates),
        np.empty(coordinates),
        np.empty(nodes),
        np.empty(nodes),
        np.empty(nodes),
        np.empty((nodes, 3, 3)),
        np.empty((nodes, 3)),
        np.empty((nodes, 3)),
        np.empty((nodes, 3)),
        np.empty(nodes),
        np.empty((nodes, 3)),
        np.empty((nodes, 3, 3)),
        np.empty((nodes, 3)),
        np.empty((nodes, 3, 3)),
        np.empty(coordinates),
        np.empty((coordinates, coordinates)),
        np.empty(coordinates),
        np.empty((coordinates, coordinates)),
        np.empty(coordinates),
        np.empty(coordinates),
        np.empty(coordinates, dtype=np.int64),
    )


@njit(cache=True)
def descend(
    problem: Problem, observed: Array, weights: Array, movable: Array, warm: bool, q: Array, work: Workspace
) -> tuple[float, int, bool]:
    """Minimise the cost of one frame from ``q`` (coordinate,), which is overwritten by the solution.

    ``observed`` (marker, 3) has NaN for a marker that was not seen, ``weights`` is (marker,), ``movable``
    (coordinate,) says which coordinates may change. Levenberg-Marquardt on Newton's matrix: while the last step was
    large the matrix is Gauss and Newton's, which is never indefinite. Bounds by projection: a coordinate at its bound
    that would go on outwards is held. ``warm``: the start is a good guess, so that Newton's matrix serves at once.
    Gives the cost, the number of iterations, and whether it converged.
    """
    for c in range(len(q)):
        q[c] = min(max(q[c], problem.lower[c]), problem.upper[c])
    exact = warm
    cost = linearise(problem, observed, weights, q, exact, work)
    damping = 0.0
    for iteration in range(1, problem.max_iterations + 1):
        count = _choose_free(problem, movable, q, work)
        while not _newton_step(count, damping, work):
            damping = max(10.0 * damping, 1e-9)
            if damping > 1e9:
                return cost, iteration, False
        size, clipped = 0.0, False
        work.trial[:] = q
        for k in range(count):
            c = work.free[k]
            work.trial[c] = min(max(q[c] + work.step[k], problem.lower[c]), problem.upper[c])
            clipped = clipped or work.trial[c] != q[c] + work.step[k]
            size = max(size, abs(work.trial[c] - q[c]))
        newton, exact = exact and not clipped, size < 0.2
        trial_cost = linearise(problem, observed, weights, work.trial, exact, work)
        if trial_cost <= cost * (1.0 + 1e-12) + 1e-18:
            q[:] = work.trial
            cost = trial_cost
            # Newton's steps square the error, and for bodies it stayed below 10 · step²; damped or turned at a bound
            # it need not.
            quadratic = newton and damping == 0.0 and 10.0 * size * size < problem.tolerance
            if quadratic or (size < problem.tolerance and damping < 1e-2):
                return cost, iteration, True
            damping = 0.1 * damping if damping > 1e-9 else 0.0
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e9:
                return cost, iteration, False
            cost = linearise(problem, observed, weights, q, exact, work)
    return cost, problem.max_iterations, False


@njit(cache=True)
def linearise(problem: Problem, observed: Array, weights: Array, q: Array, exact: bool, work: Workspace) -> float:
    """Give the cost at ``q`` and fill the workspace's gradient and matrix: Newton's if ``exact``, else Gauss-Newton's.

    Dependent coordinates in ``q`` are overwritten. ``work.scale`` is the diagonal of the Gauss-Newton matrix, the unit
    of the damping.
    """
    cost = _linearise_markers(problem.tree, observed, weights, q, exact, work)
    for c in range(len(q)):
        weight, driver = problem.coordinate_weight[c], c
        if weight > 0.0:
            while problem.tree.coupled_to[driver] >= 0:
                driver = problem.tree.coupled_to[driver]
            away = q[c] - problem.coordinate_target[c]
            cost += 0.5 * weight * away * away
            work.gradient[driver] += weight * away * work.dq[c]
            work.hessian[driver, driver] += weight * work.dq[c] ** 2
            work.scale[driver] += weight * work.dq[c] ** 2
            if exact:
                work.hessian[driver, driver] += weight * away * work.ddq[c]
    return cost


@njit(cache=True)
def measure(problem: Problem, observed: Array, weights: Array, q: Array, told: Array, work: Workspace) -> float:
    """Give the root mean square distance of the weighted markers from where they were seen, metres.

    Also fill ``told`` (coordinate,): whether any of these markers moves with the coordinate.
    """
    tree = problem.tree
    _linearise_markers(tree, observed, weights, q, False, work)
    count, square, point = 0, 0.0, np.empty(3)
    for marker in range(len(observed)):
        if weights[marker] > 0.0 and is_seen(observed[marker]):
            location = tree.marker_location_m[marker]
            place_point(work.rotation, work.position, tree.marker_node[marker], location, point)
            count += 1
            for i in range(3):
                square += (point[i] - observed[marker, i]) ** 2
    for c in range(len(q)):
        driver = c
        while tree.coupled_to[driver] >= 0:
            driver = tree.coupled_to[driver]
        told[c] = work.scale[driver] > 0.0
    return np.sqrt(square / count)


@njit(cache=True)
def is_seen(place: Array) -> bool:
    """Tell whether a point (3,) is known."""
    return not np.isnan(place[0] + place[1] + place[2])


@njit(cache=True)
def _linearise_markers(tree: Tree, observed: Array, weights: Array, q: Array, exact: bool, work: Workspace) -> float:
    """Fill gradient, Hessian and scale from the markers alone; give their cost."""
    couple_coordinates(tree, q, work.dq, work.ddq)
    couple_nodes(tree, q, work.dq, work.ddq, work.value, work.first, work.second)
    pose_nodes(tree, work.value, work.rotation, work.position, work.omega)
    cost = _sum_markers(tree, observed, weights, work)
    work.gradient.fill(0.0)
    work.hessian.fill(0.0)
    work.scale.fill(0.0)
    _sum_nodes(tree, exact, work)
    return cost


@njit(cache=True)
def _sum_markers(tree: Tree, observed: Array, weights: Array, work: Workspace) -> float:
    """Fill the nodes' composites and twists from the observed markers, their weights normalised to 1; give ½ Σ w r²."""
    work.weight.fill(0.0)
    work.first_moment.fill(0.0)
    work.second_moment.fill(0.0)
    work.force.fill(0.0)
    work.cross_moment.fill(0.0)
    point = np.empty(3)
    total = cost = 0.0
    for marker in range(len(observed)):
        if is_seen(observed[marker]):
            total += weights[marker]
    for marker in range(len(observed)):
        w, node = weights[marker] / total, tree.marker_node[marker]
        if w > 0.0 and is_seen(observed[marker]):
            place_point(work.rotation, work.position, node, tree.marker_location_m[marker], point)
            for i in range(3):
                cost += 0.5 * w * (point[i] - observed[marker, i]) ** 2
            if node >= 0:
                work.weight[node] += w
                for i in range(3):
                    work.first_moment[node, i] += w * point[i]
                    work.force[node, i] += w * (point[i] - observed[marker, i])
                    for j in range(3):
                        work.second_moment[node, i, j] += w * point[i] * point[j]
                        work.cross_moment[node, i, j] += w * point[i] * (point[j] - observed[marker, j])
    _hand_inwards(tree, work)
    return cost


@njit(cache=True)
def _hand_inwards(tree: Tree, work: Workspace) -> None:
    """Add each node's composite to its parent's, and turn axes into twists about the lab's origin."""
    for node in range(len(tree.parent) - 1, -1, -1):
        a, o = work.omega[node], work.position[node]
        if tree.kind[node] == REVOLUTE:
            work.velocity[node, 0] = o[1] * a[2] - o[2] * a[1]
            work.velocity[node, 1] = o[2] * a[0] - o[0] * a[2]
            work.velocity[node, 2] = o[0] * a[1] - o[1] * a[0]
        else:
            for i in range(3):
                work.velocity[node, i] = a[i]
                a[i] = 0.0
        parent = tree.parent[node]
        if parent >= 0:
            work.weight[parent] += work.weight[node]
            for i in range(3):
                work.first_moment[parent, i] += work.first_moment[node, i]
                work.force[parent, i] += work.force[node, i]
                for j in range(3):
                    work.second_moment[parent, i, j] += work.second_moment[node, i, j]
                    work.cross_moment[parent, i, j] += work.cross_moment[node, i, j]


@njit(cache=True)
def _sum_nodes(tree: Tree, exact: bool, work: Workspace) -> None:
    """Fill gradient, Hessian and scale from the composites, by the chain rule through the coupling."""
    momentum, linear = np.empty(3), np.empty(3)
    for node in range(len(tree.parent)):
        column, first = tree.driver[node], work.first[node]
        if column < 0 or work.weight[node] == 0.0:
            continue
        slope = _slope(node, work)
        work.gradient[column] += first * slope
        _momentum(node, False, work, momentum, linear)
        own = _dot(work.omega[node], momentum) + _dot(work.velocity[node], linear)
        work.scale[column] += first * first * own
        if exact:
            work.hessian[column, column] += work.second[node] * slope
            _momentum(node, True, work, momentum, linear)
        other = node
        while other >= 0:
            row = tree.driver[other]
            if row >= 0:
                entry = _dot(work.omega[other], momentum) + _dot(work.velocity[other], linear)
                entry *= first * work.first[other]
                work.hessian[row, column] += entry
                if other != node:
                    work.hessian[column, row] += entry
            other = tree.parent[other]


@njit(cache=True)
def _slope(node: int, work: Workspace) -> float:
    """Give the derivative of ½ Σ w r² with respect to a node's value: ω·(Σ w p × r) + v·f."""
    G, omega = work.cross_moment[node], work.omega[node]
    turning = omega[0] * (G[1, 2] - G[2, 1]) + omega[1] * (G[2, 0] - G[0, 2]) + omega[2] * (G[0, 1] - G[1, 0])
    return turning + _dot(work.velocity[node], work.force[node])


@njit(cache=True)
def _momentum(node: int, exact: bool, work: Workspace, momentum: Array, linear: Array) -> None:
    """Fill the momenta of a composite that moves with its node's twist; ``exact`` adds Newton's part."""
    omega, v, h = work.omega[node], work.velocity[node], work.first_moment[node]
    S, G, f = work.second_moment[node], work.cross_moment[node], work.force[node]
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        linear[i] = work.weight[node] * v[i] + omega[j] * h[k] - omega[k] * h[j]
        momentum[i] = h[j] * v[k] - h[k] * v[j] + trace * omega[i] - _dot(S[i], omega)
    if exact:
        trace = G[0, 0] + G[1, 1] + G[2, 2]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            momentum[i] += _dot(G[i], omega) - trace * omega[i] + v[j] * f[k] - v[k] * f[j]


@njit(cache=True)
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _choose_free(problem: Problem, movable: Array, q: Array, work: Workspace) -> int:
    """List the coordinates that may move now: observable ones that no bound holds. Gives their number."""
    count = 0
    for c in range(len(q)):
        held_below = q[c] <= problem.lower[c] and work.gradient[c] > 0.0
        held_above = q[c] >= problem.upper[c] and work.gradient[c] < 0.0
        if movable[c] and work.scale[c] > 0.0 and not held_below and not held_above:
            work.free[count] = c
            count += 1
    return count


@njit(cache=True)
def _newton_step(count: int, damping: float, work: Workspace) -> bool:
    """Solve (H + damping · scale) step = −gradient for the free coordinates; False if that is not positive definite."""
    L, free = work.factor, work.free
    for i in range(count):
        for j in range(i + 1):
            entry = work.hessian[free[i], free[j]]
            if i == j:
                entry += (damping + 1e-12) * work.scale[free[i]]
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = entry / L[j, j]
            elif entry > 1e-14 * work.scale[free[i]]:
                L[i, i] = np.sqrt(entry)
            else:
                return False
    for i in range(count):
        entry = -work.gradient[free[i]]
        for k in range(i):
            entry -= L[i, k] * work.step[k]
        work.step[i] = entry / L[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            work.step[i] -= L[k, i] * work.step[k]
        work.step[i] /= L[i, i]
    return True
