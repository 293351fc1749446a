"""Mechanics' own laws, on random poses and motions of models with every kind of joint."""

from pathlib import Path

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, couple
from gonio.kernel.dynamics.recursive import solve_dynamics, wrench_at_point
from gonio.records import BodyModel
from gonio.resources import models_dir

ALL_JOINTS = Path(__file__).parents[1] / "golden" / "all_joints.osim"


@pytest.fixture(scope="module", params=["fullbody_male", "all_joints"])
def model(request: pytest.FixtureRequest) -> BodyModel:
    """The built-in body, whose knees slide while they bend, and a model with all joint and function kinds, couplers too."""
    if request.param == "all_joints":
        return read_osim(ALL_JOINTS)
    return read_osim(models_dir() / "bodies" / "fullbody_male.osim")


def random_motion(model: BodyModel, frames: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    coordinates = model.coordinates
    scale = np.where(coordinates.rotational, 0.4, 0.1)
    free = (coordinates.coupled_to < 0) & ~coordinates.locked
    q = coordinates.default + scale * rng.normal(size=(frames, len(coordinates.names)))
    return (
        np.where(free, q, coordinates.default),
        np.where(free, 3 * scale * rng.normal(size=q.shape), 0.0),
        np.where(free, 20 * scale * rng.normal(size=q.shape), 0.0),
    )


def test_at_rest_the_ground_carries_the_weight(model: BodyModel) -> None:
    q, still, _ = random_motion(model, 20, 1)
    found = solve_dynamics(model, q, 0 * still, 0 * still)
    weight = -model.mass_kg * model.gravity_m_s2
    np.testing.assert_allclose(found.net_force_n, np.tile(weight, (20, 1)), atol=1e-9 * np.abs(weight).max())
    np.testing.assert_allclose(found.net_moment_nm, np.cross(found.com_lab_m, weight), atol=1e-8 * np.abs(weight).max())


def test_falling_freely_needs_no_force() -> None:
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    q, still, _ = random_motion(model, 20, 2)
    falling = np.zeros_like(q)
    for axis, name in enumerate(("pelvis_tx", "pelvis_ty", "pelvis_tz")):
        falling[:, model.coordinates.index(name)] = model.gravity_m_s2[axis]
    assert np.abs(solve_dynamics(model, q, 0 * still, falling).forces).max() < 1e-9


def test_a_push_where_the_motion_needs_it_leaves_nothing_for_the_root() -> None:
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    q, u, a = random_motion(model, 20, 3)
    need = solve_dynamics(model, q, u, a)
    # A force at the foot and a moment that together equal what the whole body needs.
    foot = body_poses(model, q)[:, model.bodies.index("calcn_r"), :3, 3]
    rest = need.net_moment_nm - np.cross(foot, need.net_force_n)
    pushed = solve_dynamics(model, q, u, a, (wrench_at_point("calcn_r", need.net_force_n, foot, rest),))
    for name in ("pelvis_tx", "pelvis_ty", "pelvis_tz", "pelvis_tilt", "pelvis_list", "pelvis_rotation"):
        assert np.abs(pushed.of(name)).max() < 1e-8


def test_power_is_the_rate_of_the_energy(model: BodyModel) -> None:
    """dE/dt = Σ τ q̇, by central differences along the motion q + u t + a t²/2."""
    q, u, a = random_motion(model, 30, 4)
    forces = solve_dynamics(model, q, u, a).forces
    step = 1e-5
    energies = []
    for t in (-step, step):
        energies.append(solve_dynamics(model, q + u * t + a * t * t / 2, u + a * t, a).energy_j)
    power = (energies[1] - energies[0]) / (2 * step)
    independent = model.coordinates.coupled_to < 0
    work = (forces * u)[:, independent & ~model.coordinates.locked].sum(axis=1)
    # Truncation ~ step² · d³E/dt³ ~ 1e-10 · 1e6; rounding 1e-16 · 1e4 J / step = 1e-7 W.
    np.testing.assert_allclose(work, power, rtol=1e-5, atol=1e-3)


def test_the_forces_are_lagranges(model: BodyModel) -> None:
    """τ = M(q) q̈ + …: linear in the acceleration, with a symmetric positive definite M."""
    q, u, _ = random_motion(model, 1, 5)
    free = np.flatnonzero((model.coordinates.coupled_to < 0) & ~model.coordinates.locked)
    count = len(free)
    bias = solve_dynamics(model, q, u, 0 * q).forces[0, free]
    columns = np.tile(q, (count, 1)), np.tile(u, (count, 1)), np.zeros((count, q.shape[1]))
    columns[2][np.arange(count), free] = 1.0
    mass = solve_dynamics(model, *columns).forces[:, free] - bias
    np.testing.assert_allclose(mass, mass.T, atol=1e-9 * np.abs(mass).max())
    assert np.linalg.eigvalsh(mass).min() > 0
    kinetic = solve_dynamics(model, q, u, 0 * q).energy_j - solve_dynamics(model, q, 0 * u, 0 * q).energy_j
    assert 0.5 * u[0, free] @ mass @ u[0, free] == pytest.approx(kinetic[0], rel=1e-9)


def test_dependent_coordinates_are_computed_not_believed(model: BodyModel) -> None:
    q, u, a = random_motion(model, 3, 6)
    garbled = np.where(model.coordinates.coupled_to >= 0, 99.0, q)
    np.testing.assert_allclose(
        solve_dynamics(model, garbled, u, a).forces, solve_dynamics(model, couple(model, q), u, a).forces
    )
