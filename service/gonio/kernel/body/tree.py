"""A body model as compiled code sees it: arrays of records in one named tuple, and the loops that walk them.

The functions here are compiled by numba and work on one frame. Frames are looped over in
:mod:`gonio.kernel.body.forward` and in the solvers. What stays the same is in the :class:`Tree`, what changes with the
pose in two arrays of records beside it, one record a node and one a coordinate. (Records, because an array for each
quantity took three times as long to compile and twice as long to run.)
"""

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit

from gonio.records import GROUND, REVOLUTE, BodyModel

Array: TypeAlias = Any
"""An array in compiled code, which numba types; shapes stand in comments and docstrings."""

NODE = np.dtype(
    [
        ("parent", "i8"),
        ("kind", "i8"),
        ("function", "i8"),
        ("coordinate", "i8"),
        ("driver", "i8"),  # the independent coordinate behind ``coordinate``, −1 where there is none
        ("straight", "?"),  # the function is offset + slope · coordinate, as nearly all are: no search for a piece
        ("offset", "f8"),
        ("slope", "f8"),
        ("axis", "f8", 3),
        ("R_parent_node", "f8", (3, 3)),
        ("p_parent_node", "f8", 3),  # m
    ],
    align=True,
)
COUPLING = np.dtype([("source", "i8"), ("function", "i8"), ("driver", "i8")], align=True)  # source −1: independent
PIECE = np.dtype([("start", "f8"), ("origin", "f8")], align=True)
MARKER = np.dtype([("node", "i8"), ("location_m", "f8", 3)], align=True)  # in the node's frame; node −1 is the lab

NODE_POSE = np.dtype(
    [
        ("value", "f8"),  # rad or m
        ("first", "f8"),  # derivatives of the value with respect to the driver
        ("second", "f8"),
        ("R_lab_node", "f8", (3, 3)),
        ("p_lab_node", "f8", 3),
        ("axis_lab", "f8", 3),  # about which the node turns or along which it slides
    ],
    align=True,
)
COORDINATE_POSE = np.dtype([("first", "f8"), ("second", "f8")], align=True)  # derivatives with respect to the driver


class Tree(NamedTuple):
    """What kinematics needs of a :class:`gonio.records.BodyModel`."""

    nodes: Array  # (node,) NODE
    couplings: Array  # (coordinate,) COUPLING
    coupling_order: Array  # (coordinate,): sources before what depends on them
    first_piece: Array  # (function + 1,)
    pieces: Array  # (piece,) PIECE
    coefficients: Array  # (piece, power)
    markers: Array  # (marker,) MARKER


@lru_cache(maxsize=16)
def flatten(model: BodyModel) -> Tree:
    """Lay a model out for compiled code, which only reads it: that of the latest models is kept."""
    joints, functions, coordinates, markers = model.joints, model.functions, model.coordinates, model.markers
    couplings = np.empty(len(coordinates.names), dtype=COUPLING)
    order, driver = _coupling_order(coordinates.coupled_to)
    couplings["source"], couplings["function"] = coordinates.coupled_to, coordinates.coupling_function
    couplings["driver"] = driver

    nodes = np.empty(len(joints.names), dtype=NODE)
    nodes["parent"], nodes["kind"], nodes["axis"] = joints.parent, joints.kind, joints.axis
    nodes["function"], nodes["coordinate"], nodes["driver"] = joints.function, joints.coordinate, -1
    driven = joints.coordinate >= 0
    nodes["driver"][driven] = driver[joints.coordinate[driven]]
    nodes["straight"], nodes["offset"], nodes["slope"] = _straight_lines(model)
    nodes["R_parent_node"] = joints.T_parent_node[:, :3, :3]
    nodes["p_parent_node"] = joints.T_parent_node[:, :3, 3]

    pieces = np.empty(len(functions.origin), dtype=PIECE)
    pieces["start"], pieces["origin"] = functions.piece_from, functions.origin

    points = np.empty(len(markers.names), dtype=MARKER)
    points["node"], points["location_m"] = GROUND, markers.location_body_m
    on_body = markers.body != GROUND
    T_node_body = model.bodies.T_node_body[markers.body[on_body]]
    turned = np.einsum("mij,mj->mi", T_node_body[:, :3, :3], markers.location_body_m[on_body])
    points["node"][on_body] = model.bodies.node[markers.body[on_body]]
    points["location_m"][on_body] = turned + T_node_body[:, :3, 3]
    # Copies where the record's arrays would be read-only: numba compiles one signature for every model.
    return Tree(
        nodes=nodes,
        couplings=couplings,
        coupling_order=order,
        first_piece=functions.first_piece.copy(),
        pieces=pieces,
        coefficients=functions.coefficients.copy(),
        markers=points,
    )


def _straight_lines(model: BodyModel) -> tuple[Array, Array, Array]:
    """Find the nodes whose function is one straight line, with its offset and slope."""
    functions, function = model.functions, model.joints.function
    coefficients = np.pad(functions.coefficients, ((0, 1), (0, 2)))  # room for a slope, and a row for "no function"
    piece = np.where(function >= 0, functions.first_piece[function], len(functions.origin))
    pieces = functions.first_piece[function + 1] - functions.first_piece[function]
    straight = (function < 0) | ((pieces == 1) & ~np.any(coefficients[piece, 2:], axis=1))
    origin = np.append(functions.origin, 0.0)[piece]
    return straight, coefficients[piece, 0] - origin * coefficients[piece, 1], coefficients[piece, 1]


