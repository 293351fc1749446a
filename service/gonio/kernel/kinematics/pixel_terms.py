"""The normal equations of the fit to pixels, one frame at a time: compiled.

A keypoint's reprojection residual in one camera, divided by its standard deviation, is

    e = (u − b − π(X(q, s, o))) / σ

with the keypoint's place X in the lab (coordinates q of the frame; segment scales s and keypoint offsets o of the whole
trial) and the camera's constant bias b for this keypoint. The loss is Cauchy's, c²/2 log(1 + |e|²/c²). The cameras of a
keypoint are summed into a 3 × 3 information and a 3-vector first, so that the kinematic chain is walked once a keypoint.
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
from gonio.records import PRISMATIC

RESIDUALS, GRADIENT, NORMAL_EQUATIONS = 0, 1, 2


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
    node_group: Array  # (node,): the scale group that a node's placement belongs to, −1 for none
    marker_group: Array  # (marker,)
    marker_factor: Array  # (marker,): the present scale of its segment
    scales: int
    shared: bool  # whether the shared unknowns are solved for at all
    order: int  # RESIDUALS, GRADIENT or NORMAL_EQUATIONS: how much is wanted


class Sums(NamedTuple):
    """The normal equations; those of a frame are overwritten, those of the shared unknowns added to.

    What the layout's order does not ask for is left as it is.
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
    by_geometry: Array  # (3, scales + 3): the log-scales that move it, then the own offset
    columns: Array  # (scales + 3,): which shared unknowns those are, as many as the keypoint says


