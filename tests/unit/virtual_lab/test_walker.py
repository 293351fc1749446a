"""The walker against the published curves that lead it, and its steps."""

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.virtual_lab import Limp, grow, truth_at, walk
from gonio.kernel.virtual_lab.normal_gait import normal_gait
from gonio.kernel.virtual_lab.steps import leg_length_m, pace_of, plan_steps
from gonio.kernel.virtual_lab.wanted import normal_phase

WEIGHT = 9.80665  # N/kg: ground forces in body weights

CURVES = {
    # Model: sign · course; published curve; least correlation, largest root mean square difference, in the curve's unit.
    # Angles lead the fit with a tolerance of 3° (hip rotation 6°). Moments lead nothing: they follow. The forces' own
    # uncertainty at people's knees is some 0.15 Nm/kg, and adults' moments exceed these children's by a third.
    "hip_flexion_r": ("hip_flexion", 0.99, 3.0),
    "hip_adduction_r": ("hip_adduction", 0.93, 2.0),
    "knee_angle_r": ("knee_flexion", 0.99, 3.0),
    "ankle_angle_r": ("ankle_dorsiflexion", 0.97, 3.5),
    "vertical": ("vertical_force", 0.98, 0.09),
    "forward": ("forward_force", 0.97, 0.02),
    "ankle moment": ("ankle_plantarflexion_moment", 0.97, 0.16),
    "knee moment": ("knee_extension_moment", 0.55, 0.20),
    "hip moment": ("hip_extension_moment", 0.65, 0.36),
}


def courses(made, truth):
    """The right leg as the published curves have it: degrees, body weights, Nm/kg."""
    phase = np.arange(len(truth.q)) / len(truth.q)
    gait = normal_gait(pace_of(made.body, made.steps.speed_m_s))
    published_at = normal_phase(made.steps, gait, 0, phase)
    upright = gait.at("anterior_pelvic_tilt", phase).mean()
    mass = made.body.mass_kg
    own = {name: np.rad2deg(truth.of(name)) for name in CURVES if name.endswith("_r")}
    own["hip_flexion_r"] = own["hip_flexion_r"] + upright
    own["vertical"], own["forward"] = (truth.wrench[:, 0, axis] / (mass * WEIGHT) for axis in (1, 0))
    for joint, coordinate in (("ankle", "ankle_angle_r"), ("knee", "knee_angle_r"), ("hip", "hip_flexion_r")):
        own[f"{joint} moment"] = -truth.moment_of(coordinate) / mass
    return own, {name: gait.at(curve, published_at) for name, (curve, *_) in CURVES.items()}


@pytest.mark.parametrize("speed", [0.9, 1.25, 1.55])
def test_angles_forces_and_moments_are_those_of_people(man, walker, speed):
    made = walker if speed == 1.25 else walk(man, speed)
    truth = truth_at(made, (1.0 + np.arange(200) / 200) * made.steps.stride_s)
    own, published = courses(made, truth)
    for name, (_, least, largest) in CURVES.items():
        assert np.corrcoef(own[name], published[name])[0, 1] > least, name
        assert np.sqrt(np.mean((own[name] - published[name]) ** 2)) < largest, name


