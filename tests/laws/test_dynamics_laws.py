"""Mechanics' own laws, on random poses and motions of models with every kind of joint."""

from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
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


def test_at_rest_the_pelvis_carries_the_weight() -> None:
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    q, still, _ = random_motion(model, 20, 7)
    found = solve_dynamics(model, q, 0 * still, 0 * still)
    weight_n = -model.mass_kg * model.gravity_m_s2
    for axis, name in enumerate(("pelvis_tx", "pelvis_ty", "pelvis_tz")):
        np.testing.assert_allclose(found.of(name), weight_n[axis], atol=1e-9 * np.abs(weight_n).max())


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


def test_joints_and_pushes_together_give_the_power(model: BodyModel) -> None:
    """dE/dt = Σ τ q̇ + Σ (F · v + M · ω), with what pushes each body from outside and that body's own motion."""
    q, u, a = random_motion(model, 10, 8)
    rng = np.random.default_rng(9)
    poses = [body_poses(model, q + u * t) for t in (-1e-6, 1e-6)]
    T_lab_body, rate = body_poses(model, q), (poses[1] - poses[0]) / 2e-6
    wrenches, given_w = [], np.zeros(len(q))
    for index, name in enumerate(model.bodies.names):
        force, moment = 100 * rng.normal(size=(2, len(q), 3))
        place, turn = (
            T_lab_body[:, index, :3, 3],
            rate[:, index, :3, :3] @ T_lab_body[:, index, :3, :3].transpose(0, 2, 1),
        )
        omega = 0.5 * np.stack([turn[:, i, j] - turn[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
        wrenches.append(wrench_at_point(name, force, place, moment))
        given_w += (force * rate[:, index, :3, 3] + moment * omega).sum(axis=1)
    pushed, alone = solve_dynamics(model, q, u, a, tuple(wrenches)), solve_dynamics(model, q, u, a)
    # Two products with differences of poses: rounding 1e-16 · 10 m / 1e-6 s = 1e-9 of 100 N in ten bodies.
    scale_w = np.abs(given_w).max()
    np.testing.assert_allclose((alone.powers_w - pushed.powers_w).sum(axis=1), given_w, atol=1e-7 * scale_w)


def test_momenta_change_as_the_net_wrench_says(model: BodyModel) -> None:
    """dp/dt = F + m g and dL/dt = M about the centre of mass, by central differences; p = m v of the centre of mass."""
    q, u, a = random_motion(model, 20, 10)
    found, step = solve_dynamics(model, q, u, a), 1e-5
    before, after = (solve_dynamics(model, q + u * t + a * t * t / 2, u + a * t, a) for t in (-step, step))
    # As for the energy: truncation ~ step² times a third derivative, 1e-10 · 1e6; rounding far below.
    near = {"rtol": 1e-5, "atol": 1e-3}
    com_rate = (after.com_lab_m - before.com_lab_m) / (2 * step)
    np.testing.assert_allclose(found.momentum_ns, model.mass_kg * com_rate, **near)
    momentum_rate = (after.momentum_ns - before.momentum_ns) / (2 * step)
    np.testing.assert_allclose(momentum_rate, found.net_force_n + model.mass_kg * model.gravity_m_s2, **near)
    spin_rate = (after.angular_momentum_nms - before.angular_momentum_nms) / (2 * step)
    np.testing.assert_allclose(spin_rate, found.net_moment_com_nm, **near)


def mass_matrix_and_height_energy(model: BodyModel, q: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M(q) and the potential energy from nothing but where the bodies are, by central differences of their poses."""
    step, count = 1e-4, len(free)
    shifted = np.tile(q[:, None, None], (1, 2, count, 1))
    for column, coordinate in enumerate(free):
        shifted[:, 0, column, coordinate] += step
        shifted[:, 1, column, coordinate] -= step
    com = model.bodies.com_body_m
    T = body_poses(model, shifted.reshape(-1, q.shape[1])).reshape(len(q), 2, count, -1, 4, 4)
    T_now = body_poses(model, q)
    place = T[..., :3, :3] @ com[..., None] + T[..., :3, 3:]
    J_com = ((place[:, 0] - place[:, 1]) / (2 * step))[..., 0]  # (q, coordinate, body, 3)
    turn = (T[:, 0, ..., :3, :3] - T[:, 1, ..., :3, :3]) / (2 * step) @ T_now[:, None, :, :3, :3].swapaxes(-1, -2)
    J_turn = 0.5 * np.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    R = T_now[..., :3, :3]
    inertia = R @ model.bodies.inertia_body_kgm2 @ R.swapaxes(-1, -2)
    mass = np.einsum("b,nabi,ncbi->nac", model.bodies.mass_kg, J_com, J_com, optimize=True)
    mass += np.einsum("nabi,nbij,ncbj->nac", J_turn, inertia, J_turn, optimize=True)
    com_lab = (R @ com[..., None])[..., 0] + T_now[..., :3, 3]
    return mass, -np.einsum("b,nbi,i->n", model.bodies.mass_kg, com_lab, model.gravity_m_s2)


def test_the_forces_solve_lagranges_equations(model: BodyModel) -> None:
    """τ = M q̈ + Ṁ q̇ − ∂(q̇ᵀ M q̇ / 2)/∂q + ∂V/∂q, with M and V from poses alone: no Newton, no Euler, no recursion."""
    q, u, a = (part[0] for part in random_motion(model, 1, 11))
    free = np.flatnonzero((model.coordinates.coupled_to < 0) & ~model.coordinates.locked)
    step = 1e-3
    sides = np.stack([q + sign * step * np.eye(len(q))[free] for sign in (1, -1)])
    near_mass, near_energy = mass_matrix_and_height_energy(model, sides.reshape(-1, len(q)), free)
    count, u, a = len(free), u[free], a[free]
    mass_slope = np.diff(near_mass.reshape(2, count, count, count)[::-1], axis=0)[0] / (2 * step)  # ∂M/∂q_c, c first
    energy_slope = np.diff(near_energy.reshape(2, count)[::-1], axis=0)[0] / (2 * step)
    mass = mass_matrix_and_height_energy(model, q[None], free)[0][0]
    expected = mass @ a + np.einsum("cab,c,b->a", mass_slope, u, u) - 0.5 * np.einsum("cab,a,b->c", mass_slope, u, u)
    expected += energy_slope
    everywhere = np.zeros((2, 1, len(q)))
    everywhere[0, 0, free], everywhere[1, 0, free] = u, a
    found = solve_dynamics(model, q[None], *everywhere).forces[0, free]
    # Differences of second order with steps of 1e-3: some 1e-6 of each of the hundreds of terms of a sum.
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_the_mass_matrix_is_symmetric_and_gives_the_energy(model: BodyModel) -> None:
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


def test_a_motion_of_another_model_is_refused(model: BodyModel) -> None:
    q = np.zeros((3, len(model.coordinates.names) + 1))
    with pytest.raises(InputError, match="the motion has the shapes"):
        solve_dynamics(model, q, q, q)


def test_what_a_nan_takes_part_in_is_nan_and_a_missing_push_is_none() -> None:
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    q, u, a = random_motion(model, 3, 12)
    missing = np.full((3, 3), np.nan)
    pushed = solve_dynamics(model, q, u, a, (wrench_at_point("calcn_r", missing, missing),))
    np.testing.assert_array_equal(pushed.forces, solve_dynamics(model, q, u, a).forces)
    q[1, model.coordinates.index("knee_angle_r")] = np.nan
    found = solve_dynamics(model, q, u, a)
    assert np.isnan(found.forces[1]).any()
    assert np.isnan(found.energy_j[1])
    assert np.isfinite(found.forces[[0, 2]]).all()


def test_dependent_coordinates_are_computed_not_believed(model: BodyModel) -> None:
    q, u, a = random_motion(model, 3, 6)
    garbled = np.where(model.coordinates.coupled_to >= 0, 99.0, q)
    np.testing.assert_allclose(
        solve_dynamics(model, garbled, u, a).forces, solve_dynamics(model, couple(model, q), u, a).forces
    )
