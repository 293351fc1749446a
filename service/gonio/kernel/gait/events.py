"""When a foot strikes the ground and when it leaves it.

From a vertical force, where there is one: the instant at which it passes a threshold. Else from the movement, in two steps:

1. Where to look: a foot strikes near the instant at which its heel is farthest in front of the pelvis, and leaves the ground
   near the one at which its toes are farthest behind [Zeni et al. 2008, Gait & Posture 27:710-714].
2. When exactly: the heel's speed in the sagittal plane, relative to the ground, falls below a share of the walking speed at
   the strike; the toes' speed rises above one at the lift [Bruening & Ridge 2014, Gait & Posture 39:472-477].

The first step alone is early by 20 to 55 ms at the strike. The shares were chosen on the virtual laboratory and on a treadmill
recording with force plates, with the points that this package's bodies have (back of the heel, tip of the toes).
"""

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from gonio.kernel.gait.progression import Bout
from gonio.kernel.smoothing.filters import known_runs, low_pass
from gonio.records import EventTrain, FootPaths, GaitEvents

METHOD = "Zeni et al. 2008, timed by the foot's sagittal speed (Bruening & Ridge 2014)"
FORCE_METHOD = "vertical force"

CUTOFF_HZ = 7.0
"""Of the low-pass filter before the speed is taken [O'Connor et al. 2007, Gait & Posture 25:469-474]."""

STRIKE_SHARE = 0.5
LIFT_SHARE = 0.66
"""Of the walking speed."""

STRIKE_SD_S = 0.015
LIFT_SD_S = 0.012
"""Of events found from movement, against force plates and the virtual laboratory at 0.8 to 1.6 m/s."""

THRESHOLD_N = 20.0
"""Vertical force at which a foot counts as on the ground: above a plate's noise, 3 % of an adult's weight."""

FORCE_SD_S = 0.005
"""Of the instant at which the threshold is passed: the load rises by 20 N in 2 to 10 ms."""

LONGEST_BREAK_S = 0.08
SHORTEST_STANCE_S = 0.1
"""Shorter breaks of a contact, and shorter contacts, are noise."""

LEAST_STRIDE_S = 0.5
LEAST_SWING_M = 0.1
"""Someone whose feet go less far to and fro about the pelvis does not walk."""

SLOWEST_M_S = 0.1

SAME_EVENT_S = 0.15
"""Events of one kind and foot that are closer are one."""


def events_from_movement(paths: FootPaths, bouts: tuple[Bout, ...]) -> GaitEvents:
    """Find the events of both feet from where heels, toes and pelvis are; none in turns and where someone stands."""
    found: dict[str, list[list[float]]] = {"strike": [[], []], "lift": [[], []]}
    for bout in bouts:
        if bout.speed_m_s < SLOWEST_M_S:
            continue
        for foot in (0, 1):
            found["strike"][foot] += _in_bout(paths, bout, foot, "strike")
            found["lift"][foot] += _in_bout(paths, bout, foot, "lift")
    return GaitEvents(
        strikes=(_train(found["strike"][0], STRIKE_SD_S), _train(found["strike"][1], STRIKE_SD_S)),
        lifts=(_train(found["lift"][0], LIFT_SD_S), _train(found["lift"][1], LIFT_SD_S)),
    )


def events_from_force(
    vertical_n: Float[np.ndarray, "frame foot"],
    rate_hz: float,
    *,
    sensor_rate_hz: float | None = None,
    threshold_n: float = THRESHOLD_N,
) -> GaitEvents:
    """Find the events of both feet from the vertical force under each.

    Args:
        vertical_n: Upwards on the foot, N; NaN where nothing measured that foot (it may be beside the plate). A contact that
            begins or ends at such a gap, or at the recording's end, gives no event there.
        rate_hz: Frames a second.
        sensor_rate_hz: How often the force was measured, if less often: it limits how exactly events are known.
        threshold_n: From where on a foot counts as on the ground.
    """
    period_s = 1.0 / min(rate_hz, sensor_rate_hz or rate_hz)
    sd_s = float(np.hypot(FORCE_SD_S, period_s / np.sqrt(12.0)))
    strikes: list[list[float]] = [[], []]
    lifts: list[list[float]] = [[], []]
    for foot in (0, 1):
        force_n = vertical_n[:, foot]
        for first, last in _contacts(force_n > threshold_n, rate_hz):
            if first > 0 and np.isfinite(force_n[first - 1]):
                strikes[foot].append(first - 1 + _passing(force_n[first - 1], force_n[first], threshold_n))
            if last < len(force_n) - 1 and np.isfinite(force_n[last + 1]):
                lifts[foot].append(last + _passing(force_n[last], force_n[last + 1], threshold_n))
    return GaitEvents(
        strikes=(_train(strikes[0], sd_s, force=True), _train(strikes[1], sd_s, force=True)),
        lifts=(_train(lifts[0], sd_s, force=True), _train(lifts[1], sd_s, force=True)),
    )


