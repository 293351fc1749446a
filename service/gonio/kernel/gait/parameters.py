"""Spatio-temporal parameters of a walk: how fast, how far, how wide, how long, how even.

Lengths are those on the ground: on a treadmill the belt's way counts. Step length and width are measured between the heels at
their own initial contacts, along and across the direction of progression [Perry & Burnfield 2010; Huxham et al. 2006, Gait &
Posture 23:159-163].
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from gonio.kernel.gait.phases import bout_at
from gonio.kernel.gait.progression import Bout
from gonio.records import FEET, FootPaths, GaitCycle, GaitEvents, Measure

ORDER = (
    "speed",
    "cadence",
    "step length",
    "stride length",
    "step width",
    "step time",
    "stride time",
    "stance",
    "single support",
    "double support",
)

LONGEST_STEP_S = 1.5
"""Contacts of the two feet that are farther apart are no step."""


def measure_gait(
    events: GaitEvents, cycles: Sequence[GaitCycle], paths: FootPaths, bouts: tuple[Bout, ...]
) -> tuple[Measure, ...]:
    """Measure a walk, in the order of ``ORDER``; a parameter without a single value is left out."""
    kept = [c for c in cycles if not c.left_out]
    found = [
        *_of_steps(events, paths, bouts),
        *_of_strides(kept, paths, bouts),
        *_of_times(kept, paths.timebase.rate_hz),
    ]
    return tuple(sorted((m for m in found if m.values.size), key=lambda m: ORDER.index(m.name)))


def symmetry_index_percent(right: float, left: float) -> float:
    """Give 100 |R − L| / (½ (R + L)): 0 for equal sides [Robinson et al. 1987, J Manipulative Physiol Ther 10:172-176]."""
    total = 0.5 * (right + left)
    return 100.0 * abs(right - left) / total if total > 0 else np.nan


def _of_steps(events: GaitEvents, paths: FootPaths, bouts: tuple[Bout, ...]) -> list[Measure]:
    """A step is the foot's whose contact ends it."""
    rate_hz = paths.timebase.rate_hz
    contacts = sorted((float(f), foot) for foot in (0, 1) for f in events.strikes[foot].frames)
    length: list[list[float]] = [[], []]
    seconds: list[list[float]] = [[], []]
    width: list[float] = []
    for (before, other), (after, foot) in itertools.pairwise(contacts):
        bout = bout_at(bouts, before)
        if other == foot or bout is None or bout is not bout_at(bouts, after):
            continue
        if after - before > LONGEST_STEP_S * rate_hz:
            continue
        along_m = bout.along(paths.heel_lab_m, rate_hz)
        rightwards_m = bout.rightwards(paths.heel_lab_m)
        across_m = _at(rightwards_m[:, foot], after) - _at(rightwards_m[:, other], before)
        length[foot].append(_at(along_m[:, foot], after) - _at(along_m[:, other], before))
        seconds[foot].append((after - before) / rate_hz)
        width.append(across_m if foot == 0 else -across_m)
    every_s = np.array(seconds[0] + seconds[1])
    return [
        Measure(name="cadence", side="both", unit="steps/min", values=60.0 / every_s),
        *(Measure(name="step length", side=FEET[f], unit="m", values=np.array(length[f])) for f in (0, 1)),
        *(Measure(name="step time", side=FEET[f], unit="s", values=np.array(seconds[f])) for f in (0, 1)),
        Measure(name="step width", side="both", unit="m", values=np.array(width)),
    ]


def _of_strides(cycles: Sequence[GaitCycle], paths: FootPaths, bouts: tuple[Bout, ...]) -> list[Measure]:
    rate_hz = paths.timebase.rate_hz
    length: list[list[float]] = [[], []]
    speed: list[float] = []
    for cycle in cycles:
        bout = bout_at(bouts, cycle.start_frame)
        if bout is None:
            continue
        along_m = bout.along(paths.heel_lab_m[:, cycle.foot], rate_hz)
        way_m = _at(along_m, cycle.end_frame) - _at(along_m, cycle.start_frame)
        length[cycle.foot].append(way_m)
        speed.append(way_m * rate_hz / (cycle.end_frame - cycle.start_frame))
    return [
        Measure(name="speed", side="both", unit="m/s", values=np.array(speed)),
        *(Measure(name="stride length", side=FEET[f], unit="m", values=np.array(length[f])) for f in (0, 1)),
    ]


def _of_times(cycles: Sequence[GaitCycle], rate_hz: float) -> list[Measure]:
    def each(foot: int, of: Callable[[GaitCycle], float]) -> np.ndarray:
        values = np.array([of(c) for c in cycles if c.foot == foot], dtype=float)
        return values[np.isfinite(values)]

    def stride_s(c: GaitCycle) -> float:
        return (c.end_frame - c.start_frame) / rate_hz

    def stance(c: GaitCycle) -> float:
        return c.percent(c.lift_frame)

    def double_support(c: GaitCycle) -> float:
        # From the own contact to the other's toe-off, and from the other's contact to the own toe-off.
        return c.percent(c.other_lift_frame) + c.percent(c.lift_frame) - c.percent(c.other_strike_frame)

    def single_support(c: GaitCycle) -> float:
        return c.percent(c.other_strike_frame) - c.percent(c.other_lift_frame)

    shares = (
        ("stride time", "s", stride_s),
        ("stance", "% of cycle", stance),
        ("single support", "% of cycle", single_support),
        ("double support", "% of cycle", double_support),
    )
    return [
        Measure(name=name, side=FEET[foot], unit=unit, values=each(foot, of))
        for name, unit, of in shares
        for foot in (0, 1)
    ]


def _at(values: np.ndarray, frame: float) -> float:
    """Give a value between frames."""
    return float(np.interp(frame, np.arange(len(values)), values))
