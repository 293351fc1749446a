"""Fix a set of keypoints to a body model, and make the tasks of inverse kinematics from its weights and priors."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from gonio.errors import InputError
from gonio.kernel.body.forward import body_poses, node_positions
from gonio.records import GROUND, BodyModel, Markers, MarkerSet, Tasks


def attach(model: BodyModel, markerset: MarkerSet) -> BodyModel:
    """Give the model the card's keypoints as its only markers, in the card's order.

    Raises:
        InputError: the card names a marker, joint or body that the model lacks.
    """
    places: list[tuple[int, Float[np.ndarray, 3]]] = []
    for row, (marker, joint) in enumerate(zip(markerset.markers, markerset.joints, strict=True)):
        if marker:
            index = model.markers.index(marker)
            places.append((int(model.markers.body[index]), model.markers.location_body_m[index]))
        elif joint:
            places.append(find_joint_centre(model, joint))
        else:
            places.append((model.bodies.index(markerset.bodies[row]), markerset.location_body_m[row]))
    markers = Markers(
        names=markerset.keypoint_names,
        body=np.array([body for body, _ in places], dtype=int),
        location_body_m=np.array([location for _, location in places]).reshape(-1, 3),
        fixed=np.ones(len(places), dtype=bool),
    )
    return replace(model, markers=markers)


def keep_markers(model: BodyModel, chosen: Int[np.ndarray, " chosen"]) -> BodyModel:
    """Give the model with some of its markers only, by position."""
    markers = Markers(
        names=tuple(model.markers.names[i] for i in chosen),
        body=model.markers.body[chosen],
        location_body_m=model.markers.location_body_m[chosen],
        fixed=model.markers.fixed[chosen],
    )
    return replace(model, markers=markers)


def find_joint_centre(model: BodyModel, joint: str) -> tuple[int, Float[np.ndarray, "3"]]:
    """Give a joint's centre in its parent body: that body's index, and where the moving side lies in the default pose, m.

    Raises:
        InputError: the model has no such joint.
    """
    names = model.joints.names
    nodes = [node for node, name in enumerate(names) if name == joint or name.startswith(f"{joint}/")]
    if not nodes:
        known = dict.fromkeys(name.partition("/")[0] for name in names)
        raise InputError(f"There is no joint named {joint}.", hint=f"The model has: {', '.join(known)}.")
    parent = int(model.joints.parent_body[nodes[0]])
    centre_lab_m = node_positions(model, model.coordinates.default[None])[0, nodes[-1]]
    if parent == GROUND:
        return parent, centre_lab_m
    T_lab_parent = body_poses(model, model.coordinates.default[None])[0, parent]
    return parent, T_lab_parent[:3, :3].T @ (centre_lab_m - T_lab_parent[:3, 3])


def make_tasks(model: BodyModel, markerset: MarkerSet) -> Tasks:
    """Turn a card's weights and priors into tasks for a model that it is attached to.

    The cost divides the markers' part by the sum of their weights W, so a prior of standard deviation σ weighs as
    much as one keypoint with the deviation ``marker_sd_m`` if its weight is (marker_sd_m / σ)² / W.

    Raises:
        InputError: a prior names a coordinate that the model lacks.
    """
    weights = np.zeros(len(model.coordinates.names))
    targets, target_sd = model.coordinates.default.copy(), np.zeros(len(weights))
    for prior in markerset.priors:
        index = model.coordinates.index(prior.coordinate)
        weights[index] = (markerset.marker_sd_m / prior.sd) ** 2 / markerset.weights.sum()
        targets[index], target_sd[index] = prior.value, prior.sd
    return Tasks(
        marker_weights=markerset.weights,
        coordinate_weights=weights,
        coordinate_targets=targets,
        target_sd=target_sd,
    )
