"""What a walker should do to look like people: published angles and ground forces, laid along its own steps.

The curves are means of many people and of no one: followed to the letter they would let the feet slide and the body fall.
:mod:`gonio.kernel.virtual_lab.fit` finds the motion near them that obeys mechanics.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from gonio.kernel.body.soles import Sole
from gonio.kernel.virtual_lab.feet import directions, heels_on_floor, load_shares
from gonio.kernel.virtual_lab.harmonics import ORDERS
from gonio.kernel.virtual_lab.normal_gait import NormalGait
from gonio.kernel.virtual_lab.steps import Limp, leg_length_m
from gonio.records import FEET, BodyModel, Steps

_LEG_CURVES = {
    "hip_flexion": "hip_flexion",
    "hip_adduction": "hip_adduction",
    "hip_rotation": "hip_rotation",
    "knee_angle": "knee_flexion",
    "ankle_angle": "ankle_dorsiflexion",
}

SD_DEG = {
    # How far the walker may leave the curves; about half of what people differ by, so that it stays an ordinary person.
    "pelvis_tilt": 2.0,
    "pelvis_list": 2.0,
    "pelvis_rotation": 3.0,
    "lumbar_extension": 4.0,
    "lumbar_bending": 4.0,
    "lumbar_rotation": 4.0,
    "hip_flexion": 3.0,
    "hip_adduction": 3.0,
    "hip_rotation": 6.0,
    "knee_angle": 3.0,
    "ankle_angle": 3.0,
    "subtalar_angle": 4.0,
    "mtp_angle": 8.0,
    "arm_flex": 8.0,
}
SD_M = {"pelvis_tx": 0.1, "pelvis_ty": 0.1, "pelvis_tz": 0.1}
"""Hardly held: where the pelvis is follows from feet and forces. Coordinates that are not named here keep to the plan."""

# The centre of pressure runs from the heel to the toes, monotonically. Shares of stance, and of the distance from the heel
# to the toe joint. Our own curve: it turns the published ground forces into the published moments about the ankle.
_PROGRESS = PchipInterpolator(
    [0.0, 0.05, 0.15, 0.33, 0.5, 0.66, 0.82, 0.93, 1.0], [0.05, 0.14, 0.30, 0.50, 0.73, 0.93, 1.07, 1.14, 1.18]
)

TOWARDS_BODY = 0.7
"""The share of the sideways tilt from the foot to the centre of mass that the ground force follows: 0.6 to 0.8 against force
plates, in 13 of 14 walkers."""


class Wanted(NamedTuple):
    """The lead at moments of the stride: coordinates, and for each foot force and centre of pressure.

    Places are in the frame that walks along at the mean speed.
    """

    q: Float[np.ndarray, "node coordinate"]
    force_n: Float[np.ndarray, "node foot 3"]
    cop_m: Float[np.ndarray, "node foot 3"]


def spread(body: BodyModel) -> Float[np.ndarray, " coordinate"]:
    """Give how far each coordinate may leave its lead, rad or m; 0 for those that keep to it."""
    sd = np.zeros(len(body.coordinates.names))
    for index, name in enumerate(body.coordinates.names):
        stem = name.removesuffix("_r").removesuffix("_l")
        sd[index] = SD_M.get(name, np.deg2rad(SD_DEG.get(stem, 0.0)))
    return sd


def lead(
    body: BodyModel,
    steps: Steps,
    gait: NormalGait,
    sole: Sole,
    limp: Limp | None,
    stride_phase: Float[np.ndarray, " node"],
) -> Wanted:
    """Lay the published curves along the steps."""
    normal = [normal_phase(steps, gait, foot, stride_phase) for foot in range(len(FEET))]
    q = _lead_legs(body, gait, limp, normal)
    _lead_trunk(body, gait, normal, q)
    _lead_arms(body, steps, stride_phase, q)
    shares = load_shares(steps, stride_phase)
    cop_m = cop_lead(steps, sole, stride_phase)
    return Wanted(q, _lead_forces(body, gait, normal, shares, cop_m), cop_m)


def cop_lead(steps: Steps, sole: Sole, stride_phase: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node foot 3"]:
    """Give where each foot's centre of pressure should be, on the floor, in the frame that walks along."""
    cop_m = heels_on_floor(steps, stride_phase)
    for foot, turn in enumerate(directions(steps)):
        progress = _PROGRESS(np.minimum(steps.phase(foot, stride_phase) / steps.stance[foot], 1.0))
        cop_m[:, foot] += np.outer(progress * sole.length_m, turn[:, 0])
    return cop_m


def normal_phase(
    steps: Steps, gait: NormalGait, foot: int, stride_phase: Float[np.ndarray, " node"]
) -> Float[np.ndarray, " node"]:
    """Give the phase of normal walking that a foot's phase stands for: strikes and lift-offs of both feet fall together."""
    other = 1 - foot
    other_lifts = np.mod(steps.strike[other] + steps.stance[other] - steps.strike[foot], 1.0)
    other_strikes = np.mod(steps.strike[other] - steps.strike[foot], 1.0)
    own = np.array([0.0, other_lifts, other_strikes, steps.stance[foot]])
    normal = np.array([0.0, gait.stance - 0.5, 0.5, gait.stance])
    warp = PchipInterpolator(np.concatenate([own - 1, own, own + 1]), np.concatenate([normal - 1, normal, normal + 1]))
    return warp(steps.phase(foot, stride_phase))


def _lead_legs(
    body: BodyModel, gait: NormalGait, limp: Limp | None, normal: list[Float[np.ndarray, " node"]]
) -> Float[np.ndarray, "node coordinate"]:
    q = np.tile(body.coordinates.default, (len(normal[0]), 1))
    # The source's pelvis and hip angles count from a pelvis whose iliac spines are level; the body's from upright standing.
    upright_deg = float(np.mean(gait.at("anterior_pelvic_tilt", np.arange(50) / 50)))
    for side, phase in zip(FEET, normal, strict=True):
        for coordinate, curve in _LEG_CURVES.items():
            angle_deg = gait.at(curve, phase)
            if coordinate == "hip_flexion":
                angle_deg = angle_deg - upright_deg
            if coordinate == "knee_angle" and limp is not None and limp.side == side:
                angle_deg = angle_deg * limp.knee_flexion
            q[:, body.coordinates.index(f"{coordinate}_{side[0]}")] = np.deg2rad(angle_deg)
    return q


def _lead_trunk(
    body: BodyModel,
    gait: NormalGait,
    normal: list[Float[np.ndarray, " node"]],
    q: Float[np.ndarray, "node coordinate"],
) -> None:
    """Fill the pelvis' turns, seen alike from both sides, and a trunk that stays upright and turns against the pelvis."""
    right, left = normal
    tilt = gait.at("anterior_pelvic_tilt", right) + gait.at("anterior_pelvic_tilt", left)
    raised = gait.at("pelvic_obliquity", right) - gait.at("pelvic_obliquity", left)
    advanced = gait.at("pelvic_rotation", right) - gait.at("pelvic_rotation", left)
    turns_deg = {
        "pelvis_tilt": -(tilt - tilt.mean()) / 2,
        "pelvis_list": -raised / 2,
        "pelvis_rotation": advanced / 2,
        "lumbar_bending": raised / 2,
        "lumbar_rotation": -1.8
        * advanced
        / 2,  # shoulders and hips turn against each other, the shoulders a little less
    }
    for name, values in turns_deg.items():
        q[:, body.coordinates.index(name)] = np.deg2rad(values)


def _lead_arms(
    body: BodyModel, steps: Steps, stride_phase: Float[np.ndarray, " node"], q: Float[np.ndarray, "node coordinate"]
) -> None:
    """Fill arms that swing once a stride, forwards with the other leg, elbows bending as they do: ours, no published curve."""
    for foot, side in enumerate(FEET):
        swing = np.cos(2 * np.pi * steps.phase(1 - foot, stride_phase))
        pose_deg = {
            "arm_flex": -5 + 14 * swing,
            "arm_add": -8 + 0 * swing,
            "elbow_flex": 25 + 10 * swing,
            "pro_sup": 60,
        }
        for name, values in pose_deg.items():
            q[:, body.coordinates.index(f"{name}_{side[0]}")] = np.deg2rad(values)


def _lead_forces(
    body: BodyModel,
    gait: NormalGait,
    normal: list[Float[np.ndarray, " node"]],
    shares: Float[np.ndarray, "node foot"],
    cop_m: Float[np.ndarray, "node foot 3"],
) -> Float[np.ndarray, "node foot 3"]:
    """Give the published ground forces, made to carry the body: over a stride as much as its weight, and no push onwards."""
    weight_n = -body.mass_kg * body.gravity_m_s2[1]
    force = np.zeros((*shares.shape, 3))
    for foot, phase in enumerate(normal):
        force[:, foot, 0] = gait.at("forward_force", phase) * (shares[:, foot] > 0)
        force[:, foot, 1] = np.maximum(gait.at("vertical_force", phase), 0.0)
    vertical = _smooth(force[..., 1].sum(axis=1, keepdims=True))
    force[..., 1] = shares * vertical / vertical.mean()
    force[..., 0] -= force[..., 0].sum(axis=1).mean() * shares
    # Towards the middle of the body, at the height of its centre of mass to a few centimetres.
    force[..., 2] = -TOWARDS_BODY * force[..., 1] * cop_m[..., 2] / (1.1 * leg_length_m(body))
    return weight_n * force


def _smooth(total: Float[np.ndarray, "node 1"]) -> Float[np.ndarray, "node 1"]:
    """Leave what a walk of so few harmonics can follow of the sum of both feet's curves, which has corners at the strikes."""
    spectrum = np.fft.rfft(total, axis=0)
    spectrum[ORDERS + 1 :] = 0.0
    return np.fft.irfft(spectrum, n=len(total), axis=0)
