"""A body model as compiled code sees it: plain arrays in one named tuple, and the loops that walk them.

The functions here are compiled by numba and work on one frame. Frames are looped over in
:mod:`gonio.kernel.body.forward` and in the solvers. Arrays that they fill come last among the arguments.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit

from gonio.records import GROUND, REVOLUTE, BodyModel

Array: TypeAlias = Any
"""An array in compiled code, which numba types; shapes stand in comments and docstrings."""


class Tree(NamedTuple):
    """The arrays of a :class:`gonio.records.BodyModel` that kinematics needs; markers are placed in node frames."""

    parent: Array  # (node,)
    kind: Array  # (node,)
    axis: Array  # (node, 3)
    R_parent_node: Array  # (node, 3, 3)
    p_parent_node: Array  # (node, 3), m
    function: Array  # (node,)
    coordinate: Array  # (node,)
    driver: Array  # (node,): the independent coordinate behind ``coordinate``, −1 where there is none
    coupled_to: Array  # (coordinate,)
    coupling_function: Array  # (coordinate,)
    coupling_order: Array  # (coordinate,): sources before what depends on them
    first_piece: Array
    piece_from: Array
    origin: Array
    coefficients: Array
    marker_node: Array  # (marker,): −1 is the lab
    marker_location_m: Array  # (marker, 3), in the node's frame
    body_node: Array  # (body,)
    R_node_body: Array  # (body, 3, 3)
    p_node_body: Array  # (body, 3), m


def flatten(model: BodyModel) -> Tree:
    """Lay a model out for compiled code."""
    joints, functions, coordinates, bodies, markers = (
        model.joints,
        model.functions,
        model.coordinates,
        model.bodies,
        model.markers,
    )
    order, root = _coupling_order(coordinates.coupled_to)
    driver = np.where(joints.coordinate >= 0, root[joints.coordinate], -1) if len(root) else joints.coordinate
    in_body = markers.body != GROUND
    location = markers.location_body_m.copy()
    T_node_body = bodies.T_node_body[markers.body[in_body]]
    location[in_body] = np.einsum("mij,mj->mi", T_node_body[:, :3, :3], location[in_body]) + T_node_body[:, :3, 3]
    marker_node = np.full(len(markers.names), GROUND)
    marker_node[in_body] = bodies.node[markers.body[in_body]]
    tree = Tree(
        parent=joints.parent,
        kind=joints.kind,
        axis=joints.axis,
        R_parent_node=joints.T_parent_node[:, :3, :3],
        p_parent_node=joints.T_parent_node[:, :3, 3],
        function=joints.function,
        coordinate=joints.coordinate,
        driver=driver,
        coupled_to=coordinates.coupled_to,
        coupling_function=coordinates.coupling_function,
        coupling_order=order,
        first_piece=functions.first_piece,
        piece_from=functions.piece_from,
        origin=functions.origin,
        coefficients=functions.coefficients,
        marker_node=marker_node,
        marker_location_m=location,
        body_node=bodies.node,
        R_node_body=bodies.T_node_body[:, :3, :3],
        p_node_body=bodies.T_node_body[:, :3, 3],
    )
    # Copies: writable and contiguous, so that numba compiles one signature for every model.
    return Tree(*(np.array(array, order="C") for array in tree))


def _coupling_order(coupled_to: Array) -> tuple[Array, Array]:
    """Order the coordinates so that sources come first; give each one's independent coordinate too."""
    depth, root = np.zeros(len(coupled_to), dtype=int), np.arange(len(coupled_to))
    for index in range(len(coupled_to)):
        while coupled_to[root[index]] >= 0:
            root[index] = coupled_to[root[index]]
            depth[index] += 1
    return np.argsort(depth, kind="stable"), root


@njit(cache=True)
def evaluate(tree: Tree, function: int, x: float) -> tuple[float, float, float]:
    """Evaluate one coupling function at ``x``: its value, first and second derivative. NaN gives NaN."""
    piece = tree.first_piece[function]
    while piece + 1 < tree.first_piece[function + 1] and x >= tree.piece_from[piece + 1]:
        piece += 1
    t = x - tree.origin[piece]
    value = first = second = 0.0
    for power in range(tree.coefficients.shape[1] - 1, -1, -1):  # Horner's rule for a polynomial and its derivatives
        second = second * t + 2.0 * first
        first = first * t + value
        value = value * t + tree.coefficients[piece, power]
    return value, first, second