def _coupling_order(coupled_to: Array) -> tuple[Array, Array]:
    """Order the coordinates so that sources come first; give each one's independent coordinate too."""
    depth, root = np.zeros(len(coupled_to), dtype=int), np.arange(len(coupled_to))
    for index in range(len(coupled_to)):
        while coupled_to[root[index]] >= 0:
            root[index] = coupled_to[root[index]]
            depth[index] += 1
    return np.argsort(depth, kind="stable"), root


@njit(cache=True, error_model="numpy")
def evaluate(tree: Tree, function: int, x: float) -> tuple[float, float, float]:
    """Evaluate one coupling function at ``x``: its value, first and second derivative. NaN gives NaN."""
    piece = tree.first_piece[function]
    while piece + 1 < tree.first_piece[function + 1] and x >= tree.pieces[piece + 1].start:
        piece += 1
    t = x - tree.pieces[piece].origin
    value = first = second = 0.0
    for power in range(tree.coefficients.shape[1] - 1, -1, -1):  # Horner's rule for a polynomial and its derivatives
        second = second * t + 2.0 * first
        first = first * t + value
        value = value * t + tree.coefficients[piece, power]
    return value, first, second


@njit(cache=True, error_model="numpy")
def couple_coordinates(tree: Tree, q: Array, pose: Array) -> None:
    """Overwrite the dependent coordinates in ``q``, and fill the derivatives in ``pose`` (COORDINATE_POSE)."""
    for index in tree.coupling_order:
        source = tree.couplings[index].source
        if source < 0:
            pose[index].first, pose[index].second = 1.0, 0.0
        else:
            q[index], slope, bend = evaluate(tree, tree.couplings[index].function, q[source])
            pose[index].first = slope * pose[source].first
            pose[index].second = bend * pose[source].first ** 2 + slope * pose[source].second


@njit(cache=True, error_model="numpy")
def pose_nodes(tree: Tree, q: Array, coordinates: Array, nodes: Array) -> None:
    """Fill the values, their derivatives and the poses of all nodes (NODE_POSE).

    ``q`` and ``coordinates`` are as :func:`couple_coordinates` left them.
    """
    placed = np.empty((3, 3))
    for index in range(len(tree.nodes)):
        given, node = tree.nodes[index], nodes[index]
        if given.parent < 0:
            for i in range(3):
                node.p_lab_node[i] = given.p_parent_node[i]
                for j in range(3):
                    placed[i, j] = given.R_parent_node[i, j]
        else:
            parent = nodes[given.parent]
            for i in range(3):
                node.p_lab_node[i] = parent.p_lab_node[i]
                for j in range(3):
                    node.p_lab_node[i] += parent.R_lab_node[i, j] * given.p_parent_node[j]
                    placed[i, j] = 0.0
                    for k in range(3):
                        placed[i, j] += parent.R_lab_node[i, k] * given.R_parent_node[k, j]
        if given.coordinate < 0:  # fixed, or a constant
            node.value, node.first, node.second = given.offset, 0.0, 0.0
        elif given.straight:
            _follow_line(given, q[given.coordinate], coordinates[given.coordinate], node)
        else:
            _follow_curve(tree, given, q[given.coordinate], coordinates[given.coordinate], node)
        _turn_or_slide(given, placed, node)


@njit(cache=True, error_model="numpy")
def _follow_line(given: Array, x: float, source: Array, node: Array) -> None:
    """Fill the value of a node that follows its coordinate along a straight line, and its derivatives."""
    node.value = given.offset + given.slope * x
    node.first = given.slope * source.first
    node.second = given.slope * source.second


@njit(cache=True, error_model="numpy")
def _follow_curve(tree: Tree, given: Array, x: float, source: Array, node: Array) -> None:
    """Fill the value of a node that follows its coordinate along any other function, and its derivatives."""
    node.value, slope, bend = evaluate(tree, given.function, x)
    node.first = slope * source.first
    node.second = bend * source.first**2 + slope * source.second


@njit(cache=True, error_model="numpy")
def _turn_or_slide(given: Array, placed: Array, node: Array) -> None:
    """Apply the node's own motion to its placement, by Rodrigues' formula where it turns."""
    x, y, z = given.axis[0], given.axis[1], given.axis[2]
    for i in range(3):
        node.axis_lab[i] = placed[i, 0] * x + placed[i, 1] * y + placed[i, 2] * z
    if given.kind == REVOLUTE:
        s, c = np.sin(node.value), np.cos(node.value)
        for i in range(3):
            # placed · (c 1 + s [a]× + (1 − c) a aᵀ), one row at a time
            a, b, d = placed[i, 0], placed[i, 1], placed[i, 2]
            along = (1.0 - c) * node.axis_lab[i]
            node.R_lab_node[i, 0] = c * a + s * (b * z - d * y) + along * x
            node.R_lab_node[i, 1] = c * b + s * (d * x - a * z) + along * y
            node.R_lab_node[i, 2] = c * d + s * (a * y - b * x) + along * z
    else:
        for i in range(3):
            node.p_lab_node[i] += node.value * node.axis_lab[i]
            for j in range(3):
                node.R_lab_node[i, j] = placed[i, j]


@njit(cache=True, error_model="numpy")
def place_marker(nodes: Array, marker: Array, point: Array) -> None:
    """Fill ``point`` (3,) with a marker's place in the lab, m."""
    point[0], point[1], point[2] = marker_place(nodes, marker)


@njit(cache=True, error_model="numpy")
def marker_place(nodes: Array, marker: Array) -> tuple[float, float, float]:
    """Give a marker's place in the lab, m."""
    location = marker.location_m
    x, y, z = location[0], location[1], location[2]
    if marker.node < 0:
        return x, y, z
    node = nodes[marker.node]
    R, p = node.R_lab_node, node.p_lab_node
    return (
        p[0] + R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        p[1] + R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        p[2] + R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )
