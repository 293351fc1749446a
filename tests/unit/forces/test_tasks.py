"""Squats, rising from a chair, landings and standing on one leg, on bodies whose forces follow from their own movement.

There is no recording of these tasks at hand. A body is led along its centre of mass with the feet flat on the floor; what the
ground must do then follows from Newton and Euler, shared equally between the feet, without a force that pulls them apart.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq

from gonio.formats.force_coefficients import builtin_force_coefficients
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, couple
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.dynamics.zero_lag import differentiate
from gonio.kernel.forces.estimate import ForceChoice, estimate_forces
from gonio.kernel.forces.torque import find_torques, foot_wrenches
from gonio.kernel.forces.whole_body import observe
from gonio.kernel.virtual_lab import grow
from gonio.kernel.virtual_lab.soles import cop_on_soles
from gonio.records import BodyModel, FootPressure
from gonio.resources import models_dir

RATE_HZ, MASS_KG, G = 100.0, 70.0, 9.80665
WEIGHT_N = MASS_KG * G
COEFFICIENTS = builtin_force_coefficients()
COP_X_M = 0.08
"""Where the centre of mass stands over the feet, before the heels."""


class Recording(NamedTuple):
    """A movement, what soles show of it, and the true torques of the knees."""

    model: BodyModel
    motion: object
    pressure: FootPressure
    knees_nm: np.ndarray
    need_n: np.ndarray


@pytest.fixture(scope="module")
def model():
    return grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, MASS_KG)


def crouch(model, knee):
    """The body with its feet flat on the floor, the knees bent, and the centre of mass over the feet's middle."""
    index = model.coordinates.names.index
    sign = -1.0 if model.coordinates.range[index("knee_angle_r"), 0] < -1.0 else 1.0

    def pose(lean):
        q = model.coordinates.default.copy()
        ankle = 0.45 * knee
        for side in "rl":
            q[index(f"knee_angle_{side}")] = sign * knee
            q[index(f"ankle_angle_{side}")] = ankle
            q[index(f"hip_flexion_{side}")] = knee - ankle + lean
        q[index("pelvis_tilt")] = -lean
        return q

    def places(q):
        q = couple(model, q[None])
        heels = body_poses(model, q)[0][[model.bodies.index(f"calcn_{side}") for side in "rl"], :3, 3].mean(axis=0)
        still = np.zeros_like(q)
        return heels, solve_dynamics(model, q, still, still).com_lab_m[0]

    def ahead(lean):
        heel, com = places(pose(lean))
        return com[0] - heel[0] - COP_X_M

    q = pose(brentq(ahead, -0.4, 1.4))
    heel, com = places(q)
    q[index("pelvis_tx")] -= heel[0]
    q[index("pelvis_ty")] -= heel[1]
    return q, com[1] - heel[1]


@pytest.fixture(scope="module")
def crouches(model):
    """Poses by the height of the centre of mass, ascending."""
    found = [crouch(model, knee) for knee in np.linspace(1.7, 0.05, 12)]
    return np.array([height for _, height in found]), np.array([q for q, _ in found])


def record(model, crouches, com_m, carried=None):
    """Lead the body along heights of its centre of mass; above its stretched height it flies as it is."""
    heights, poses = crouches
    times_s = np.arange(len(com_m)) / RATE_HZ
    q = np.stack([np.interp(com_m, heights, column) for column in poses.T], axis=1)
    q[:, model.coordinates.names.index("pelvis_ty")] += np.maximum(com_m - heights[-1], 0.0)
    motion = differentiate(times_s, couple(model, q), 12.0)
    body = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration)
    force = body.net_force_n.copy()
    share = np.ones(len(force)) if carried is None else carried
    flying = com_m > heights[-1] + 1e-3
    # About the point of the floor below the centre of mass.
    moment = body.net_moment_com_nm + np.cross(body.com_lab_m, force)
    loaded = ~flying & (force[:, 1] > 30.0)
    heels = [model.bodies.index(f"calcn_{side}") for side in "rl"]
    heel_m = body_poses(model, motion.q)[:, heels][..., :3, 3]
    cop = np.zeros((len(force), 2, 3))
    cop[..., 0] = (moment[:, 2] / np.where(loaded, force[:, 1], np.nan))[:, None]
    cop[..., 2] = heel_m[..., 2]
    half = np.where(loaded[:, None], force * [0.5, 0.5, 0.0], 0.0)
    wrenches = tuple(
        Wrench(body=f"calcn_{side}", force_n=half, moment_nm=np.cross(np.nan_to_num(cop[:, foot]), half))
        for foot, side in enumerate("rl")
    )
    true = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, wrenches)
    pressure = FootPressure(
        times_s=times_s[::5],
        vertical_n=np.repeat((share * half[:, 1])[::5, None], 2, axis=1),
        cop_foot_m=cop_on_soles(model, motion.q, np.where(loaded[:, None, None], cop, np.nan))[::5],
    )
    knees = np.stack([true.of(f"knee_angle_{side}") for side in "rl"], axis=1)
    return Recording(model, motion, pressure, knees, force)


def squat(depth_m, heights, seconds=3.0):
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return heights[-1] - 0.01 - depth_m * 0.5 * (1 - np.cos(2 * np.pi * t / seconds))


def knees_of(found, torques):
    return np.stack([torques.values[:, torques.index(f"knee_angle_{side}")] for side in "rl"], axis=1)


def rmse_nm_kg(found, torques, frames=slice(15, -15)):
    error = (knees_of(found, torques) - found.knees_nm)[frames]
    return float(np.sqrt(np.nanmean(error**2))) / MASS_KG


def analyse(found, task=None):
    body = observe(found.model, found.motion)
    forces = estimate_forces(found.pressure, body, COEFFICIENTS, ForceChoice(task=task))
    torques = find_torques(found.model, found.motion, forces, COEFFICIENTS, np.zeros_like(found.motion.q))
    return forces, torques


def test_a_squat_has_the_pivots_constants_and_its_torques(model, crouches):
    found = record(model, crouches, squat(0.22, crouches[0]))
    forces, torques = analyse(found)
    assert (forces.task, forces.methods) == ("squat", ("pivot", "pivot"))
    assert np.ptp(np.abs(found.knees_nm[:, 0])) > 50.0  # it is a squat: the knees carry
    # Nothing pushes the feet apart here, and the pivot's own pair of forces hardly turns a knee: 0.01 is 20 Hz.
    assert rmse_nm_kg(found, torques) < 0.02
    assert np.isfinite(torques.band[:-10]).all()
    # What the feet give is what the movement needs: 2 % of the weight upwards.
    assert np.sqrt((torques.residual[15:-15, 1] ** 2).mean()) < 0.02 * WEIGHT_N


def test_rising_from_a_chair_is_recognised_and_right_once_the_chair_is_left(model, crouches):
    com_m = squat(0.22, crouches[0], seconds=4.0)[200:]
    com_m = np.concatenate([np.full(100, com_m[0]), com_m, np.full(60, com_m[-1])])
    carried = np.clip((np.arange(len(com_m)) - 90) / 30, 0.25, 1.0)
    found = record(model, crouches, com_m, carried)
    forces, torques = analyse(found)
    assert forces.task == "sit_to_stand"
    assert rmse_nm_kg(found, torques, slice(135, -15)) < 0.09  # as expected of people: default.toml has 0.081


def test_a_landing_is_recognised_and_its_flight_has_no_force(model, crouches):
    heights = crouches[0]
    dt = 1 / RATE_HZ
    drop_s = np.sqrt(2 * 0.12 / G)
    flight = heights[-1] + 0.12 - 0.5 * G * (np.arange(0, drop_s, dt)) ** 2
    # The legs take the speed within a quarter of a second, then stretch again.
    speed, brake_s = G * drop_s, 0.25
    u = np.arange(0, brake_s, dt)
    brake = heights[-1] - speed * (u - u**2 / (2 * brake_s))
    rise = np.arange(0, 1.0, dt)
    stretch = brake[-1] + (heights[-1] - 0.01 - brake[-1]) * 0.5 * (1 - np.cos(np.pi * rise))
    com_m = np.concatenate([flight, brake, stretch, np.full(40, stretch[-1])])
    found = record(model, crouches, com_m)
    forces, torques = analyse(found)
    assert (forces.task, forces.methods) == ("landing", ("pivot", "pivot"))
    assert forces.expected_nm_kg > 0.25  # indicative only
    flying = slice(5, len(flight) - 8)
    assert np.nanmax(np.abs(forces.wrench[flying])) == 0.0
    # These legs begin to bend with the contact, at once: for 80 ms the movement asks for a centre of pressure off the soles.
    landed = slice(len(flight) + 8, -15)
    assert np.ptp(found.knees_nm[landed, 0]) > 50.0
    assert rmse_nm_kg(found, torques, landed) < 0.15  # 20 Hz, and the filter; people have 0.28 in default.toml
    within = (
        np.abs(knees_of(found, torques) - found.knees_nm)
        <= torques.band[:, [torques.index(f"knee_angle_{side}") for side in "rl"]] + 1.0
    )
    assert within[landed].mean() > 0.8


def test_feet_push_back_what_they_are_pushed(model, crouches):
    """The wrenches are at the floor below the feet, whatever the task."""
    found = record(model, crouches, squat(0.22, crouches[0]))
    forces, _ = analyse(found, task="landing")
    for wrench, foot in zip(foot_wrenches(forces), range(2), strict=True):
        pressed = forces.contact[:, foot]
        at = forces.cop_lab_m[pressed, foot]
        np.testing.assert_allclose(np.cross(at, wrench.force_n[pressed]), wrench.moment_nm[pressed], atol=1e-9)
        assert (at[:, 1] == 0).all()
