"""Laws that every virtual walk obeys: the ground carries it, the feet stand, nothing is random."""

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.body.soles import BALL, HEEL, TIP, mark_soles, measure_sole
from gonio.kernel.virtual_lab import Limp, grow, truth_at, walk
from gonio.kernel.virtual_lab.feet import directions, heels_on_floor
from gonio.kernel.virtual_lab.harmonics import coordinates_at
from gonio.records import FEET, BodyModel, Walk, WalkTruth
from gonio.resources import models_dir


def body(sex: str) -> BodyModel:
    return read_osim(models_dir() / "bodies" / f"fullbody_{sex}.osim")


WALKERS = {
    "man": lambda: walk(body("male"), 1.25),
    "slow man": lambda: walk(body("male"), 0.8),
    "fast man": lambda: walk(body("male"), 1.6),
    "small woman": lambda: walk(grow(body("female"), 1.55, 52.0), 1.15),
    "limping left": lambda: walk(body("male"), 1.25, limp=Limp(side="left")),
}


@pytest.fixture(scope="module", params=WALKERS)
def walker(request: pytest.FixtureRequest) -> tuple[Walk, WalkTruth]:
    """A walk, and its truth at 200 moments of the third stride."""
    made = WALKERS[request.param]()
    return made, truth_at(made, (2.0 + np.arange(200) / 200) * made.steps.stride_s)


def test_the_ground_forces_are_mass_times_acceleration(walker: tuple[Walk, WalkTruth]) -> None:
    """By differences of where the bodies are: an account of its own, that shares nothing with the recursion."""
    made, truth = walker
    step_s = 1e-3
    bodies = made.body.bodies

    def places(shift_s: float) -> tuple[np.ndarray, np.ndarray]:
        T_lab_body = body_poses(made.body, coordinates_at(made, truth.times_s + shift_s).q)
        com = np.einsum("fbij,bj->fbi", T_lab_body[..., :3, :3], bodies.com_body_m) + T_lab_body[..., :3, 3]
        return com, T_lab_body[..., :3, :3]

    # Fourth-order differences: second derivative to h⁴/90 · sixth derivative, about 1e-12 · (2π 10 Hz)⁶ · 1e-3 m / 90
    # = 6e-7 m/s²; rounding 1e-16 / h² = 1e-10. A knot of the knee's spline within h adds a little: 80 kg, 0.05 N.
    com = [places(k * step_s)[0] for k in (-2, -1, 0, 1, 2)]
    acceleration = (-com[0] + 16 * com[1] - 30 * com[2] + 16 * com[3] - com[4]) / (12 * step_s**2)
    force = np.einsum("b,fbi->fi", bodies.mass_kg, acceleration - made.body.gravity_m_s2)
    np.testing.assert_allclose(truth.wrench[..., :3].sum(axis=1), force, atol=0.05)

    # Angular momentum about the lab's origin: its derivative is the moment of weight and ground.
    def momentum(shift_s: float) -> np.ndarray:
        before, _ = places(shift_s - step_s)
        here, turn = places(shift_s)
        after, turned = places(shift_s + step_s)
        earlier = places(shift_s - step_s)[1]
        spin = np.einsum("fbij,fbkj->fbik", (turned - earlier) / (2 * step_s), turn)
        omega = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
        inertia = turn @ bodies.inertia_body_kgm2 @ np.swapaxes(turn, -1, -2)
        orbit = np.cross(here, (after - before) / (2 * step_s)) * bodies.mass_kg[:, None]
        return (orbit + np.einsum("fbij,fbj->fbi", inertia, omega)).sum(axis=1)

    weight = np.cross(com[2], made.body.gravity_m_s2) * bodies.mass_kg[:, None]
    moment = (momentum(step_s) - momentum(-step_s)) / (2 * step_s) - weight.sum(axis=1)
    # Second-order differences: h²/6 · (2π 10 Hz)² = 7e-4 of the largest rate of change, some 100 Nm.
    np.testing.assert_allclose(truth.wrench[..., 3:].sum(axis=1), moment, atol=0.5)


def test_nothing_holds_the_pelvis(walker: tuple[Walk, WalkTruth]) -> None:
    """The residuals are m (a − g) − ΣF and its moment about the pelvis, in newtons and newton metres."""
    _, truth = walker
    root = [i for i, n in enumerate(truth.coordinate_names) if n.startswith("pelvis")]
    assert len(root) == 6
    assert np.abs(truth.generalized_forces[:, root]).max() < 1e-9


