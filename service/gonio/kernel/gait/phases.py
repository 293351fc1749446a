"""The phases of a gait cycle: loading, mid-stance, push-off (from heel-off to toe-off) and swing.

Loading ends when the other foot leaves the ground, mid-stance when the heel rises, push-off with toe-off [Perry & Burnfield
2010, Gait Analysis, ch. 2]. In stance the ground therefore touches heel, whole sole and forefoot one after the other.
"""

import itertools

import numpy as np

from gonio.kernel.gait.progression import Bout
from gonio.records import FootPaths, GaitCycle

HEEL_RISE_M = 0.015
"""The heel has left the ground when it is this much above where it stood: three times what a fitted heel bobs while flat."""

PHASES = ("loading", "mid-stance", "push-off", "swing")


def find_heel_off(paths: FootPaths, foot: int, strike_frame: float, lift_frame: float) -> float:
    """Give the frame, with a fraction, at which the heel rises for good before a toe-off; NaN if it was not seen to.

    The heel stands at its median height over the second fifth of stance.
    """
    if not np.isfinite(strike_frame + lift_frame):
        return np.nan
    stance = lift_frame - strike_frame
    height_m = paths.heel_lab_m[:, foot, 1]
    flat = height_m[int(np.ceil(strike_frame + 0.2 * stance)) : int(strike_frame + 0.4 * stance) + 1]
    last = int(lift_frame)
    first = int(np.ceil(strike_frame + 0.2 * stance))
    window = height_m[first : last + 1]
    if flat.size == 0 or not np.isfinite(window).all():
        return np.nan
    level_m = float(np.median(flat)) + HEEL_RISE_M
    low = np.flatnonzero(window <= level_m)
    if low.size == 0 or low[-1] == len(window) - 1:
        return np.nan
    k = int(low[-1])
    return first + k + float((level_m - window[k]) / (window[k + 1] - window[k]))


def phase_bounds(cycle: GaitCycle) -> dict[str, tuple[float, float]]:
    """Give where each phase of a cycle begins and ends, per cent; NaN where the event that bounds it was not seen."""
    marks = [
        0.0,
        cycle.percent(cycle.other_lift_frame),
        cycle.percent(cycle.heel_off_frame),
        cycle.percent(cycle.lift_frame),
        100.0,
    ]
    return dict(zip(PHASES, itertools.pairwise(marks), strict=True))


def bout_at(bouts: tuple[Bout, ...], frame: float) -> Bout | None:
    """Give the bout of straight walking that a frame lies in."""
    return next((b for b in bouts if b.start <= frame <= b.stop - 1), None)
