"""Forward kinematics: where bodies and markers are for given coordinates, and how they move with them.

All functions take ``q`` with one column per coordinate of the model (rad, m). The columns of dependent coordinates are
ignored: couplings give them their values. A frame with a NaN that matters gives NaN.
"""

import numpy as np
from jaxtyping import Float
from numba import njit

from gonio.kernel.body.tree import (
    COORDINATE_POSE,
    NODE_POSE,
    Array,
    Tree,
    couple_coordinates,
    flatten,
    marker_place,
    pose_nodes,
)
from gonio.records import PRISMATIC, REVOLUTE, BodyModel


def couple(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame coordinate"]:
    """Give the coordinates with the dependent ones computed from those they are coupled to."""
    coupled = np.array(q, dtype=float, order="C")
    _pose_frames(flatten(model), coupled)
    return coupled


def body_poses(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame body 4 4"]:
    """Give T_lab_body of every body, metres, in the order of ``model.bodies``."""
    nodes = _pose_frames(flatten(model), np.array(q, dtype=float, order="C"))[:, model.bodies.node]
    T_lab_node = np.zeros((*nodes.shape, 4, 4))
    T_lab_node[..., :3, :3], T_lab_node[..., :3, 3] = nodes["R_lab_node"], nodes["p_lab_node"]
    T_lab_node[..., 3, 3] = 1.0
    return T_lab_node @ model.bodies.T_node_body


def node_positions(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame node 3"]:
    """Give where the nodes are in the lab, metres: the centres of the joints, each after its own motion."""
    return _pose_frames(flatten(model), np.array(q, dtype=float, order="C"))["p_lab_node"].copy()


def marker_positions(model: BodyModel, q: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame marker 3"]:
    """Give the markers' places in the lab, metres, in the order of ``model.markers``."""
    tree = flatten(model)
    nodes = _pose_frames(tree, np.array(q, dtype=float, order="C"))[:, tree.markers["node"]]
    place = np.einsum("fmij,mj->fmi", nodes["R_lab_node"], tree.markers["location_m"]) + nodes["p_lab_node"]
    in_lab = tree.markers["node"] < 0
    place[:, in_lab] = tree.markers["location_m"][in_lab]
    return place


def marker_jacobian(
    model: BodyModel, q: Float[np.ndarray, "frame coordinate"]
) -> Float[np.ndarray, "frame marker 3 coordinate"]:
    """Give ∂(marker position)/∂(coordinate), in the lab, m/rad and m/m.

    Dependent coordinates have columns of zeros: their effect is in the column of the coordinate that drives them. A
    node that turns about the axis a through o moves a point p by a × (p − o) per radian, one that slides moves it by a.
    """
    tree, coupled = flatten(model), np.array(q, dtype=float, order="C")
    nodes = _pose_frames(tree, coupled)
    jacobian = np.zeros((len(coupled), len(tree.markers), 3, coupled.shape[1]))
    _differentiate_frames(tree, nodes, jacobian)
    return jacobian


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_poses(tree: Tree, q: Array, coordinates: Array, nodes: Array) -> None:
    for frame in range(len(q)):
        couple_coordinates(tree, q[frame], coordinates)
        pose_nodes(tree, q[frame], coordinates, nodes[frame])


def _pose_frames(tree: Tree, q: Array) -> Array:
    """Pose all nodes in all frames, (frame, node) NODE_POSE; the dependent coordinates in ``q`` are overwritten."""
    nodes = np.empty((len(q), len(tree.nodes)), dtype=NODE_POSE)
    _fill_poses(tree, q, np.empty(q.shape[1], dtype=COORDINATE_POSE), nodes)
    return nodes


@njit(cache=True, nogil=True, error_model="numpy")
def _differentiate_frames(tree: Tree, nodes: Array, jacobian: Array) -> None:
    for frame in range(len(nodes)):
        for marker in range(len(tree.markers)):
            differentiate_marker(tree, nodes[frame], tree.markers[marker], jacobian[frame, marker])


@njit(cache=True, error_model="numpy")
def differentiate_marker(tree: Tree, nodes: Array, marker: Array, jacobian: Array) -> None:
    """Add ∂(marker position)/∂q to ``jacobian`` (3, coordinate), in one frame whose nodes are posed."""
    x, y, z = marker_place(nodes, marker)
    index = marker.node
    while index >= 0:
        given, node = tree.nodes[index], nodes[index]
        driver, first, axis = given.driver, node.first, node.axis_lab
        if driver >= 0 and given.kind == REVOLUTE:
            arm_x, arm_y, arm_z = x - node.p_lab_node[0], y - node.p_lab_node[1], z - node.p_lab_node[2]
            jacobian[0, driver] += first * (axis[1] * arm_z - axis[2] * arm_y)
            jacobian[1, driver] += first * (axis[2] * arm_x - axis[0] * arm_z)
            jacobian[2, driver] += first * (axis[0] * arm_y - axis[1] * arm_x)
        elif driver >= 0 and given.kind == PRISMATIC:
            for i in range(3):
                jacobian[i, driver] += first * axis[i]
        index = given.parent