def test_momentum_returns_after_a_stride(walker: tuple[Walk, WalkTruth]) -> None:
    made, truth = walker
    weight = made.body.mass_kg * made.body.gravity_m_s2
    # The mean over 200 moments is the integral but for the corners of the knee's spline, a few in a stride.
    np.testing.assert_allclose(truth.wrench[..., :3].sum(axis=1).mean(axis=0), -weight, atol=1e-2)
    onwards = coordinates_at(made, truth.times_s + made.steps.stride_s).q - truth.q
    stride_m = made.steps.speed_m_s * made.steps.stride_s * (np.array(truth.coordinate_names) == "pelvis_tx")
    np.testing.assert_allclose(onwards, np.tile(stride_m, (len(onwards), 1)), atol=1e-9)


def test_feet_stand_where_they_carry_weight(walker: tuple[Walk, WalkTruth]) -> None:
    made, truth = walker
    weight_n = made.body.mass_kg * 9.80665
    soles = marker_positions(mark_soles(made.body), truth.q).reshape(len(truth.q), len(FEET), 4, 3)
    phase = truth.times_s / made.steps.stride_s
    heels = heels_on_floor(made.steps, phase)
    heels[..., 0] += (made.start_m + made.steps.speed_m_s * truth.times_s)[:, None]
    for foot, turn in enumerate(directions(made.steps)):
        own = made.steps.phase(foot, phase)
        carries = truth.wrench[:, foot, 1] > 0.1 * weight_n
        on_heel, on_ball = carries & (own < made.steps.heel_off[foot]), carries & (own > made.steps.flat[foot])
        heel = soles[:, foot, HEEL] - heels[:, foot]
        ball = soles[:, foot, BALL] - heels[:, foot] - turn @ measure_sole(made.body).ball_m[foot]
        assert np.abs(heel[on_heel][:, [0, 2]]).max() < 0.003
        assert np.abs(ball[on_ball][:, [0, 2]]).max() < 0.003
        assert np.abs(heel[on_heel, 1]).max() < 0.004
        assert np.abs(soles[carries & (own > made.steps.flat[foot]), foot, TIP, 1]).max() < 0.006
        # Neither foot goes through the floor, but for the tip of the toes as it leaves, by the softness of a shoe.
        assert soles[:, foot, :, 1].min() > -0.008
        swing = (own - made.steps.stance[foot]) / (1.0 - made.steps.stance[foot])
        assert soles[(swing > 0.33) & (swing < 0.8), foot, :, 1].min() > 0.003


def test_forces_are_such_as_a_foot_on_a_floor_can_give(walker: tuple[Walk, WalkTruth]) -> None:
    made, truth = walker
    phase = truth.times_s / made.steps.stride_s
    heels = heels_on_floor(made.steps, phase)
    heels[..., 0] += (made.start_m + made.steps.speed_m_s * truth.times_s)[:, None]
    length = measure_sole(made.body).length_m
    for foot, turn in enumerate(directions(made.steps)):
        force = truth.wrench[:, foot, :3]
        stands = made.steps.phase(foot, phase) < made.steps.stance[foot]
        assert np.all(force[~stands] == 0)
        assert np.all(np.isnan(truth.cop_lab_m[~stands, foot]))
        assert np.all(force[stands, 1] >= 0)
        loaded = force[:, 1] > 0
        assert (np.hypot(force[loaded, 0], force[loaded, 2]) / force[loaded, 1]).max() < 0.6
        cop = ((truth.cop_lab_m[:, foot] - heels[:, foot]) @ turn)[loaded] / length
        # A sole of 1.36 lengths of heel to toe joint, and 40 mm wide each way at the heel of a foot of 180 mm.
        assert 0 < cop[:, 0].min() < cop[:, 0].max() < 1.36
        assert np.abs(cop[:, 2]).max() < 0.1
        assert np.abs(cop[:, 1]).max() < 1e-9


def test_front_foot_brakes_and_rear_foot_pushes(walker: tuple[Walk, WalkTruth]) -> None:
    made, truth = walker
    weight_n = made.body.mass_kg * 9.80665
    for foot in range(len(FEET)):
        own = made.steps.phase(foot, truth.times_s / made.steps.stride_s) / made.steps.stance[foot]
        forward = truth.wrench[:, foot, 0] / weight_n
        assert forward[(own > 0.1) & (own < 0.3)].max() < 0
        assert forward[(own > 0.75) & (own < 0.95)].min() > 0
        both = np.all(truth.wrench[:, :, 1] > 0.1 * weight_n, axis=1)
        front = made.steps.phase(foot, truth.times_s / made.steps.stride_s) < made.steps.phase(
            1 - foot, truth.times_s / made.steps.stride_s
        )
        assert np.all(forward[both & front] < 0.02)
