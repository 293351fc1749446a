"""Marker placement: the model's markers moved to where a static trial saw them on the person."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.errors import CaptureError
from gonio.kernel.body.forward import body_poses
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import GROUND, TOO_FEW_MARKERS, BodyModel, Motion, Tasks


def place_markers(
    model: BodyModel, tasks: Tasks, xyz_lab_m: Float[np.ndarray, "frame marker 3"]
) -> tuple[BodyModel, Motion]:
    """Fit the static pose, then move each marker that is not fixed to where it was seen, in its own body.

    That is how OpenSim's MarkerPlacer works. The markers' places are averaged over the frames first.

    Args:
        model: The scaled model.
        tasks: The weights of the static pose: markers over bones should count most, since they define it.
        xyz_lab_m: The static trial, in the order of ``model.markers``; NaN where not seen.

    Returns:
        The model with its markers moved (a marker that was never seen stays), and the static pose, one frame.

    Raises:
        CaptureError: fewer than three markers with a weight were seen.
    """
    total, count = np.nansum(xyz_lab_m, axis=0), np.isfinite(xyz_lab_m).sum(axis=0)
    mean = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    pose = solve_motion(model, tasks, mean[None], np.zeros(1))
    if pose.status[0] == TOO_FEW_MARKERS:
        raise CaptureError(
            "The static trial shows fewer than three of the markers that its pose is found by.",
            hint="Choose other frames, or give more markers a weight.",
            code="static-pose-missing",
        )
    q = np.where(np.isnan(pose.values), model.coordinates.default, pose.values)
    T_lab_body = body_poses(model, q)[0]
    location = model.markers.location_body_m.copy()
    for marker, body in enumerate(model.markers.body):
        if not model.markers.fixed[marker] and np.isfinite(mean[marker]).all():
            place = mean[marker]
            if body != GROUND:
                place = T_lab_body[body, :3, :3].T @ (place - T_lab_body[body, :3, 3])
            location[marker] = place
    return replace(model, markers=replace(model.markers, location_body_m=location)), pose
