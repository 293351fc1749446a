"""Forces under the feet: contacts, gains, places, tasks, the ways to the shear, torques and their bands."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.force_coefficients import builtin_force_coefficients, read_force_coefficients
from gonio.formats.osim import read_osim
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.forces.contact import find_contacts, phases
from gonio.kernel.forces.estimate import ForceChoice, estimate_forces, find_gain, measured_forces, resample, with_plates
from gonio.kernel.forces.task import recognise_task
from gonio.kernel.forces.torque import find_torques
from gonio.kernel.forces.whole_body import WholeBody, observe
from gonio.kernel.virtual_lab import SOLES, grow, press, truth_at, walk
from gonio.records import FootForces, FootPressure
from gonio.resources import models_dir

RATE_HZ, WEIGHT_N = 100.0, 700.0
COEFFICIENTS = builtin_force_coefficients()


@pytest.fixture(scope="module")
def walker():
    return walk(grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, 70.0), 1.25)


@pytest.fixture(scope="module")
def truth(walker):
    return truth_at(walker, np.arange(0, 2.5, 1 / 60))


@pytest.fixture(scope="module")
def motion(truth):
    return SmoothMotion(truth.times_s, truth.q, truth.velocity, truth.acceleration)


@pytest.fixture(scope="module")
def body(walker, motion):
    return observe(walker.body, motion)


@pytest.fixture(scope="module")
def pressure(walker):
    return press(walker, errors=SOLES["clean"], duration_s=2.6, rate_hz=20.0).pressure


def loads(*contacts, frames=300, foot=0):
    force = np.zeros((frames, 2))
    for begin, end, newtons in contacts:
        force[begin:end, foot] = newtons
    return force


def test_a_contact_has_a_core_and_bridges_short_gaps_only():
    # 0.06 · 700 N = 42 N for 0.1 s are a core; 30 N alone are none. 7 frames of gap are merged, 9 are not.
    force = loads((10, 60, 500), (67, 100, 400), (120, 150, 30), (160, 200, 500), (209, 240, 500))
    found = [(c.begin, c.end) for c in find_contacts(force, RATE_HZ, WEIGHT_N)]
    assert found == [(10, 100), (160, 200), (209, 240)]


def test_a_contact_reaches_at_most_60_ms_beyond_its_core():
    force = loads((10, 50, 20), (50, 100, 500), (100, 140, 20))
    (contact,) = find_contacts(force, RATE_HZ, WEIGHT_N)
    assert (contact.begin, contact.end) == (44, 106)


def test_phases_of_cut_contacts_take_the_median_length():
    force = loads((0, 31, 500), (100, 161, 500), (280, 300, 500))
    contacts = find_contacts(force, RATE_HZ, WEIGHT_N)
    assert [c.whole for c in contacts] == [False, True, False]
    phase = phases(contacts, 300)[:, 0]
    assert phase[100] == 0
    assert phase[160] == 1
    assert phase[130] == pytest.approx(0.5)  # 30 of 60 frames' steps
    assert phase[0] == pytest.approx(0.5)  # 31 frames were seen of 61: half is over
    assert phase[30] == 1
    assert phase[280] == 0
    assert phase[299] == pytest.approx(19 / 60)
    assert np.isnan(phase[200])


def test_a_lost_stretch_is_not_bridged(pressure, truth):
    holed = pressure.vertical_n.copy()
    holed[20:25] = np.nan
    vertical_n, _ = resample(replace(pressure, vertical_n=holed), truth.times_s)
    lost_s = (pressure.times_s[19], pressure.times_s[25])
    inside = (truth.times_s > lost_s[0] + 1e-9) & (truth.times_s < lost_s[1] - 1e-9)
    assert np.isnan(vertical_n[inside]).all()
    assert np.isfinite(vertical_n[~inside]).all()


def test_gains_come_back(body, truth):
    # True forces times 1.1 and 0.9: with 2.5 s of data the prior of 1 ± 0.1 pulls by a hundredth of that at most.
    shown = truth.wrench[..., 1] * [1.1, 0.9]
    np.testing.assert_allclose(find_gain(shown, body) * [1.1, 0.9], 1.0, atol=0.02)


def test_places_on_the_soles_come_back_to_the_lab(body, pressure, truth):
    forces = estimate_forces(pressure, body, COEFFICIENTS)
    loaded = (truth.wrench[..., 1] > 200) & forces.contact
    apart = (forces.cop_lab_m - truth.cop_lab_m)[loaded]
    # Between samples 50 ms apart the place moves along a curve: millimetres.
    assert np.sqrt((apart**2).mean()) < 0.006


@pytest.mark.parametrize("method", ["vertical", "newton_euler", "pivot", "template"])
def test_methods_give_wrenches_that_press_where_they_say(body, pressure, method):
    forces = estimate_forces(pressure, body, COEFFICIENTS, ForceChoice(method=method))
    assert forces.methods == (method, method)
    assert forces.task == "walking"
    np.testing.assert_array_equal(forces.wrench[~forces.contact], 0.0)
    pressed = forces.wrench[forces.contact]
    moment = np.cross(forces.cop_lab_m[forces.contact], pressed[:, :3])
    np.testing.assert_allclose(pressed[:, 3:], moment, atol=1e-9)
    assert (pressed[:, 1] > 0).all()
    if method == "vertical":
        np.testing.assert_allclose(pressed[:, [0, 2]], 0.0, atol=1e-12)
    assert (forces.sd_n[forces.contact] > 0).all()


def test_the_net_share_sums_up_to_what_the_body_needs(body, pressure):
    forces = estimate_forces(pressure, body, COEFFICIENTS, ForceChoice(method="newton_euler"))
    np.testing.assert_allclose(forces.wrench[..., 0].sum(axis=1), body.need_n[:, 0], atol=1e-9)


def test_outside_of_the_templates_speeds_the_pivot_is_taken_and_said(pressure, body):
    narrow = replace(COEFFICIENTS, speed_range_m_s=(1.4, 1.5))
    forces = estimate_forces(pressure, body, narrow)
    assert forces.methods == ("pivot", "pivot")
    assert forces.speed_m_s == pytest.approx(1.25, abs=0.02)  # 2.5 s are not whole strides
    assert "1.4 to 1.5 m/s" in forces.fallback
    assert forces.expected_nm_kg == 0.111


def test_the_pivot_is_given_a_part_of_the_missing_moment(body, pressure, truth):
    def error_n(moment_gain: float) -> float:
        walking = replace(COEFFICIENTS.tasks["walking"], moment_gain=moment_gain)
        told = replace(COEFFICIENTS, tasks={**COEFFICIENTS.tasks, "walking": walking})
        forces = estimate_forces(pressure, body, told, ForceChoice(method="pivot"))
        inner = slice(20, -20)  # the whole body's acceleration is not known at the ends
        return float(
            np.sqrt(np.mean((forces.wrench[..., 0].sum(axis=1) - truth.wrench[..., 0].sum(axis=1))[inner] ** 2))
        )

    assert error_n(COEFFICIENTS.tasks["walking"].moment_gain) < 0.9 * error_n(0.0)


def test_turning_the_lab_turns_the_forces(body, pressure):
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    T = np.eye(4)
    T[:3, :3] = R
    turned = body._replace(
        com_lab_m=body.com_lab_m @ R.T,
        need_n=body.need_n @ R.T,
        turning_nm=body.turning_nm @ R.T,
        heading_lab=body.heading_lab @ R.T,
        T_lab_heel=T @ body.T_lab_heel,
        T_lab_toes=T @ body.T_lab_toes,
    )
    one, other = (estimate_forces(pressure, b, COEFFICIENTS) for b in (body, turned))
    np.testing.assert_allclose(other.wrench[..., :3], one.wrench[..., :3] @ R.T, atol=1e-8)
    np.testing.assert_allclose(other.wrench[..., 3:], one.wrench[..., 3:] @ R.T, atol=1e-8)


def test_knee_torque_of_a_virtual_walk(walker, truth, motion, body, pressure):
    forces = estimate_forces(pressure, body, COEFFICIENTS)
    torques = find_torques(walker.body, motion, forces, COEFFICIENTS, np.zeros_like(truth.q))
    for name in ("knee_angle_r", "knee_angle_l"):
        error_nm = torques.values[:, torques.index(name)] - truth.moment_of(name)
        # The bar of a virtual walk end to end is 0.10 Nm/kg; movement and soles are perfect here.
        assert np.sqrt((error_nm**2).mean()) < 0.10 * 70.0
    np.testing.assert_allclose(torques.power_w, torques.values * truth.velocity)
    # The true wrenches leave nothing over, and so no band.
    plates = FootForces(
        times_s=truth.times_s,
        wrench=truth.wrench,
        cop_lab_m=truth.cop_lab_m,
        shared=np.zeros(len(truth.times_s), dtype=bool),
    )
    for exact in (measured_forces(plates, body), with_plates(forces, plates)):
        assert exact.methods == ("plates", "plates")
        found = find_torques(walker.body, motion, exact, COEFFICIENTS, np.zeros_like(truth.q))
        whole = np.isfinite(exact.wrench).all(axis=(1, 2)) & (exact.sd_n == 0).all(axis=(1, 2))
        assert whole.mean() > 0.9
        np.testing.assert_allclose(found.values[whole], truth.generalized_forces[whole], atol=1e-6)
        np.testing.assert_allclose(found.residual[whole], 0.0, atol=1e-6)
        np.testing.assert_allclose(found.band[whole], 0.0, atol=1e-6)


def test_shear_bands_are_forces_times_levers(walker, truth, motion, body, pressure):
    forces = estimate_forces(pressure, body, COEFFICIENTS)
    torques = find_torques(walker.body, motion, forces, COEFFICIENTS, np.zeros_like(truth.q))
    pushed = replace(forces, wrench=forces.wrench.copy())
    wrench = pushed.wrench.copy()
    push = forces.sd_n[:, 0, :1] * forces.heading_lab
    wrench[:, 0] += np.concatenate([push, np.cross(np.nan_to_num(forces.cop_lab_m[:, 0]), push)], axis=1)
    more = find_torques(walker.body, motion, replace(forces, wrench=wrench), COEFFICIENTS, np.zeros_like(truth.q))
    knee = torques.index("knee_angle_r")
    moved = np.abs(more.values - torques.values)[:, knee]
    # Sideways forces have a part too, but a small one: knees bend about an axis across the walk.
    assert (torques.sd_shear[:, knee] >= moved - 1e-9).all()
    assert torques.sd_shear[:, knee].max() < 1.5 * moved.max()
    np.testing.assert_allclose(torques.band[:, knee], 2.5 * torques.sd_shear[:, knee])


def still(need_n):
    """A body that stands with its feet where they are, and needs the given force over time."""
    frames = len(need_n)
    T = np.broadcast_to(np.eye(4), (frames, 2, 4, 4))
    return WholeBody(
        times_s=np.arange(frames) / RATE_HZ,
        com_lab_m=np.tile([0.1, 0.95, 0.0], (frames, 1)),
        need_n=np.stack([0 * need_n, need_n, 0 * need_n], axis=1),
        turning_nm=np.zeros((frames, 3)),
        heading_lab=np.tile([1.0, 0.0, 0.0], (frames, 1)),
        T_lab_heel=T,
        T_lab_toes=T,
        ball_m=np.tile([0.18, 0.0, 0.0], (2, 1)),
        weight_n=WEIGHT_N,
    )


def soles_of(force_n):
    return FootPressure(
        times_s=np.arange(len(force_n)) / RATE_HZ, vertical_n=force_n, cop_foot_m=np.full((*force_n.shape, 2), 0.1)
    )


def recordings():
    time = np.arange(300)
    stand = np.full((300, 2), 350.0)
    chair = stand.copy()
    chair[:150] = 100.0  # on a chair the feet carry little
    stance = [(time // 15) % 4 == 0, (time // 15) % 4 == 2]  # 0.15 s each, flight between
    run = np.stack([1400.0 * stance[0], 1400.0 * stance[1]], axis=1)
    jump = stand.copy()
    jump[100:140] = 0.0
    need_of_jump = jump.sum(axis=1)
    return {
        "squat": (stand, np.full(300, WEIGHT_N)),
        "sit_to_stand": (chair, np.full(300, WEIGHT_N)),
        "running": (run, run.sum(axis=1)),
        "landing": (jump, need_of_jump),
    }


@pytest.mark.parametrize("task", ["squat", "sit_to_stand", "running", "landing"])
def test_tasks_are_recognised_by_their_contacts(task):
    force, need = recordings()[task]
    forces = estimate_forces(soles_of(force), still(need), COEFFICIENTS)
    assert forces.task == task
    assert forces.methods == (("template", "template") if task == "running" else ("pivot", "pivot"))


def test_a_foot_beside_the_plates_is_no_flight():
    force = loads((0, 120, 700), foot=0) + loads((180, 300, 700), foot=1)
    contacts = find_contacts(force, RATE_HZ, WEIGHT_N)
    assert recognise_task(still(np.full(300, WEIGHT_N)), contacts) == "walking"


def test_no_contact_is_an_error_that_says_what_to_check():
    with pytest.raises(InputError, match="no contact"):
        estimate_forces(soles_of(np.ones((300, 2))), still(np.full(300, WEIGHT_N)), COEFFICIENTS)


def test_a_labs_own_coefficients_take_the_place_of_ours(tmp_path):
    own = tmp_path / "own.toml"
    text = (models_dir() / "forces" / "default.toml").read_text()
    own.write_text(text.replace("pivot = [0.77, 0.72]", "pivot = [0.7, 0.6]"))
    np.testing.assert_array_equal(read_force_coefficients(own).tasks["squat"].pivot, [0.7, 0.6])
    own.write_text(text.replace("[0.2748, ", "["))
    with pytest.raises(InputError, match="6 and 7 weights"):
        read_force_coefficients(own)
