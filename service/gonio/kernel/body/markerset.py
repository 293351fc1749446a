"""Fix a set of keypoints to a body model, and make the tasks of inverse kinematics from its weights and priors."""

from dataclasses import replace

import numpy as np

from gonio.records import BodyModel, Markers, MarkerSet, Tasks


def attach(model: BodyModel, markerset: MarkerSet) -> BodyModel:
    """Give the model the card's keypoints as its only markers, in the card's order.

    Raises:
        InputError: the card names a marker or body that the model lacks.
    """
    bodies, locations = [], []
    for row, (marker, body) in enumerate(zip(markerset.markers, markerset.bodies, strict=True)):
        if marker:
            index = model.markers.index(marker)
            bodies.append(model.markers.body[index])
            locations.append(model.markers.location_body_m[index])
        else:
            bodies.append(model.bodies.index(body))
            locations.append(markerset.location_body_m[row])
    markers = Markers(
        names=markerset.keypoint_names,
        body=np.array(bodies, dtype=int),
        location_body_m=np.array(locations).reshape(-1, 3),
    )
    return replace(model, markers=markers)


def make_tasks(model: BodyModel, markerset: MarkerSet) -> Tasks:
    """Turn a card's weights and priors into tasks for a model that it is attached to.

    The cost divides the markers' part by the sum of their weights W, so a prior of standard deviation σ weighs as
    much as one keypoint with the deviation ``marker_sd_m`` if its weight is (marker_sd_m / σ)² / W.

    Raises:
        InputError: a prior names a coordinate that the model lacks.
    """
    weights = np.zeros(len(model.coordinates.names))
    targets = model.coordinates.default.copy()
    for prior in markerset.priors:
        index = model.coordinates.index(prior.coordinate)
        weights[index] = (markerset.marker_sd_m / prior.sd) ** 2 / markerset.weights.sum()
        targets[index] = prior.value
    return Tasks(marker_weights=markerset.weights, coordinate_weights=weights, coordinate_targets=targets)
