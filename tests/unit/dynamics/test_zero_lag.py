import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.dynamics.zero_lag import differentiate, uniform_times

RATE_HZ = 60.0
TIMES_S = np.arange(240) / RATE_HZ


def sine(frequency_hz: float) -> np.ndarray:
    return np.sin(2 * np.pi * frequency_hz * TIMES_S)[:, None]


def test_rates_are_derivatives() -> None:
    smooth = differentiate(TIMES_S, sine(1.0), None)
    inner = slice(15, -15)
    w = 2 * np.pi
    np.testing.assert_array_equal(smooth.q, sine(1.0))
    np.testing.assert_allclose(smooth.velocity[inner, 0], w * np.cos(w * TIMES_S[inner]), atol=1e-4)
    np.testing.assert_allclose(smooth.acceleration[inner, 0], -w * w * np.sin(w * TIMES_S[inner]), atol=1e-2)


def test_the_cutoff_is_where_3_db_are_lost() -> None:
    middle = slice(60, -60)  # whole periods of both
    for frequency_hz, gain in ((6.0, 2**-0.5), (1.0, 1.0)):
        wave, smooth = sine(frequency_hz)[middle], differentiate(TIMES_S, sine(frequency_hz), 6.0).q[middle]
        # The bilinear transform bends frequencies: (tan 18° / tan 22.4°)⁴ = 0.386 instead of 0.414, so 0.722 and not 0.707.
        assert (smooth * wave).sum() / (wave * wave).sum() == pytest.approx(gain, rel=0.025)


def test_what_lies_beyond_the_time_range_still_counts() -> None:
    whole = differentiate(TIMES_S, sine(1.0), 6.0)
    part = differentiate(TIMES_S, sine(1.0), 6.0, (1.0, 2.0))
    assert part.times_s[[0, -1]].tolist() == pytest.approx([1.0, 2.0])
    np.testing.assert_allclose(part.acceleration, whole.acceleration[60:121], atol=1e-12)


def test_times_rounded_to_milliseconds_are_uniform_again() -> None:
    times_s, rate_hz = uniform_times(np.round(TIMES_S, 3))
    assert rate_hz == pytest.approx(RATE_HZ, rel=1e-5)
    np.testing.assert_allclose(times_s, TIMES_S, atol=2e-5)
    # Rounding of 0.5 ms in the times would be an error of 0.5 ms · 2π Hz · (2π · 60 Hz)² = 450 rad/s² in the raw values.
    smooth = differentiate(np.round(TIMES_S, 3), sine(1.0), None)
    expected = -((2 * np.pi) ** 2) * np.sin(2 * np.pi * TIMES_S)
    np.testing.assert_allclose(smooth.acceleration[15:-15, 0], expected[15:-15], atol=1e-2)


def test_a_gap_stays_one_and_each_run_is_taken_for_itself() -> None:
    q = np.hstack([sine(1.0), sine(1.0)])
    q[100:105, 0] = np.nan
    q[112:, 0] = np.nan
    smooth = differentiate(TIMES_S, q, 6.0)
    for found in (smooth.q, smooth.velocity, smooth.acceleration):
        assert np.isnan(found[100:, 0]).all()  # the seven frames from 105 on are too few
        assert np.isfinite(found[:100]).all()
        assert np.isfinite(found[:, 1]).all()
    alone = differentiate(TIMES_S[:100], q[:100], 6.0)
    np.testing.assert_allclose(smooth.acceleration[:100, 0], alone.acceleration[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("times_s", "cutoff_hz", "time_range_s", "message"),
    [
        (TIMES_S[:9], None, (-np.inf, np.inf), "motion of 9 samples"),
        (
            np.delete(TIMES_S, 50),
            None,
            (-np.inf, np.inf),
            "not uniform: its steps are 0.0167 s, but 0.0333 s at 0.817 s",
        ),
        (TIMES_S[::-1], None, (-np.inf, np.inf), "not uniform"),
        (TIMES_S, 31.0, (-np.inf, np.inf), "cutoff of 31.0 Hz is impossible"),
        (TIMES_S, 6.0, (7.0, 8.0), "no frame between 7 and 8 s"),
    ],
)
def test_what_can_not_be_differentiated_is_refused(
    times_s: np.ndarray, cutoff_hz: float | None, time_range_s: tuple[float, float], message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        differentiate(times_s, np.zeros((len(times_s), 1)), cutoff_hz, time_range_s)
    assert caught.value.hint
