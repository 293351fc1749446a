"""Gait cycles: cut at the initial contacts, brought to 101 points, averaged; those that are unlike the others are named."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.kernel.gait.phases import bout_at, find_heel_off
from gonio.kernel.gait.progression import Bout
from gonio.records import CYCLE_POINTS, FEET, FootPaths, GaitCycle, GaitEvents

SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.5, 3.0
"""Between two contacts of one foot; what is shorter or longer lacks a contact or has one too many, or is a halt."""

LEAST_TO_COMPARE = 3
"""With fewer cycles of a foot, none can be told to be the odd one."""

ODD_SPREADS = 4.0
ODD_DURATION = 0.15
ODD_CURVE = 8.0
"""A cycle is odd if it is both this many robust standard deviations and this much (a share; degrees) off the median cycle."""

LARGEST_GAP = 0.1
"""A cycle with a larger share of unknown values does not count."""


class Average(NamedTuple):
    """Mean and standard deviation between cycles at each of the 101 points; NaN where no, or only one, cycle is known."""

    mean: Float[np.ndarray, " point"]
    sd: Float[np.ndarray, " point"]
    cycles: int


def cut_cycles(events: GaitEvents, paths: FootPaths, bouts: tuple[Bout, ...]) -> tuple[GaitCycle, ...]:
    """List the full cycles of both feet within straight walking, by foot and time; none if no foot struck twice."""
    rate_hz = paths.timebase.rate_hz
    cycles: list[GaitCycle] = []
    for foot in range(len(FEET)):
        own, other = events.strikes[foot].frames, 1 - foot
        for start, end in itertools.pairwise(own):
            bout = bout_at(bouts, start)
            if not SHORTEST_CYCLE_S * rate_hz <= end - start <= LONGEST_CYCLE_S * rate_hz:
                continue
            if bout is None or bout is not bout_at(bouts, end):
                continue
            lift = _first_between(events.lifts[foot].frames, start, end)
            cycles.append(
                GaitCycle(
                    foot=foot,
                    start_frame=float(start),
                    other_lift_frame=_first_between(events.lifts[other].frames, start, end),
                    heel_off_frame=find_heel_off(paths, foot, start, lift),
                    other_strike_frame=_first_between(events.strikes[other].frames, start, end),
                    lift_frame=lift,
                    end_frame=float(end),
                )
            )
    return tuple(cycles)


def normalise(values: Float[np.ndarray, " frame *rest"], cycle: GaitCycle) -> Float[np.ndarray, " point *rest"]:
    """Give the values at each per cent of a cycle, on straight lines between the frames; NaN beside a NaN.

    A straight line cuts the knee's sharpest bend, 10⁴ °/s², by 0.13° at 100 frames a second.
    """
    frames = np.linspace(cycle.start_frame, cycle.end_frame, CYCLE_POINTS)
    before = np.clip(np.floor(frames).astype(int), 0, len(values) - 2)
    share = (frames - before).reshape(-1, *[1] * (values.ndim - 1))
    # Exactly on a frame, its neighbour does not matter, even if it is not known.
    left = np.where(share == 1.0, 0.0, (1.0 - share) * values[before])
    return left + np.where(share == 0.0, 0.0, share * values[before + 1])


def average(curves: Float[np.ndarray, "cycle point"]) -> Average:
    """Average curves point by point, over the cycles that are known there."""
    known = np.isfinite(curves)
    count = known.sum(axis=0)
    filled = np.where(known, curves, 0.0)
    mean = np.where(count > 0, filled.sum(axis=0) / np.maximum(count, 1), np.nan)
    square = np.where(known, (curves - mean) ** 2, 0.0).sum(axis=0)
    return Average(mean, np.where(count > 1, np.sqrt(square / np.maximum(count - 1, 1)), np.nan), len(curves))


def leave_out_odd(
    cycles: Sequence[GaitCycle], curves: dict[str, Float[np.ndarray, "cycle point"]], rate_hz: float
) -> tuple[GaitCycle, ...]:
    """Name, in ``left_out``, the cycles that are unlike the others of their foot, with the reason.

    Args:
        cycles: Cycles of both feet.
        curves: By what they show ("knee flexion"), degrees, the cycles in the same order.
        rate_hz: Frames a second.
    """
    reasons = [""] * len(cycles)
    for foot, side in enumerate(FEET):
        own = [i for i, c in enumerate(cycles) if c.foot == foot]
        for name, values in curves.items():
            for i in own:
                if np.mean(np.isnan(values[i])) > LARGEST_GAP:
                    reasons[i] = (
                        reasons[i] or f"{name} is not known in {100 * np.mean(np.isnan(values[i])):.0f} % of it"
                    )
        usable = [i for i in own if not reasons[i]]
        if len(usable) < LEAST_TO_COMPARE:
            continue
        seconds = np.array([(cycles[i].end_frame - cycles[i].start_frame) / rate_hz for i in usable])
        usual_s = float(np.median(seconds))
        for i, off_s in zip(usable, _odd(seconds - usual_s, ODD_DURATION * usual_s), strict=True):
            if np.isfinite(off_s):
                reasons[i] = f"it takes {usual_s + off_s:.2f} s, {side} cycles usually {usual_s:.2f} s"
        for name, values in curves.items():
            deviation = values[usable] - np.nanmedian(values[usable], axis=0)
            distance = np.sqrt(np.nanmean(deviation**2, axis=1))
            for i, far in zip(usable, _odd(distance, ODD_CURVE), strict=True):
                if np.isfinite(far):
                    reasons[i] = reasons[i] or f"its {name} is {far:.0f}° off the other cycles"
    return tuple(replace(c, left_out=reason) for c, reason in zip(cycles, reasons, strict=True))


def _odd(deviation: Float[np.ndarray, " item"], least: float) -> Float[np.ndarray, " item"]:
    """Keep the deviations that are large against their spread and in themselves; NaN for the others."""
    spread = 1.4826 * np.median(np.abs(deviation - np.median(deviation)))
    limit = max(least, ODD_SPREADS * float(spread))
    return np.where(np.abs(deviation) > limit, deviation, np.nan)


def _first_between(frames: Float[np.ndarray, " event"], start: float, end: float) -> float:
    inside = frames[(frames > start) & (frames < end)]
    return float(inside[0]) if inside.size else np.nan
