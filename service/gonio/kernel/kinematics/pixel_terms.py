"""The normal equations of the fit to pixels, one frame at a time: compiled.

A keypoint's reprojection residual in one camera, divided by its standard deviation, is

    e = (u − b − π(X(q, s, o))) / σ

with the keypoint's place X in the lab (coordinates q of the frame; segment scales s and keypoint offsets o of the whole
trial) and the camera's constant bias b for this keypoint. The loss is Cauchy's, c²/2 log(1 + |e|²/c²). The cameras of a
keypoint are summed into a 3 × 3 information and a 3-vector first, so that the kinematic chain is walked once a keypoint. Where
the gradient is all that is wanted, these 3-vectors are summed from the tips inwards, as forces are, and it is walked once.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from gonio.kernel.body.forward import differentiate_marker
from gonio.kernel.body.tree import (
    COORDINATE_POSE,
    NODE_POSE,
    Array,
    Tree,
    couple_coordinates,
    place_marker,
    pose_nodes,
)
from gonio.records import PRISMATIC, REVOLUTE

RESIDUALS, GRADIENT, NORMAL_EQUATIONS = 0, 1, 2

_LARGE = 1e100
"""Logarithms take time: one of a product stands for the sum of many, as long as that is far from overflowing."""


class Sight(NamedTuple):
    """What the cameras saw, and how it is weighed."""

    projections: Array  # (camera, 3, 4)
    uv_px: Array  # (camera, frame, marker, 2)
    precision: Array  # (camera, frame, marker): 1/σ, 0 where nothing was seen
    bias_px: Array  # (camera, marker, 2)
    loss_scale: float  # c, in standard deviations


class Layout(NamedTuple):
    """Which unknowns there are. The shared ones: log-scales, then offsets (marker, 3), then biases (camera, marker, 2)."""

    free: Array  # (free,): the coordinates that are solved for
    place: Array  # (coordinate,): where a coordinate is among the free ones, −1 where it is not
    node_group: Array  # (node,): the scale group that a node's placement belongs to, −1 for none
    marker_group: Array  # (marker,)
    marker_factor: Array  # (marker,): the present scale of its segment
    scales: int
    shared: bool  # whether the shared unknowns are solved for at all
    order: int  # RESIDUALS, GRADIENT or NORMAL_EQUATIONS: how much is wanted


class Sums(NamedTuple):
    """The normal equations; those of a frame are overwritten, those of the shared unknowns added to.

    Of Hessian and corner there is only the lower half. What the layout's order does not ask for is left as it is.
    """

    hessian: Array  # (frame, free, free)
    gradient: Array  # (frame, free)
    border: Array  # (frame, free, shared)
    corner: Array  # (shared, shared)
    shared_gradient: Array  # (shared,)
    error_px: Array  # (camera, frame, marker, 2)


class Keypoint(NamedTuple):
    """One keypoint in one frame: scratch arrays."""

    place: Array  # (3,)
    information: Array  # (3, 3): Λ
    pull: Array  # (3,): γ
    to_pixel: Array  # (camera, 2, 3)
    weight: Array  # (camera,)
    by_coordinate: Array  # (3, coordinate)
    moving: Array  # (free,): which of the free coordinates move it, as many as the frame says
    moved: Array  # (free, 3): how
    by_geometry: Array  # (scales + 3, 3): by the log-scales that move it, then by the own offset
    columns: Array  # (scales + 3 + 2 camera,): which shared unknowns those are, and those of the cameras' biases
    rows: Array  # (scales + 3 + 2 camera, 3): how they pull at its place
    forces: Array  # (node, 6): scratch of the gradient, 0 between frames


@njit(cache=True, nogil=True, error_model="numpy")
def sum_frames(tree: Tree, sight: Sight, layout: Layout, start: int, stop: int, q: Array, sums: Sums) -> float:
    """Fill the normal equations of the frames from ``start`` to ``stop`` at ``q`` (frame, coordinate); give their cost."""
    coordinates = np.zeros(len(tree.couplings), dtype=COORDINATE_POSE)
    nodes = np.zeros(len(tree.nodes), dtype=NODE_POSE)
    cameras = sight.projections.shape[0]
    seen = Keypoint(
        np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((cameras, 2, 3)), np.zeros(cameras),
        np.zeros((3, q.shape[1])), np.zeros(len(layout.free), dtype=np.int64), np.zeros((len(layout.free), 3)),
        np.zeros((layout.scales + 3, 3)), np.zeros(layout.scales + 3 + 2 * cameras, dtype=np.int64),
        np.zeros((layout.scales + 3 + 2 * cameras, 3)), np.zeros((len(tree.nodes), 6)),
    )  # fmt: skip
    cost = 0.0
    for frame in range(start, stop):
        if layout.order >= GRADIENT:
            sums.gradient[frame] = 0.0
        if layout.order == NORMAL_EQUATIONS:
            sums.hessian[frame] = 0.0
            sums.border[frame] = 0.0
        couple_coordinates(tree, q[frame], coordinates)
        pose_nodes(tree, q[frame], coordinates, nodes)
        for marker in range(len(tree.markers)):
            place_marker(nodes, tree.markers[marker], seen.place)
            cost += _look(sight, layout.order, frame, marker, seen, sums.error_px)
            if layout.order < NORMAL_EQUATIONS:
                index = tree.markers[marker].node
                if layout.order == GRADIENT and index >= 0:
                    _pull_node(seen.place, seen.pull, seen.forces[index])
                    if layout.shared:
                        _pull_shape(nodes, index, layout, len(tree.markers), marker, sums, frame, seen)
                continue
            if not np.any(seen.weight > 0.0):
                continue
            seen.by_coordinate[:] = 0.0
            differentiate_marker(tree, nodes, tree.markers[marker], seen.by_coordinate)
            moving = _find_moving(seen, layout.free)
            _add_frame(seen, moving, sums, frame)
            if layout.shared and tree.markers[marker].node >= 0:
                geometric = _differentiate_geometry(tree, nodes, layout, marker, seen)
                count = _add_biases(seen, layout, len(tree.markers), marker, geometric, sums, frame)
                _add_shared(seen, moving, geometric, count, sums, frame)
        if layout.order == GRADIENT:
            _hand_inwards(tree, nodes, layout, sums, frame, seen.forces)
    return cost


@njit(cache=True, error_model="numpy")
def _pull_node(place: Array, pull: Array, total: Array) -> None:
    """Let a keypoint pull at its node, as a force and its moment about the lab's origin."""
    x, y, z = place[0], place[1], place[2]
    pull_x, pull_y, pull_z = pull[0], pull[1], pull[2]
    total[0] += pull_x
    total[1] += pull_y
    total[2] += pull_z
    total[3] += y * pull_z - z * pull_y
    total[4] += z * pull_x - x * pull_z
    total[5] += x * pull_y - y * pull_x


