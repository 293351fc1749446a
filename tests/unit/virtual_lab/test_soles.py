"""Pressure soles: what they show of the ground force, and what is wrong with them."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.body.forward import body_poses
from gonio.kernel.body.soles import measure_sole
from gonio.kernel.virtual_lab import SOLES, SoleErrors, press, truth_at
from gonio.kernel.virtual_lab.soles import TOE_SHARE, cop_on_soles
from gonio.records import FEET


def test_perfect_soles_show_the_vertical_force_at_even_times(walker):
    soles = press(walker, errors=SOLES["clean"])
    np.testing.assert_allclose(soles.pressure.times_s, np.arange(58) / 20.0)
    truth = truth_at(walker, soles.pressure.times_s)
    np.testing.assert_array_equal(soles.pressure.vertical_n, truth.wrench[..., 1])
    loaded = soles.pressure.vertical_n > 10
    np.testing.assert_array_equal(np.isfinite(soles.pressure.cop_foot_m[..., 0]), loaded)


def test_the_place_on_the_sole_leads_back_to_the_place_on_the_floor(walker):
    times = np.arange(0, 3, 1 / 200)
    truth = truth_at(walker, times)
    on_sole = cop_on_soles(walker.body, truth.q, truth.cop_lab_m)
    T_lab_body = body_poses(walker.body, truth.q)
    for foot, side in enumerate(FEET):
        stands = np.isfinite(on_sole[:, foot, 0])
        ball = measure_sole(walker.body).ball_m[foot]
        assert 0.0 < on_sole[stands, foot, 0].min() < on_sole[stands, foot, 0].max() < 1.36 * ball[0]
        assert np.abs(on_sole[stands, foot, 1]).max() < 0.02
        heel = T_lab_body[:, walker.body.bodies.index(f"calcn_{side[0]}")]
        behind = stands & (on_sole[:, foot, 0] < ball[0]) & (truth.wrench[:, foot, 1] > 100)
        along = on_sole[behind, foot]
        back = heel[behind, :3, 3] + along[:, :1] * heel[behind, :3, 0] + along[:, 1:] * heel[behind, :3, 2]
        # The sole's plane lies on the floor but for the heel's landing and rise; a pitch of 20° over 30 mm: 2 mm.
        assert np.abs((back - truth.cop_lab_m[behind, foot])[:, [0, 2]]).max() < 0.008


def test_soles_repeat_with_the_seed_and_each_error_has_its_own_chance(walker):
    first, again = (press(walker, errors=SOLES["poor"], seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.pressure.vertical_n, again.pressure.vertical_n)
    without = press(walker, errors=replace(SOLES["poor"], gaps=0.0), seed=3)
    there = np.isfinite(first.pressure.vertical_n[:, 0])
    assert 0 < (~there).sum()
    np.testing.assert_array_equal(first.pressure.vertical_n[there], without.pressure.vertical_n[there])


def test_time_stamps_are_irregular_late_and_ascending(walker):
    soles = press(walker, errors=SoleErrors(offset_s=0.3, jitter_s=0.03), duration_s=20.0)
    steps = np.diff(soles.pressure.times_s)
    assert steps.min() > 0
    assert steps.std() > 0.01
    np.testing.assert_allclose(soles.pressure.times_s - soles.times_s, 0.3)


def test_gain_and_noise_have_the_stated_size(walker):
    gains = np.concatenate([press(walker, errors=SoleErrors(gain=0.05), seed=s).gain for s in range(60)])
    assert gains.std() == pytest.approx(0.05, rel=0.27)  # 120 draws: 6.5 %, four times
    noisy = press(walker, errors=SoleErrors(force_noise_n=10.0, cop_noise_m=0.004), duration_s=60.0)
    high = noisy.vertical_n > 100
    assert (noisy.pressure.vertical_n - noisy.vertical_n)[high].std() == pytest.approx(10.0, rel=0.1)
    assert (noisy.pressure.cop_foot_m - noisy.cop_foot_m)[high].std() == pytest.approx(0.004, rel=0.1)
    assert np.all(noisy.pressure.vertical_n[noisy.vertical_n == 0] == 0)


def test_limits_steps_and_missing_toes(walker):
    plain = press(walker, errors=SoleErrors(saturation_n=500.0, quantum_n=7.0, quantum_m=0.005))
    assert plain.pressure.vertical_n.max() == 500.0
    below = plain.pressure.vertical_n < 500
    np.testing.assert_allclose(np.mod(plain.pressure.vertical_n[below] + 1e-6, 7.0), 0, atol=1e-5)
    toeless = press(walker, errors=SoleErrors(toes_missing=True), rate_hz=100.0)
    share = toeless.pressure.vertical_n[toeless.vertical_n > 50] / toeless.vertical_n[toeless.vertical_n > 50]
    assert share.min() == pytest.approx(1 - TOE_SHARE)
    assert share.max() == 1.0


def test_a_stream_needs_two_samples(walker):
    with pytest.raises(InputError, match="no two samples"):
        press(walker, duration_s=0.01)
