"""The angles of a gait report: which coordinate is which, and which way it counts.

Models differ in their signs (OpenSim's Gait2354 counts flexion of the knee as negative, Rajagopal's model as
positive). The sign is therefore read off the model's geometry: flexion of the hip and dorsiflexion of the ankle turn
the distal body forwards and up (about +Z), flexion of the knee turns it back (about −Z), seen in the upright default
pose.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gonio.kernel.body.forward import body_poses
from gonio.records import BodyModel, Motion

_FLEXIONS = (
    # what the report calls it, the coordinate's name in OpenSim's gait models, direction about Z
    ("hip_flexion", "hip_flexion", 1.0),
    ("knee_flexion", "knee_angle", -1.0),
    ("ankle_dorsiflexion", "ankle_angle", 1.0),
)
_SIDES = (("right", "_r"), ("left", "_l"))


@dataclass(frozen=True)
class ClinicalAngle:
    """One angle of the report: ``sign`` · coordinate is positive in the clinical sense."""

    name: str
    side: str
    coordinate: str
    sign: float


def find_clinical_angles(model: BodyModel) -> tuple[ClinicalAngle, ...]:
    """Find hip flexion, knee flexion and ankle dorsiflexion of both legs; what a model lacks is left out."""
    found: list[ClinicalAngle] = []
    for name, stem, direction in _FLEXIONS:
        for side, letter in _SIDES:
            coordinate = stem + letter
            if coordinate in model.coordinates.names:
                sign = direction * np.sign(_turn_about_z(model, model.coordinates.index(coordinate)))
                found.append(ClinicalAngle(name, side, coordinate, float(sign)))
    return tuple(found)


def _turn_about_z(model: BodyModel, coordinate: int) -> float:
    """Give the Z component of the turn, per radian, of the bodies that move most with a coordinate."""
    small = 1e-4
    q = np.tile(model.coordinates.default, (2, 1))
    q[1, coordinate] += small
    before, after = body_poses(model, q)[:, :, :3, :3]
    turned = after @ before.transpose(0, 2, 1)
    about_z = (turned[:, 1, 0] - turned[:, 0, 1]) / (2 * small)
    return float(about_z[np.argmax(np.abs(about_z))])


def clinical_deg(motion: Motion, angle: ClinicalAngle) -> Float[np.ndarray, " frame"]:
    """Give one angle over time, degrees, positive in the clinical sense; NaN where it is not known."""
    return angle.sign * np.degrees(motion.of(angle.coordinate))


def clinical_sd_deg(motion: Motion, angle: ClinicalAngle) -> Float[np.ndarray, " frame"]:
    """Give the standard deviation of one angle over time, degrees; NaN where the angle or its covariance is not known."""
    index = motion.coordinate_names.index(angle.coordinate)
    if motion.covariance is None:
        return np.full(len(motion.times_s), np.nan) if motion.sd is None else np.degrees(motion.sd[:, index])
    return np.degrees(np.sqrt(np.maximum(motion.covariance[:, index, index], 0.0)))
