"""Forward kinematics: where bodies and markers are for given coordinates, and how they move with them.

All functions take ``q`` with one column per coordinate of the model (rad, m). The columns of dependent coordinates are
ignored: couplings give them their values. A frame with a NaN that matters gives NaN.
"""

import numpy as np
from jaxtyping import Float
from numba import njit

from gonio.kernel.body.tree import (
    Array,
    Tree,
    couple_coordinates,
    couple_nodes,
    flatten,
    place_point,
    pose_nodes,
)
from gonio.records import PRISMATIC, REVOLUTE, BodyModel


def couple(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame coordinate"]:
    """Give the coordinates with the dependent ones computed from those they are coupled to."""
    return _couple(flatten(model), np.array(q, dtype=float))


def body_poses(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame body 4 4"]:
    """Give T_lab_body of every body, metres, in the order of ``model.bodies``."""
    tree = flatten(model)
    rotation, position = _poses(tree, np.array(q, dtype=float))
    T_lab_node = np.zeros((*position.shape[:2], 4, 4))
    T_lab_node[..., :3, :3], T_lab_node[..., :3, 3], T_lab_node[..., 3, 3] = rotation, position, 1.0
    return T_lab_node[:, tree.body_node] @ model.bodies.T_node_body


def marker_positions(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame marker 3"]:
    """Give the markers' places in the lab, metres, in the order of ``model.markers``."""
    tree = flatten(model)
    rotation, position = _poses(tree, np.array(q, dtype=float))
    place = np.einsum("fmij,mj->fmi", rotation[:, tree.marker_node], tree.marker_location_m)
    place += position[:, tree.marker_node]
    in_lab = tree.marker_node < 0
    place[:, in_lab] = tree.marker_location_m[in_lab]
    return place


def marker_jacobian(
    model: BodyModel, q: Float[np.ndarray, "frame coordinate"]
) -> Float[np.ndarray, "frame marker 3 coordinate"]:
    """Give ∂(marker position)/∂(coordinate), in the lab, m/rad and m/m.

    Dependent coordinates have columns of zeros: their effect is in the column of the coordinate that drives them. A
    node that turns about the axis a through o moves a point p by a × (p − o) per radian, one that slides moves it by
    a.
    """
    return _jacobians(flatten(model), np.array(q, dtype=float))


@njit(cache=True)
def _couple(tree: Tree, q: Array) -> Array:
    first, second = np.empty(q.shape[1]), np.empty(q.shape[1])
    for frame in range(len(q)):
        couple_coordinates(tree, q[frame], first, second)
    return q


@njit(cache=True, nogil=True)
def _poses(tree: Tree, q: Array) -> tuple[Array, Array]:
    count = len(tree.parent)
    rotation, position = np.empty((len(q), count, 3, 3)), np.empty((len(q), count, 3))
    for frame in range(len(q)):
        dq, ddq = np.empty(q.shape[1]), np.empty(q.shape[1])
        value, first, second = np.empty(count), np.empty(count), np.empty(count)
        couple_coordinates(tree, q[frame], dq, ddq)
        couple_nodes(tree, q[frame], dq, ddq, value, first, second)
        pose_nodes(tree, value, rotation[frame], position[frame], np.empty((count, 3)))
    return rotation, position


@njit(cache=True, nogil=True)
def _jacobians(tree: Tree, q: Array) -> Array:
    count, markers = len(tree.parent), len(tree.marker_node)
    jacobian = np.zeros((len(q), markers, 3, q.shape[1]))
    for frame in range(len(q)):
        dq, ddq = np.empty(q.shape[1]), np.empty(q.shape[1])
        value, first, second = np.empty(count), np.empty(count), np.empty(count)
        rotation, position, axis = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
        couple_coordinates(tree, q[frame], dq, ddq)
        couple_nodes(tree, q[frame], dq, ddq, value, first, second)
        pose_nodes(tree, value, rotation, position, axis)
        for marker in range(markers):
            point_jacobian(
                tree,
                tree.marker_node[marker],
                tree.marker_location_m[marker],
                rotation,
                position,
                axis,
                first,
                jacobian[frame, marker],
            )
    return jacobian


@njit(cache=True)
def point_jacobian(
    tree: Tree,
    node: int,
    location: Array,
    rotation: Array,
    position: Array,
    axis: Array,
    first: Array,
    jacobian: Array,
) -> None:
    """Add ∂point/∂q of a point that is fixed in a node's frame to ``jacobian`` (3, coordinate), one frame."""
    point = np.empty(3)
    place_point(rotation, position, node, location, point)
    while node >= 0:
        driver = tree.driver[node]
        if driver >= 0 and tree.kind[node] == REVOLUTE:
            arm = point - position[node]
            jacobian[0, driver] += first[node] * (axis[node, 1] * arm[2] - axis[node, 2] * arm[1])
            jacobian[1, driver] += first[node] * (axis[node, 2] * arm[0] - axis[node, 0] * arm[2])
            jacobian[2, driver] += first[node] * (axis[node, 0] * arm[1] - axis[node, 1] * arm[0])
        elif driver >= 0 and tree.kind[node] == PRISMATIC:
            for i in range(3):
                jacobian[i, driver] += first[node] * axis[node, i]
        node = tree.parent[node]