@njit(cache=True)
def couple_coordinates(tree: Tree, q: Array, first: Array, second: Array) -> None:
    """Overwrite the dependent coordinates in ``q``.

    Also fill each coordinate's ``first`` and ``second`` derivative with respect to its independent coordinate (1 and 0
    where it is that itself). All (coordinate,).
    """
    for index in tree.coupling_order:
        source = tree.coupled_to[index]
        if source < 0:
            first[index], second[index] = 1.0, 0.0
        else:
            q[index], slope, bend = evaluate(tree, tree.coupling_function[index], q[source])
            first[index] = slope * first[source]
            second[index] = bend * first[source] ** 2 + slope * second[source]


@njit(cache=True)
def couple_nodes(tree: Tree, q: Array, dq: Array, ddq: Array, value: Array, first: Array, second: Array) -> None:
    """Fill each node's value, and its derivatives with respect to its driver: q_full = f(q).

    ``dq`` and ``ddq`` are what :func:`couple_coordinates` filled; ``value``, ``first`` and ``second`` are (node,).
    """
    for node in range(len(tree.parent)):
        coordinate = tree.coordinate[node]
        value[node] = first[node] = second[node] = 0.0
        if tree.function[node] < 0:
            continue
        if coordinate < 0:
            value[node] = evaluate(tree, tree.function[node], 0.0)[0]
            continue
        value[node], slope, bend = evaluate(tree, tree.function[node], q[coordinate])
        first[node] = slope * dq[coordinate]
        second[node] = bend * dq[coordinate] ** 2 + slope * ddq[coordinate]


@njit(cache=True)
def pose_nodes(tree: Tree, value: Array, rotation: Array, position: Array, axis_lab: Array) -> None:
    """Fill each node's pose in the lab from its value.

    ``rotation`` (node, 3, 3) and ``position`` (node, 3) are T_lab_node; ``axis_lab`` (node, 3) is the node's axis in
    the lab, about which it turns or along which it slides.
    """
    placed = np.empty((3, 3))
    for node in range(len(tree.parent)):
        parent = tree.parent[node]
        for i in range(3):
            if parent < 0:
                position[node, i] = tree.p_parent_node[node, i]
                for j in range(3):
                    placed[i, j] = tree.R_parent_node[node, i, j]
            else:
                position[node, i] = position[parent, i]
                for j in range(3):
                    position[node, i] += rotation[parent, i, j] * tree.p_parent_node[node, j]
                    placed[i, j] = 0.0
                    for k in range(3):
                        placed[i, j] += rotation[parent, i, k] * tree.R_parent_node[node, k, j]
        _turn_or_slide(tree, node, value[node], placed, rotation, position, axis_lab)


@njit(cache=True)
def _turn_or_slide(
    tree: Tree, node: int, value: float, placed: Array, rotation: Array, position: Array, axis_lab: Array
) -> None:
    """Apply the node's own motion to its placement, by Rodrigues' formula where it turns."""
    x, y, z = tree.axis[node, 0], tree.axis[node, 1], tree.axis[node, 2]
    for i in range(3):
        axis_lab[node, i] = placed[i, 0] * x + placed[i, 1] * y + placed[i, 2] * z
    if tree.kind[node] == REVOLUTE:
        s, c = np.sin(value), np.cos(value)
        for i in range(3):
            # placed · (c 1 + s [a]× + (1 − c) a aᵀ), one row at a time
            a, b, d = placed[i, 0], placed[i, 1], placed[i, 2]
            along = (1.0 - c) * axis_lab[node, i]
            rotation[node, i, 0] = c * a + s * (b * z - d * y) + along * x
            rotation[node, i, 1] = c * b + s * (d * x - a * z) + along * y
            rotation[node, i, 2] = c * d + s * (a * y - b * x) + along * z
    else:
        for i in range(3):
            position[node, i] += value * axis_lab[node, i]
            for j in range(3):
                rotation[node, i, j] = placed[i, j]


@njit(cache=True)
def place_point(rotation: Array, position: Array, node: int, location: Array, point: Array) -> None:
    """Fill ``point`` (3,) with a location that is fixed in a node's frame (node −1: in the lab), in the lab."""
    for i in range(3):
        if node < 0:
            point[i] = location[i]
        else:
            point[i] = position[node, i]
            for j in range(3):
                point[i] += rotation[node, i, j] * location[j]