@njit(cache=True, nogil=True, error_model="numpy")
def sum_frames(tree: Tree, sight: Sight, layout: Layout, start: int, stop: int, q: Array, sums: Sums) -> float:
    """Fill the normal equations of the frames from ``start`` to ``stop`` at ``q`` (frame, coordinate); give their cost."""
    coordinates = np.zeros(len(tree.couplings), dtype=COORDINATE_POSE)
    nodes = np.zeros(len(tree.nodes), dtype=NODE_POSE)
    cameras = sight.projections.shape[0]
    seen = Keypoint(
        np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((cameras, 2, 3)), np.zeros(cameras),
        np.zeros((3, q.shape[1])), np.zeros(len(layout.free), dtype=np.int64),
        np.zeros((3, layout.scales + 3)), np.zeros(layout.scales + 3, dtype=np.int64),
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
            cost += _look(sight, frame, marker, seen, sums.error_px)
            if layout.order == RESIDUALS or not np.any(seen.weight > 0.0):
                continue
            seen.by_coordinate[:] = 0.0
            differentiate_marker(tree, nodes, tree.markers[marker], seen.by_coordinate)
            moving = _find_moving(seen, layout.free)
            _add_frame(seen, layout, moving, sums, frame)
            if layout.shared and tree.markers[marker].node >= 0:
                geometric = _differentiate_geometry(tree, nodes, layout, marker, seen)
                _add_geometry(seen, layout, moving, geometric, sums, frame)
                _add_biases(seen, layout, len(tree.markers), marker, moving, geometric, sums, frame)
    return cost


@njit(cache=True, error_model="numpy")
def _find_moving(seen: Keypoint, free: Array) -> int:
    """List the free coordinates that move a keypoint, a third of all at most, and give their number."""
    count = 0
    for a in range(len(free)):
        for i in range(3):
            if seen.by_coordinate[i, free[a]] != 0.0:
                seen.moving[count] = a
                count += 1
                break
    return count


@njit(cache=True, error_model="numpy")
def _look(sight: Sight, frame: int, marker: int, seen: Keypoint, error_px: Array) -> float:
    """Sum a keypoint's cameras into Λ and γ, fill each camera's residual, derivative and weight, and give the cost."""
    seen.information[:] = 0.0
    seen.pull[:] = 0.0
    x, cost = seen.place, 0.0
    for c in range(len(sight.projections)):
        seen.weight[c] = 0.0
        p, precision = sight.projections[c], sight.precision[c, frame, marker]
        depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
        error = error_px[c, frame, marker]
        if precision <= 0.0 or depth <= 0.05:  # m; a body that close to the lens is not seen either
            error[:] = np.nan
            continue
        squared = 0.0
        for axis in range(2):
            projected = (p[axis, 0] * x[0] + p[axis, 1] * x[1] + p[axis, 2] * x[2] + p[axis, 3]) / depth
            error[axis] = sight.uv_px[c, frame, marker, axis] - sight.bias_px[c, marker, axis] - projected
            squared += (error[axis] * precision) ** 2
            for i in range(3):
                seen.to_pixel[c, axis, i] = (p[axis, i] - projected * p[2, i]) / depth
        cost += 0.5 * sight.loss_scale**2 * np.log1p(squared / sight.loss_scale**2)
        seen.weight[c] = precision**2 / (1.0 + squared / sight.loss_scale**2)
        for axis in range(2):
            row = seen.to_pixel[c, axis]
            for i in range(3):
                seen.pull[i] += seen.weight[c] * row[i] * error[axis]
                for j in range(3):
                    seen.information[i, j] += seen.weight[c] * row[i] * row[j]
    return cost


@njit(cache=True, error_model="numpy")
def _add_frame(seen: Keypoint, layout: Layout, moving: int, sums: Sums, frame: int) -> None:
    """Add Jᵀ γ and Jᵀ Λ J of one keypoint, for the coordinates that move it."""
    carried = np.zeros(3)
    for k in range(moving):
        a = seen.moving[k]
        column = seen.by_coordinate[:, layout.free[a]]
        sums.gradient[frame, a] += _dot(column, seen.pull)
        if layout.order == NORMAL_EQUATIONS:
            _carry(seen.information, column, carried)
            for m in range(k + 1):
                b = seen.moving[m]
                entry = _dot(carried, seen.by_coordinate[:, layout.free[b]])
                sums.hessian[frame, a, b] += entry
                if m < k:
                    sums.hessian[frame, b, a] += entry


@njit(cache=True, error_model="numpy")
def _differentiate_geometry(tree: Tree, nodes: Array, layout: Layout, marker: int, seen: Keypoint) -> int:
    """Fill the derivatives of a keypoint's place by the shared unknowns that move it; give their number.

    By a group's log-scale: what its lengths contribute to the way from the root. By the offset: the axes of its own node.
    """
    by, index = seen.by_geometry, tree.markers[marker].node
    by[:] = 0.0
    for i in range(3):
        seen.columns[layout.scales + i] = layout.scales + 3 * marker + i
        for j in range(3):
            by[i, layout.scales + j] = nodes[index].R_lab_node[i, j] * layout.marker_factor[marker]
        if layout.marker_group[marker] >= 0:
            by[i, layout.marker_group[marker]] += seen.place[i] - nodes[index].p_lab_node[i]
    for s in range(layout.scales):
        seen.columns[s] = s
    while index >= 0:
        given, node, group = tree.nodes[index], nodes[index], layout.node_group[index]
        if group >= 0 and given.parent >= 0:
            parent = nodes[given.parent]
            for i in range(3):
                for j in range(3):
                    by[i, group] += parent.R_lab_node[i, j] * given.p_parent_node[j]
                if given.kind == PRISMATIC:  # a slide that follows an angle: the knee's
                    by[i, group] += node.axis_lab[i] * node.value
        index = given.parent
    return _keep_telling(seen, layout.scales)


@njit(cache=True, error_model="numpy")
def _keep_telling(seen: Keypoint, scales: int) -> int:
    """Move the derivatives that are not zero, and the offset's, to the front; give their number."""
    by, count = seen.by_geometry, 0
    for column in range(scales + 3):
        if column >= scales or by[0, column] != 0.0 or by[1, column] != 0.0 or by[2, column] != 0.0:
            seen.columns[count] = seen.columns[column]
            for i in range(3):
                by[i, count] = by[i, column]
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _add_geometry(seen: Keypoint, layout: Layout, moving: int, geometric: int, sums: Sums, frame: int) -> None:
    """Add what one keypoint says of scales and of its own offset."""
    carried = np.zeros(3)
    for a in range(geometric):
        column, own = seen.by_geometry[:, a], seen.columns[a]
        sums.shared_gradient[own] += _dot(column, seen.pull)
        if layout.order < NORMAL_EQUATIONS:
            continue
        _carry(seen.information, column, carried)
        for b in range(a + 1):
            entry = _dot(carried, seen.by_geometry[:, b])
            sums.corner[own, seen.columns[b]] += entry
            if b < a:
                sums.corner[seen.columns[b], own] += entry
        for k in range(moving):
            moved = seen.by_coordinate[:, layout.free[seen.moving[k]]]
            sums.border[frame, seen.moving[k], own] += _dot(carried, moved)


@njit(cache=True, error_model="numpy")
def _add_biases(
    seen: Keypoint, layout: Layout, markers: int, marker: int, moving: int, geometric: int, sums: Sums, frame: int
) -> None:
    """Add what one keypoint says of each camera's bias for it."""
    row = np.zeros(3)
    for c in range(len(seen.weight)):
        if seen.weight[c] <= 0.0:
            continue
        for axis in range(2):
            column = layout.scales + 3 * markers + 2 * (c * markers + marker) + axis
            sums.shared_gradient[column] += seen.weight[c] * sums.error_px[c, frame, marker, axis]
            if layout.order < NORMAL_EQUATIONS:
                continue
            for i in range(3):
                row[i] = seen.weight[c] * seen.to_pixel[c, axis, i]
            sums.corner[column, column] += seen.weight[c]
            for a in range(geometric):
                entry = _dot(row, seen.by_geometry[:, a])
                sums.corner[column, seen.columns[a]] += entry
                sums.corner[seen.columns[a], column] += entry
            for k in range(moving):
                moved = seen.by_coordinate[:, layout.free[seen.moving[k]]]
                sums.border[frame, seen.moving[k], column] += _dot(row, moved)


@njit(cache=True, error_model="numpy")
def _carry(information: Array, column: Array, carried: Array) -> None:
    """Fill ``carried`` with Λ · column."""
    for i in range(3):
        carried[i] = information[i, 0] * column[0] + information[i, 1] * column[1] + information[i, 2] * column[2]


@njit(cache=True, error_model="numpy")
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