@njit(cache=True, error_model="numpy")
def _pull_shape(
    nodes: Array, index: int, layout: Layout, markers: int, marker: int, sums: Sums, frame: int, seen: Keypoint
) -> None:
    """Let a keypoint pull at the length and the offset that put it into its node's frame, and at the cameras' biases."""
    x, pull, node = seen.place, seen.pull, nodes[index]
    gradient, group = sums.shared_gradient, layout.marker_group[marker]
    for i in range(3):
        if group >= 0:
            gradient[group] += (x[i] - node.p_lab_node[i]) * pull[i]
        for j in range(3):
            gradient[layout.scales + 3 * marker + j] += node.R_lab_node[i, j] * layout.marker_factor[marker] * pull[i]
    for c in range(len(seen.weight)):
        if seen.weight[c] > 0.0:
            first = layout.scales + 3 * markers + 2 * (c * markers + marker)
            for axis in range(2):
                gradient[first + axis] += seen.weight[c] * sums.error_px[c, frame, marker, axis]


@njit(cache=True, error_model="numpy")
def _hand_inwards(tree: Tree, nodes: Array, layout: Layout, sums: Sums, frame: int, forces: Array) -> None:
    """Sum the forces from the tips inwards, each node's times what its coordinate and its lengths move; leave them 0."""
    gradient, shared_gradient = sums.gradient[frame], sums.shared_gradient
    for index in range(len(tree.nodes) - 1, -1, -1):
        given, node, f, t = tree.nodes[index], nodes[index], forces[index, :3], forces[index, 3:]
        along = _dot(node.axis_lab, f)
        if given.driver >= 0 and layout.place[given.driver] >= 0:
            if given.kind == REVOLUTE:
                about, p = _dot(node.axis_lab, t), node.p_lab_node
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    about -= node.axis_lab[i] * (p[j] * f[k] - p[k] * f[j])
                gradient[layout.place[given.driver]] += node.first * about
            elif given.kind == PRISMATIC:
                gradient[layout.place[given.driver]] += node.first * along
        if given.parent >= 0:
            if layout.shared and layout.node_group[index] >= 0:
                slide = along * node.value if given.kind == PRISMATIC else 0.0
                shared_gradient[layout.node_group[index]] += slide + _pull_arm(nodes[given.parent], given, f)
            for i in range(6):
                forces[given.parent, i] += forces[index, i]
        for i in range(6):
            forces[index, i] = 0.0


