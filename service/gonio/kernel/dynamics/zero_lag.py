"""Kinematics made ready for inverse dynamics in gonio's own way: what OpenSim's way would be without its history.

The low-pass has the cutoff that was asked for (OpenSim's, run twice without correction, is 3 dB down at 0.87 of it and 6 dB
at its cutoff), a clock whose times were rounded stays uniform (OpenSim resamples it at the smallest step), and a gap stays
a gap. Rates come from quintic splines, as in OpenSim. See :mod:`gonio.kernel.dynamics.opensim` for OpenSim's own.
"""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.kernel.dynamics.opensim import SmoothMotion, quintic_spline
from gonio.kernel.smoothing.filters import known_runs, low_pass

FEWEST_FRAMES = 10
"""A shorter run between gaps can't be filtered (see :func:`gonio.kernel.smoothing.filters.low_pass`), and has no rates."""

LARGEST_ROUNDING = 0.25
"""How far a step may be from the median step, as a share of it: times in milliseconds at 250 Hz, and no lost frame."""


def differentiate(
    times_s: Float[np.ndarray, " frame"],
    q: Float[np.ndarray, "frame coordinate"],
    cutoff_hz: float | None,
    time_range_s: tuple[float, float] = (-np.inf, np.inf),
) -> SmoothMotion:
    """Filter and differentiate a motion, all of it, and give the frames in the time range.

    Accelerations are distorted where a filter begins and ends: give more of the motion than the time range.

    Args:
        times_s: Ascending and uniform, up to rounding.
        q: rad and m. NaN is a gap: each coordinate's runs of at least ten known frames are taken for themselves, shorter
            ones become NaN.
        cutoff_hz: Where the filter is 3 dB down; None leaves the motion as it is.
        time_range_s: Closed, with a thousandth of a step of slack.

    Raises:
        InputError: times that are not uniform, too few of them, none in the time range, or a cutoff above half the rate
            (``cutoff-impossible``).
    """
    times_s, rate_hz = uniform_times(times_s)
    slack_s = 1e-3 / rate_hz
    chosen = (times_s >= time_range_s[0] - slack_s) & (times_s <= time_range_s[1] + slack_s)
    if not np.any(chosen):
        raise InputError(
            f"The motion runs from {times_s[0]:.3f} to {times_s[-1]:.3f} s: it has no frame between {time_range_s[0]:g} "
            f"and {time_range_s[1]:g} s.",
            hint="Change the time range.",
        )
    smooth = q if cutoff_hz is None else low_pass(q, rate_hz, cutoff_hz)
    found = np.full((3, *q.shape), np.nan)
    for members, start, stop in known_runs(q):
        if stop - start >= FEWEST_FRAMES:
            run, run_s = smooth[start:stop, members], times_s[start:stop]
            spline = quintic_spline(run_s, run)
            found[:, start:stop, members] = run, spline(run_s, 1), spline(run_s, 2)
    return SmoothMotion(times_s[chosen], *found[:, chosen])


def uniform_times(times_s: Float[np.ndarray, " frame"]) -> tuple[Float[np.ndarray, " frame"], float]:
    """Undo the rounding of a uniform clock by least squares; give its times and its rate in Hz.

    Raises:
        InputError: fewer than :data:`FEWEST_FRAMES` times, or steps that differ by more than rounding.
    """
    steps_s = np.diff(times_s)
    if len(times_s) < FEWEST_FRAMES:
        raise InputError(
            f"A motion of {len(times_s)} samples can't be differentiated.", hint=f"Give at least {FEWEST_FRAMES}."
        )
    usual_s = float(np.median(steps_s))
    if not np.all(np.abs(steps_s - usual_s) <= LARGEST_ROUNDING * usual_s):
        worst = int(np.argmax(np.abs(steps_s - usual_s)))
        raise InputError(
            f"The clock is not uniform: its steps are {usual_s:.4f} s, but {steps_s[worst]:.4f} s at {times_s[worst]:.3f} s.",
            hint="Resample the motion, with NaN for frames that were lost.",
        )
    step_s, start_s = np.polynomial.polynomial.polyfit(np.arange(len(times_s)), times_s, 1)[::-1]
    return start_s + step_s * np.arange(len(times_s)), 1.0 / float(step_s)
