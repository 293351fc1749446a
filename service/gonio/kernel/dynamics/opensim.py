"""Kinematics made ready for inverse dynamics in the way of OpenSim's InverseDynamicsTool, to the last digit.

Positions are padded at both ends by their own reflection, put on a uniform clock where theirs is not, low-passed forwards
and backwards, and differentiated as quintic splines; forces are interpolated by cubic ones. That these choices (a third
order filter without correction for the double pass, the reflection) are not the only ones possible is not the point: whoever
compares with a result of OpenSim's gets the same number.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline

from gonio.errors import InputError

LARGEST = 1e9
"""No angle, place or force is as large (rad, m, N, Nm): what is comes from a damaged file, and would overflow in a spline."""

_UNIFORM_S = 2.3e-16  # OpenSim compares the mean with the smallest step to within its machine precision


@dataclass(frozen=True)
class SmoothMotion:
    """Coordinates and their rates at the same times."""

    times_s: Float[np.ndarray, " frame"]
    q: Float[np.ndarray, "frame coordinate"]
    velocity: Float[np.ndarray, "frame coordinate"]
    acceleration: Float[np.ndarray, "frame coordinate"]


def differentiate(
    times_s: Float[np.ndarray, " frame"],
    q: Float[np.ndarray, "frame coordinate"],
    cutoff_hz: float | None,
    time_range_s: tuple[float, float] = (-np.inf, np.inf),
) -> SmoothMotion:
    """Filter and differentiate a motion, all of it, and give the part in the time range.

    Accelerations are distorted where a filter begins and ends: give more of the motion than the time range.

    Args:
        times_s: Ascending.
        q: rad and m, without NaN.
        cutoff_hz: Of the low-pass; None leaves the motion as it is.
        time_range_s: As the tool has it: from the last sample at or before its start to the last at or before its end.

    Raises:
        InputError: fewer than six samples, or NaN, or a cutoff above half the rate (``cutoff-impossible``).
    """
    if len(times_s) < 6 or np.any(np.diff(times_s) <= 0):
        raise InputError(
            f"A motion of {len(times_s)} samples, or with times that don't ascend, can't be differentiated.",
            hint="Give at least six samples in ascending order of time.",
        )
    known = (np.abs(q) < LARGEST).all(axis=1)  # false for NaN
    if not known.all():
        raise InputError(
            f"The motion has a gap or an impossible value at {times_s[np.argmin(known)]:.3f} s.",
            hint="Fill the gap before: the filter works on all of the motion.",
        )
    # What the filter pads at the ends must not become part of the result.
    start_s, end_s = max(time_range_s[0], times_s[0]), min(time_range_s[1], times_s[-1])
    if cutoff_hz is not None:
        times_s, q = low_pass(times_s, q, cutoff_hz)
    spline = quintic_spline(times_s, q)
    slack_s = 1e-9 * (times_s[-1] - times_s[0])  # resampled times carry rounding
    first = max(int(np.searchsorted(times_s, start_s + slack_s, side="right")) - 1, 0)
    last = max(int(np.searchsorted(times_s, end_s + slack_s, side="right")) - 1, 0)
    chosen = times_s[first : last + 1]
    return SmoothMotion(chosen, q[first : last + 1], spline(chosen, 1), spline(chosen, 2))


def low_pass(
    times_s: Float[np.ndarray, " frame"], values: Float[np.ndarray, "frame column"], cutoff_hz: float
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "time column"]]:
    """Pad by half the length at both ends, resample to the smallest step if the steps differ, and filter both ways.

    Without NaN. The result is longer than what was given: it keeps the padding.

    Raises:
        InputError: a cutoff above half the rate (``cutoff-impossible``).
    """
    times_s, values = _pad(times_s, values, len(times_s) // 2)
    step_s = float(np.diff(times_s).min())
    if (times_s[-1] - times_s[0]) / (len(times_s) - 1) - step_s > _UNIFORM_S:
        uniform = times_s[0] + step_s * np.arange(int(np.floor((times_s[-1] - times_s[0]) / step_s + 1e-9)) + 1)
        times_s, values = uniform, quintic_spline(times_s, values)(uniform)
    if cutoff_hz >= 0.5 / step_s:
        raise InputError(
            f"A cutoff of {cutoff_hz} Hz is impossible at {1 / step_s:.1f} samples a second.",
            hint="Give a lower one, or a motion of a higher rate.",
            code="cutoff-impossible",
        )
    return times_s, _both_ways(values, *_third_order_butterworth(cutoff_hz * step_s))


def quintic_spline(times_s: Float[np.ndarray, " time"], values: Float[np.ndarray, "time column"]) -> BSpline:
    """Interpolate by the natural spline of degree 5: its third and fourth derivatives vanish at the ends."""
    flat = np.zeros(values.shape[1])
    ends = [(3, flat), (4, flat)]
    return make_interp_spline(times_s, values, k=5, bc_type=(ends, ends))  # pyright: ignore[reportCallIssue, reportArgumentType] - its stubs


def interpolate_forces(
    times_s: Float[np.ndarray, " sample"], values: Float[np.ndarray, "sample column"], at_s: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "frame column"]:
    """Interpolate forces by natural cubic splines.

    Args:
        times_s: Ascending.
        values: Forces, points and moments, N, m and Nm, without NaN.
        at_s: The motion's times; they may lie beyond the forces' by a sample and a half.

    Raises:
        InputError: the forces begin after the motion or end before it, or hold a NaN.
    """
    known = (np.abs(values) < LARGEST).all(axis=1)  # false for NaN
    if not known.all():
        raise InputError(
            f"The forces have a gap or an impossible value at {times_s[np.argmin(known)]:.3f} s.",
            hint="Write 0 where nothing pushes, and fill what was lost.",
        )
    margin_s = 1.5 * float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if len(times_s) < 2 or at_s[0] < times_s[0] - margin_s or at_s[-1] > times_s[-1] + margin_s:
        raise InputError(
            f"The forces cover {times_s[0]:.3f} to {times_s[-1]:.3f} s, the motion {at_s[0]:.3f} to {at_s[-1]:.3f} s.",
            hint="Give forces for the whole time range, or a shorter range.",
            code="forces-too-short",
        )
    return CubicSpline(times_s, values, bc_type="natural")(at_s)


def _pad(times_s: np.ndarray, values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Reflect both ends through their end points."""
    before = slice(count, 0, -1)
    after = slice(-2, -2 - count, -1)
    return (
        np.r_[2 * times_s[0] - times_s[before], times_s, 2 * times_s[-1] - times_s[after]],
        np.vstack([2 * values[0] - values[before], values, 2 * values[-1] - values[after]]),
    )