@njit(cache=True, error_model="numpy")
def _pull_arm(parent: Array, given: Array, force: Array) -> float:
    """Give what a force does as a node's way from its parent grows."""
    done = 0.0
    for i in range(3):
        for j in range(3):
            done += parent.R_lab_node[i, j] * given.p_parent_node[j] * force[i]
    return done


@njit(cache=True, error_model="numpy")
def _find_moving(seen: Keypoint, free: Array) -> int:
    """List the free coordinates that move a keypoint, a third of all at most, and give their number."""
    count = 0
    for a in range(len(free)):
        for i in range(3):
            if seen.by_coordinate[i, free[a]] != 0.0:
                seen.moving[count] = a
                for j in range(3):
                    seen.moved[count, j] = seen.by_coordinate[j, free[a]]
                count += 1
                break
    return count


@njit(cache=True, error_model="numpy")
def _look(sight: Sight, order: int, frame: int, marker: int, seen: Keypoint, error_px: Array) -> float:
    """Sum a keypoint's cameras into Λ and γ, fill each camera's residual, derivative and weight, and give the cost.

    Written out in scalars, for it is done for each observation of each step.
    """
    x, y, z = seen.place[0], seen.place[1], seen.place[2]
    sharpness, cost, product = 1.0 / sight.loss_scale**2, 0.0, 1.0
    if order == NORMAL_EQUATIONS:
        seen.information[:] = 0.0
    pull_x = pull_y = pull_z = 0.0
    for c in range(len(sight.projections)):
        seen.weight[c] = 0.0
        p, precision = sight.projections[c], sight.precision[c, frame, marker]
        depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        if precision <= 0.0 or depth <= 0.05:  # m; a body that close to the lens is not seen either
            error_px[c, frame, marker, 0] = error_px[c, frame, marker, 1] = np.nan
            continue
        near = 1.0 / depth
        u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) * near
        v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) * near
        off_u = sight.uv_px[c, frame, marker, 0] - sight.bias_px[c, marker, 0] - u
        off_v = sight.uv_px[c, frame, marker, 1] - sight.bias_px[c, marker, 1] - v
        error_px[c, frame, marker, 0], error_px[c, frame, marker, 1] = off_u, off_v
        tamed = 1.0 + (off_u * off_u + off_v * off_v) * precision * precision * sharpness
        product *= tamed
        if product > _LARGE:
            cost, product = cost + np.log(product), 1.0
        if order == RESIDUALS:
            continue
        w = precision * precision / tamed
        seen.weight[c] = w
        u0, u1, u2 = (p[0, 0] - u * p[2, 0]) * near, (p[0, 1] - u * p[2, 1]) * near, (p[0, 2] - u * p[2, 2]) * near
        v0, v1, v2 = (p[1, 0] - v * p[2, 0]) * near, (p[1, 1] - v * p[2, 1]) * near, (p[1, 2] - v * p[2, 2]) * near
        pull_x += w * (u0 * off_u + v0 * off_v)
        pull_y += w * (u1 * off_u + v1 * off_v)
        pull_z += w * (u2 * off_u + v2 * off_v)
        if order == NORMAL_EQUATIONS:
            _inform(seen, c, w, (u0, u1, u2), (v0, v1, v2))
    seen.pull[0], seen.pull[1], seen.pull[2] = pull_x, pull_y, pull_z
    if order == NORMAL_EQUATIONS:
        _mirror(seen.information)
    return 0.5 * sight.loss_scale**2 * (cost + np.log(product))


@njit(cache=True, error_model="numpy")
def _inform(
    seen: Keypoint, camera: int, weight: float, u: tuple[float, float, float], v: tuple[float, float, float]
) -> None:
    """Keep a camera's derivatives, and add what it says to the lower half of Λ."""
    for i in range(3):
        seen.to_pixel[camera, 0, i], seen.to_pixel[camera, 1, i] = u[i], v[i]
        for j in range(i + 1):
            seen.information[i, j] += weight * (u[i] * u[j] + v[i] * v[j])


@njit(cache=True, error_model="numpy")
def _mirror(matrix: Array) -> None:
    matrix[0, 1], matrix[0, 2], matrix[1, 2] = matrix[1, 0], matrix[2, 0], matrix[2, 1]