def test_peaks_at_comfortable_speed_are_within_normal_bands(walker):
    truth = truth_at(walker, (1.0 + np.arange(400) / 400) * walker.steps.stride_s)
    own, _ = courses(walker, truth)
    stance = np.arange(400) / 400 < 0.6
    # Bands: mean ± 2 sd of the source (angles), and for forces and moments from the children's mean to what adults show.
    bands = {
        ("hip_flexion_r", "max"): (26, 48),
        ("hip_flexion_r", "min"): (-18, 6),
        ("knee_angle_r", "max"): (50, 68),
        ("ankle_angle_r", "max"): (4, 20),
        ("ankle_angle_r", "min"): (-32, -6),
        ("vertical", "max"): (1.0, 1.3),
        ("forward", "max"): (0.13, 0.28),
        ("forward", "min"): (-0.25, -0.1),
        ("ankle moment", "max"): (1.0, 1.8),
        ("knee moment", "max"): (0.2, 1.0),
        ("hip moment", "min"): (-1.5, -0.4),
    }
    for (name, kind), (low, high) in bands.items():
        assert low < getattr(own[name], kind)() < high, (name, kind)
    loading = own["knee_angle_r"][stance][:100].max()
    valley = own["vertical"][100:160].min()
    assert 12 < loading < 30
    assert 0.65 < valley < 0.92
    # The double hump: a valley between two peaks.
    assert own["vertical"][20:100].max() > valley + 0.1 < own["vertical"][160:240].max()


def test_cadence_and_step_follow_from_the_walk_ratio(man):
    steps, _ = plan_steps(man, 1.25, None)
    cadence, step_m = 120 / steps.stride_s, 1.25 * steps.stride_s / 2
    assert step_m / cadence == pytest.approx(0.0065, rel=1e-3)
    assert cadence == pytest.approx(107.4, abs=0.2)
    np.testing.assert_array_equal(steps.strike, [0.0, 0.5])


def test_small_people_take_short_quick_steps(man):
    boy = grow(man, 1.30, 30.0)
    assert boy.mass_kg == pytest.approx(30.0)
    assert leg_length_m(boy) / leg_length_m(man) == pytest.approx(1.30 / 1.728, rel=0.01)
    big, small = (plan_steps(body, 1.0, None)[0] for body in (man, boy))
    assert small.stride_s < big.stride_s


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_limp_shortens_one_stance_and_lengthens_the_other(man, side):
    normal, _ = plan_steps(man, 1.1, None)
    limping, _ = plan_steps(man, 1.1, Limp(side=side))
    spared = 0 if side == "right" else 1
    assert limping.stance[spared] == pytest.approx(0.93 * normal.stance[spared])
    assert limping.stance[1 - spared] > normal.stance[1 - spared]
    # Both phases of double support keep their length.
    double = normal.stance[0] - 0.5
    for foot in (0, 1):
        lift_of_other = np.mod(limping.strike[1 - foot] + limping.stance[1 - foot] - limping.strike[foot], 1)
        assert lift_of_other == pytest.approx(double)


def test_a_limping_knee_bends_less(man):
    limping = walk(man, 1.1, limp=Limp(side="left"))
    truth = truth_at(limping, np.arange(100) / 100 * limping.steps.stride_s)
    assert np.rad2deg(truth.of("knee_angle_l").max()) < 48 < 56 < np.rad2deg(truth.of("knee_angle_r").max())


def test_events_are_when_forces_begin_and_end(walker):
    times = np.arange(0.05, 4.0, 1 / 1000)
    truth = truth_at(walker, times)
    for foot, events in enumerate(truth.events):
        loaded = truth.wrench[:, foot, 1] > 0
        begins, ends = (np.flatnonzero(np.diff(loaded.astype(int)) == step) + 1 for step in (1, -1))
        np.testing.assert_allclose(begins, events.strike_frames, atol=1.01)
        np.testing.assert_allclose(ends, events.lift_frames, atol=1.01)


@pytest.mark.parametrize("speed", [0.3, 2.5])
def test_a_speed_without_curves_is_refused_with_the_ones_that_have_them(man, speed):
    with pytest.raises(InputError, match="outside what published curves cover") as caught:
        walk(man, speed)
    assert "0.72 to 1.73 m/s" in caught.value.hint


def test_an_impossible_stature_is_refused(man):
    with pytest.raises(InputError, match="impossible"):
        grow(man, 17.0, 70.0)


def test_the_same_walk_again_is_the_same(man, walker):
    np.testing.assert_allclose(walk(man, 1.25).harmonics, walker.harmonics, rtol=0, atol=1e-12)