def prefer(first: GaitEvents, second: GaitEvents, rate_hz: float) -> GaitEvents:
    """Take the events of ``first``, and from ``second`` those that ``first`` lacks."""

    def join(a: EventTrain, b: EventTrain) -> EventTrain:
        lacking = np.array([not np.any(np.abs(a.frames - f) < SAME_EVENT_S * rate_hz) for f in b.frames], dtype=bool)
        frames = np.concatenate([a.frames, b.frames[lacking]])
        order = np.argsort(frames)
        return EventTrain(
            frames=frames[order],
            sd_s=np.concatenate([a.sd_s, b.sd_s[lacking]])[order],
            from_force=np.concatenate([a.from_force, b.from_force[lacking]])[order],
        )

    return GaitEvents(
        strikes=(join(first.strikes[0], second.strikes[0]), join(first.strikes[1], second.strikes[1])),
        lifts=(join(first.lifts[0], second.lifts[0]), join(first.lifts[1], second.lifts[1])),
    )


def _in_bout(paths: FootPaths, bout: Bout, foot: int, kind: Literal["strike", "lift"]) -> list[float]:
    rate_hz = paths.timebase.rate_hz
    chosen = slice(bout.start, bout.stop)
    point_m = (paths.heel_lab_m if kind == "strike" else paths.toe_lab_m)[chosen, foot]
    cutoff_hz = min(CUTOFF_HZ, 0.4 * rate_hz)
    smooth_m = low_pass(np.concatenate([point_m, paths.pelvis_lab_m[chosen]], axis=1), rate_hz, cutoff_hz)
    point_m, pelvis_m = smooth_m[:, :3], smooth_m[:, 3:]
    ahead_m = (point_m - pelvis_m) @ bout.forward_lab
    extent_m = float(np.ptp(ahead_m))
    if extent_m < LEAST_SWING_M:
        return []
    peaks, _ = find_peaks(
        ahead_m if kind == "strike" else -ahead_m, distance=max(1, LEAST_STRIDE_S * rate_hz), prominence=0.3 * extent_m
    )
    velocity_m_s = np.gradient(point_m, axis=0) * rate_hz
    speed_m_s = np.hypot(velocity_m_s @ bout.forward_lab - bout.belt_m_s, velocity_m_s[:, 1])
    share = STRIKE_SHARE if kind == "strike" else LIFT_SHARE
    # The strike comes after the heel was farthest forward; the toes leave the ground before they are farthest back.
    before, after = (0.05, 0.2) if kind == "strike" else (0.15, 0.1)
    events: list[float] = []
    for peak in peaks:
        first, last = max(0, int(peak - before * rate_hz)), min(len(speed_m_s) - 1, int(peak + after * rate_hz))
        over = speed_m_s[first : last + 1] > share * bout.speed_m_s
        passes = np.flatnonzero(over[:-1] & ~over[1:] if kind == "strike" else ~over[:-1] & over[1:])
        if passes.size:
            k = first + int(passes[0])
            events.append(bout.start + k + _passing(speed_m_s[k], speed_m_s[k + 1], share * bout.speed_m_s))
        else:
            events.append(float(bout.start + peak))
    return events


def _contacts(loaded: np.ndarray, rate_hz: float) -> list[tuple[int, int]]:
    """List the first and last frame of each contact: short breaks closed, short contacts dropped."""
    runs = [(start, stop - 1) for _, start, stop in known_runs(np.where(loaded, 0.0, np.nan)[:, None])]
    joined: list[tuple[int, int]] = []
    for first, last in runs:
        if joined and first - joined[-1][1] - 1 < LONGEST_BREAK_S * rate_hz:
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    return [(first, last) for first, last in joined if last - first + 1 >= SHORTEST_STANCE_S * rate_hz]


def _passing(before: float, after: float, level: float) -> float:
    """Give the fraction of the way from one sample to the next at which a straight line passes a level."""
    return float(np.clip((level - before) / (after - before), 0.0, 1.0)) if after != before else 0.5


def _train(frames: list[float], sd_s: float, *, force: bool = False) -> EventTrain:
    return EventTrain(
        frames=np.array(sorted(frames), dtype=float),
        sd_s=np.full(len(frames), sd_s),
        from_force=np.full(len(frames), force),
    )
