import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.smoothing.filters import low_pass, median_filter, median_window


@pytest.mark.parametrize(("rate_hz", "frames"), [(30, 3), (60, 5), (120, 9), (240, 19)])
def test_the_window_is_the_same_in_time_at_any_rate(rate_hz: float, frames: int) -> None:
    assert median_window(rate_hz) == frames


def test_median_removes_a_burst_and_keeps_a_trend() -> None:
    trend = np.linspace(0, 1, 40)[:, None] * np.array([1.0, -2.0, 3.0])
    spiked = trend.copy()
    spiked[[10, 11]] += 5.0
    filtered = median_filter(spiked, 5)
    np.testing.assert_allclose(filtered[14:], trend[14:], atol=1e-12)  # the ends of a trend stay where they are
    assert np.abs(filtered - trend).max() < 0.2


def test_median_is_the_brute_force_median() -> None:
    values = np.random.default_rng(6).normal(size=(50, 3))
    values[[3, 4, 20, 48], 1] = np.nan
    filtered = median_filter(values, 7)
    for frame in range(50):
        reach = min(3, frame, 49 - frame)
        window = values[frame - reach : frame + reach + 1]
        expected = np.where(np.isnan(values[frame]), np.nan, np.nanmedian(window, axis=0))
        np.testing.assert_allclose(filtered[frame], expected)


def test_even_window_is_refused() -> None:
    with pytest.raises(InputError, match="no centre"):
        median_filter(np.zeros((5, 1)), 4)


def test_low_pass_is_three_decibels_down_at_the_cutoff_and_has_no_lag() -> None:
    time_s = np.arange(1200) / 120.0
    for frequency_hz, gain in ((1.0, 1.0), (6.0, np.sqrt(0.5)), (24.0, 0.0)):
        wave = np.sin(2 * np.pi * frequency_hz * time_s)[:, None]
        inner = slice(240, -240)
        passed = low_pass(wave, 120.0, 6.0)[inner]
        np.testing.assert_allclose(passed, gain * wave[inner], atol=0.01)


def test_gaps_stay_gaps_and_do_not_reach_over() -> None:
    values = np.random.default_rng(7).normal(size=(200, 4))
    values[80:90, 2] = np.nan
    filtered = low_pass(values, 60.0, 6.0)
    assert np.array_equal(np.isnan(filtered), np.isnan(values))
    np.testing.assert_allclose(filtered[:80, 2], low_pass(values[:80, 2:3], 60.0, 6.0)[:, 0])
    np.testing.assert_array_equal(low_pass(values[:9], 60.0, 6.0), values[:9])  # too short to filter: untouched


def test_impossible_cutoff_is_refused() -> None:
    with pytest.raises(InputError, match="impossible"):
        low_pass(np.zeros((50, 1)), 10.0, 6.0)
