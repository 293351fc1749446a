"""Where keypoints sit on a person, who is not quite the model."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.virtual_lab.effects import Mismatch
from gonio.records import REVOLUTE, BodyModel

_HIP_RANGE_RAD, _KNEE_RANGE_RAD, _ANKLE_RANGE_RAD = np.deg2rad([40.0, 60.0, 30.0])
"""The flexion at which a keypoint has slid all its way: about the range of walking."""


def keypoints_on_person(
    body: BodyModel, q: Float[np.ndarray, "frame coordinate"], mismatch: Mismatch | None
) -> Float[np.ndarray, "frame keypoint 3"]:
    """Give the markers' places on a person who moves as the model does but is built a little differently, m.

    ``body`` has the keypoints as its markers, named by what they mark (``knee_r`` …) in its source's marker set.
    """
    if mismatch is None:
        return marker_positions(body, q)
    place = marker_positions(_tilt_knees(body, mismatch.knee_axis_rad), q)
    T_lab_body = body_poses(body, q)
    names, bodies, index = body.markers.names, body.bodies.names, body.coordinates.index
    for letter in "rl":
        flexion = {joint: q[:, index(f"{joint}_{letter}")] for joint in ("hip_flexion", "knee_angle", "ankle_angle")}
        slides = {
            # Which keypoint, along which axis of which body: skin goes where the flexing segment drags it.
            f"hip_{letter}": ("pelvis", 0, mismatch.hip_slide_m * flexion["hip_flexion"] / _HIP_RANGE_RAD),
            f"knee_{letter}": (f"femur_{letter}", 1, mismatch.knee_slide_m * flexion["knee_angle"] / _KNEE_RANGE_RAD),
            f"ankle_{letter}": (
                f"tibia_{letter}",
                0,
                mismatch.ankle_slide_m * flexion["ankle_angle"] / _ANKLE_RANGE_RAD,
            ),
        }
        for marker, (owner, axis, slide_m) in slides.items():
            if marker in names:
                along = T_lab_body[:, bodies.index(owner), :3, axis]
                place[:, names.index(marker)] += slide_m[:, None] * along
    return place + mismatch.trunk_m * _bend_trunk(body, q, T_lab_body)


def _tilt_knees(body: BodyModel, angle_rad: float) -> BodyModel:
    """Turn the knees' axes in the frontal plane, mirrored: the outer ends go up."""
    axis = body.joints.axis.copy()
    for letter, side in (("r", 1.0), ("l", -1.0)):
        knee = body.coordinates.index(f"knee_angle_{letter}")
        turns = (body.joints.coordinate == knee) & (body.joints.kind == REVOLUTE)
        axis[turns] = Rotation.from_rotvec([-side * angle_rad, 0.0, 0.0]).apply(axis[turns])
    return replace(body, joints=replace(body.joints, axis=axis))


def _bend_trunk(
    body: BodyModel, q: Float[np.ndarray, "frame coordinate"], T_lab_body: Float[np.ndarray, "frame body 4 4"]
) -> Float[np.ndarray, "frame keypoint 3"]:
    """Give how a trunk that bends moves what hangs on it: forwards as the hips extend, by up to 1 (unit: its amplitude)."""
    index, torso = body.coordinates.index, body.bodies.index("torso")
    spread = (q[:, index("hip_flexion_r")] - q[:, index("hip_flexion_l")]) / _HIP_RANGE_RAD
    trunk = [body.bodies.index(name) for name in body.bodies.names if name in ("torso", "head") or name[:-2] in _ARM]
    moved = np.isin(body.markers.body, trunk)
    return np.einsum("f,fi,k->fki", np.abs(spread), T_lab_body[:, torso, :3, 0], moved)


_ARM = ("humerus", "radius", "hand")