def _third_order_butterworth(cutoff_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Give the coefficients of the third-order Butterworth low-pass by the bilinear transform."""
    w = np.tan(np.pi * cutoff_share)
    scale = (w + 1) * (w * w + w + 1)
    numerator = w**3 * np.array([1.0, 3.0, 3.0, 1.0]) / scale
    denominator = np.array(
        [
            1.0,
            (3 * w**3 + 2 * w**2 - 2 * w - 3) / scale,
            (3 * w**3 - 2 * w**2 - 2 * w + 3) / scale,
            (w - 1) * (w * w - w + 1) / scale,
        ]
    )
    return numerator, denominator


def _both_ways(values: np.ndarray, numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Filter forwards and then backwards; each way starts with three samples taken over as they are."""
    from scipy.signal import lfilter  # slow to load, and a worker starts without it

    for _ in range(2):
        filtered = values.copy()
        # lfilter's state that makes the first three outputs equal the inputs, for y[n] = Σ b x[n−k] − Σ a y[n−k].
        state = np.zeros((3, values.shape[1]))
        for k in range(3):
            for m in range(k + 1, 4):
                state[k] += (numerator[m] - denominator[m]) * values[2 - (m - k - 1)]
        filtered[3:], _ = lfilter(numerator, denominator, values[3:], axis=0, zi=state)
        values = filtered[::-1]
    return values