@njit(cache=True, error_model="numpy")
def _add_frame(seen: Keypoint, moving: int, sums: Sums, frame: int) -> None:
    """Add Jᵀ γ and the lower half of Jᵀ Λ J of one keypoint, for the coordinates that move it, which are in rising order."""
    gradient, hessian, moved, L, pull = sums.gradient, sums.hessian, seen.moved, seen.information, seen.pull
    for k in range(moving):
        a = seen.moving[k]
        x, y, z = moved[k, 0], moved[k, 1], moved[k, 2]
        gradient[frame, a] += x * pull[0] + y * pull[1] + z * pull[2]
        carried_x = L[0, 0] * x + L[0, 1] * y + L[0, 2] * z
        carried_y = L[1, 0] * x + L[1, 1] * y + L[1, 2] * z
        carried_z = L[2, 0] * x + L[2, 1] * y + L[2, 2] * z
        for m in range(k + 1):
            hessian[frame, a, seen.moving[m]] += (
                carried_x * moved[m, 0] + carried_y * moved[m, 1] + carried_z * moved[m, 2]
            )


@njit(cache=True, error_model="numpy")
def _differentiate_geometry(tree: Tree, nodes: Array, layout: Layout, marker: int, seen: Keypoint) -> int:
    """Fill the derivatives of a keypoint's place by the shared unknowns that move it; give their number.

    By a group's log-scale: what its lengths contribute to the way from the root. By the offset: the axes of its own node.
    """
    by, index, scales = seen.by_geometry, tree.markers[marker].node, layout.scales
    by[:] = 0.0
    own, group, factor = nodes[index], layout.marker_group[marker], layout.marker_factor[marker]
    for i in range(3):
        for j in range(3):
            by[scales + j, i] = own.R_lab_node[i, j] * factor
        if group >= 0:
            by[group, i] += seen.place[i] - own.p_lab_node[i]
    while index >= 0:
        given, node, group = tree.nodes[index], nodes[index], layout.node_group[index]
        if group >= 0 and given.parent >= 0:
            turn, arm = nodes[given.parent].R_lab_node, given.p_parent_node
            for i in range(3):
                by[group, i] += turn[i, 0] * arm[0] + turn[i, 1] * arm[1] + turn[i, 2] * arm[2]
                if given.kind == PRISMATIC:  # a slide that follows an angle: the knee's
                    by[group, i] += node.axis_lab[i] * node.value
        index = given.parent
    count = 0
    for s in range(scales + 3):
        if s >= scales or by[s, 0] != 0.0 or by[s, 1] != 0.0 or by[s, 2] != 0.0:
            by[count, 0], by[count, 1], by[count, 2] = by[s, 0], by[s, 1], by[s, 2]
            seen.columns[count] = s if s < scales else s + 3 * marker
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _add_biases(
    seen: Keypoint, layout: Layout, markers: int, marker: int, geometric: int, sums: Sums, frame: int
) -> int:
    """Add what one keypoint says of each camera's bias for it, and list these after the geometry; give the number of all."""
    count = geometric
    for c in range(len(seen.weight)):
        if seen.weight[c] <= 0.0:
            continue
        for axis in range(2):
            column = layout.scales + 3 * markers + 2 * (c * markers + marker) + axis
            sums.shared_gradient[column] += seen.weight[c] * sums.error_px[c, frame, marker, axis]
            sums.corner[column, column] += seen.weight[c]
            seen.columns[count] = column
            for i in range(3):
                seen.rows[count, i] = seen.weight[c] * seen.to_pixel[c, axis, i]
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _add_shared(seen: Keypoint, moving: int, geometric: int, count: int, sums: Sums, frame: int) -> None:
    """Add what one keypoint says of scales and of its own offset, and of what they and its biases have in common.

    Of the corner only the lower half is filled; the columns are in rising order.
    """
    by, rows, columns, L, pull = seen.by_geometry, seen.rows, seen.columns, seen.information, seen.pull
    for a in range(geometric):
        x, y, z = by[a, 0], by[a, 1], by[a, 2]
        for i in range(3):
            rows[a, i] = L[i, 0] * x + L[i, 1] * y + L[i, 2] * z
        sums.shared_gradient[columns[a]] += x * pull[0] + y * pull[1] + z * pull[2]
    for a in range(geometric):
        x, y, z = by[a, 0], by[a, 1], by[a, 2]
        for r in range(a, count):
            sums.corner[columns[r], columns[a]] += rows[r, 0] * x + rows[r, 1] * y + rows[r, 2] * z
    for k in range(moving):
        coordinate, x, y, z = seen.moving[k], seen.moved[k, 0], seen.moved[k, 1], seen.moved[k, 2]
        for r in range(count):
            sums.border[frame, coordinate, columns[r]] += rows[r, 0] * x + rows[r, 1] * y + rows[r, 2] * z


@njit(cache=True, error_model="numpy")
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
