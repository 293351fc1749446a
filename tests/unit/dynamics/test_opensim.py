import numpy as np
import pytest
from scipy.signal import butter

from gonio.errors import InputError
from gonio.kernel.dynamics.opensim import (
    _third_order_butterworth,  # the coefficients are OpenSim's formula; scipy is the oracle
    differentiate,
    interpolate_forces,
    low_pass,
    quintic_spline,
)

TIMES_S = np.arange(120) / 60.0
WAVE = np.stack([np.sin(2 * np.pi * TIMES_S), np.cos(3 * TIMES_S)], axis=1)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_the_filter_is_the_third_order_butterworth(share: float) -> None:
    numerator, denominator = _third_order_butterworth(share)
    expected = butter(3, 2 * share)
    np.testing.assert_allclose(numerator, expected[0], rtol=1e-12)
    np.testing.assert_allclose(denominator, expected[1], rtol=1e-12)


def test_each_way_takes_its_first_three_samples_over() -> None:
    """The recursion of OpenSim's Signal::LowpassIIR, written out, is the oracle."""
    b, a = _third_order_butterworth(6.0 / 60.0)

    def one_way(x: np.ndarray) -> np.ndarray:
        y = x.copy()
        for n in range(3, len(x)):
            y[n] = sum(b[k] * x[n - k] for k in range(4)) - sum(a[k] * y[n - k] for k in range(1, 4))
        return y

    times_s, filtered = low_pass(TIMES_S, WAVE, 6.0)
    count = len(TIMES_S) // 2
    padded = np.vstack([2 * WAVE[0] - WAVE[count:0:-1], WAVE, 2 * WAVE[-1] - WAVE[-2 : -2 - count : -1]])
    np.testing.assert_allclose(filtered, one_way(one_way(padded)[::-1])[::-1], atol=1e-12)
    assert times_s[count] == pytest.approx(0.0)


def test_rates_are_derivatives() -> None:
    smooth = differentiate(TIMES_S, WAVE, None)
    inner = slice(15, -15)
    np.testing.assert_allclose(smooth.velocity[inner, 0], 2 * np.pi * np.cos(2 * np.pi * TIMES_S[inner]), atol=1e-4)
    np.testing.assert_allclose(smooth.acceleration[inner, 1], -9 * np.cos(3 * TIMES_S[inner]), atol=1e-3)
    np.testing.assert_array_equal(smooth.q, WAVE)


def test_the_spline_is_natural() -> None:
    spline = quintic_spline(TIMES_S, WAVE)
    np.testing.assert_allclose(spline(TIMES_S), WAVE, atol=1e-12)
    for derivative in (3, 4):
        assert np.abs(spline(TIMES_S[[0, -1]], derivative)).max() < 1e-4


def test_uneven_times_are_put_on_the_smallest_step() -> None:
    rounded = np.round(TIMES_S, 3)
    times_s, _ = low_pass(rounded, WAVE, 6.0)
    steps = np.diff(times_s)
    np.testing.assert_allclose(steps, np.diff(rounded).min(), rtol=1e-9)


def test_the_time_range_starts_at_or_before_and_ends_at_or_before() -> None:
    smooth = differentiate(TIMES_S, WAVE, None, (0.51, 1.01))
    assert smooth.times_s[0] == pytest.approx(0.5)
    assert smooth.times_s[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("times_s", "values", "cutoff_hz", "message"),
    [
        (TIMES_S[:5], WAVE[:5], None, "can't be differentiated"),
        (TIMES_S[::-1], WAVE, None, "don't ascend"),
        (TIMES_S, np.where(np.arange(120)[:, None] == 60, np.nan, WAVE), None, "gap or an impossible value at 1.000 s"),
        (TIMES_S, WAVE, 31.0, "impossible"),
    ],
)
def test_what_can_not_be_differentiated_is_refused(
    times_s: np.ndarray, values: np.ndarray, cutoff_hz: float | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        differentiate(times_s, values, cutoff_hz)


def test_forces_that_end_before_the_motion_are_refused() -> None:
    with pytest.raises(InputError) as caught:
        interpolate_forces(TIMES_S[:60], WAVE[:60], TIMES_S)
    assert caught.value.code == "forces-too-short"
    assert "0.983 s" in caught.value.message
