"""When a foot strikes the ground and when it leaves it.

From a vertical force, where there is one: the instant at which it passes a threshold. Else from the movement, in two steps:

1. Where to look: a foot strikes near the instant at which its heel is farthest in front of the pelvis, and leaves the ground
   near the one at which its toes are farthest behind [Zeni et al. 2008, Gait & Posture 27:710-714].
2. When exactly. Strike: the middle of the foot sinks fastest; that is late by 16 ms on average, which is taken off [O'Connor
   et al. 2007, Gait & Posture 25:469-474]. Lift: the toes' speed in the sagittal plane, relative to the ground, rises above a
   share of the walking speed [Bruening & Ridge 2014, Gait & Posture 39:472-477].

The first step alone is 20 to 60 ms early at the strike. Against force plates and the virtual laboratory the two are off by -17
to +13 ms at the strike and by -7 to +11 ms at the lift, by recording.
"""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import find_peaks
from scipy.special import ndtr

from gonio.kernel.gait.progression import Bout
from gonio.kernel.smoothing.filters import low_pass, runs
from gonio.records import EventTrain, FootPaths, GaitEvents, Timebase

METHOD = "O'Connor et al. 2007 near Zeni et al. 2008 (contact), Bruening & Ridge 2014 (toe-off)"
FORCE_METHOD = "vertical force"

CUTOFF_HZ = 7.0
"""Of the low-pass filter before velocities are taken [O'Connor et al. 2007]."""

TROUGH_LATE_S = 0.016
"""By how much the trough of the foot's vertical velocity comes after the contact [O'Connor et al. 2007: 16 ± 15 ms]."""

LIFT_SHARE = 0.66
"""Of the walking speed; chosen on the virtual laboratory and on a treadmill recording with force plates."""

STRIKE_SD_S = 0.015
LIFT_SD_S = 0.012
"""Of events found from movement."""

THRESHOLD_N = 20.0
"""Vertical force at which a foot counts as on the ground: above a plate's noise, 3 % of an adult's weight."""

FORCE_SD_S = 0.005
"""Of the instant at which the threshold is passed: the load rises by 20 N in 2 to 10 ms."""

CLOSE_S = 0.02
"""Between samples that are so close, a load rises on a straight line; in 50 ms it may be half the body's weight."""

LONGEST_BREAK_S = 0.08
SHORTEST_STANCE_S = 0.1
"""Shorter breaks of a contact, and shorter contacts, are noise."""

LEAST_STRIDE_S = 0.5
LEAST_SWING_M = 0.1
"""Someone whose feet go less far to and fro about the pelvis does not walk."""

SLOWEST_M_S = 0.1

LEAST_AGREEMENT = 0.01
"""A movement that puts an event into the interval that a force allows with less than this chance is wrong."""

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
    times_s: Float[np.ndarray, " sample"],
    vertical_n: Float[np.ndarray, "sample foot"],
    timebase: Timebase,
    threshold_n: float = THRESHOLD_N,
) -> GaitEvents:
    """Find the events of both feet from the vertical force under each.

    Between a bare and a loaded sample that are close, the force passes the threshold on a straight line. Where samples are
    farther apart the load may begin anywhere between, and the middle is taken.

    Args:
        times_s: Of the samples, ascending, at any rate.
        vertical_n: Upwards on the foot, N; NaN where nothing measured that foot (it may be beside the plate). A contact that
            begins or ends at such a gap, or at the recording's end, gives no event there.
        timebase: Of the frames that the events are counted in.
        threshold_n: From where on a foot counts as on the ground.
    """
    trains: dict[str, list[EventTrain]] = {"strike": [], "lift": []}
    for foot in (0, 1):
        force_n = vertical_n[:, foot]
        contacts = _contacts(times_s, force_n > threshold_n)
        edges = {
            "strike": [(first - 1, first) for first, _ in contacts if first > 0],
            "lift": [(last, last + 1) for _, last in contacts if last < len(force_n) - 1],
        }
        for kind, pairs in edges.items():
            seen = [(k, j) for k, j in pairs if np.isfinite(force_n[k] + force_n[j])]
            gap_s = np.array([times_s[j] - times_s[k] for k, j in seen])
            share = [_passing(force_n[k], force_n[j], threshold_n) for k, j in seen]
            share = np.where(gap_s > CLOSE_S, 0.5, share)
            at_s = np.array([times_s[k] for k, _ in seen]) + share * gap_s
            trains[kind].append(
                EventTrain(
                    frames=(at_s - timebase.start_s) * timebase.rate_hz,
                    sd_s=np.hypot(FORCE_SD_S, gap_s / np.sqrt(12.0)),
                    from_force=np.ones(len(seen), dtype=bool),
                )
            )
    return GaitEvents(strikes=(trains["strike"][0], trains["strike"][1]), lifts=(trains["lift"][0], trains["lift"][1]))


def fuse(forces: GaitEvents, movement: GaitEvents, rate_hz: float) -> GaitEvents:
    """Put both kinds of evidence together.

    A force that is more than twice as sure is taken as it is. One of few samples says between which two of them the event
    lies, anywhere: the movement's time is confined to that interval. What only one of them shows is kept.
    """

    def join(a: EventTrain, b: EventTrain) -> EventTrain:
        frames, sd_s, from_force = list(a.frames), list(a.sd_s), [True] * len(a.frames)
        for frame, sd in zip(b.frames, b.sd_s, strict=True):
            k = int(np.argmin(np.abs(a.frames - frame))) if a.frames.size else -1
            if k < 0 or abs(a.frames[k] - frame) > SAME_EVENT_S * rate_hz:
                frames.append(frame)
                sd_s.append(sd)
                from_force.append(False)
            elif a.sd_s[k] > 0.5 * sd:
                later_s, sd_s[k] = _confine((frame - a.frames[k]) / rate_hz, sd, np.sqrt(3.0) * a.sd_s[k])
                frames[k] += later_s * rate_hz
        order = np.argsort(frames)
        return EventTrain(
            frames=np.array(frames)[order],
            sd_s=np.array(sd_s)[order],
            from_force=np.array(from_force, dtype=bool)[order],
        )

    return GaitEvents(
        strikes=(join(forces.strikes[0], movement.strikes[0]), join(forces.strikes[1], movement.strikes[1])),
        lifts=(join(forces.lifts[0], movement.lifts[0]), join(forces.lifts[1], movement.lifts[1])),
    )


def _in_bout(paths: FootPaths, bout: Bout, foot: int, kind: Literal["strike", "lift"]) -> list[float]:
    rate_hz = paths.timebase.rate_hz
    chosen = slice(bout.start, bout.stop)
    points_m = np.stack([paths.heel_lab_m[chosen, foot], paths.toe_lab_m[chosen, foot], paths.pelvis_lab_m[chosen]])
    smooth_m = low_pass(np.moveaxis(points_m, 0, 1), rate_hz, min(CUTOFF_HZ, 0.4 * rate_hz))
    heel_m, toe_m, pelvis_m = smooth_m[:, 0], smooth_m[:, 1], smooth_m[:, 2]
    ahead_m = ((heel_m if kind == "strike" else toe_m) - pelvis_m) @ bout.forward_lab
    extent_m = float(np.ptp(ahead_m))
    if extent_m < LEAST_SWING_M:
        return []
    peaks, _ = find_peaks(
        ahead_m if kind == "strike" else -ahead_m, distance=max(1, LEAST_STRIDE_S * rate_hz), prominence=0.3 * extent_m
    )
    if kind == "strike":
        sinking_m_s = np.gradient((heel_m[:, 1] + toe_m[:, 1]) / 2) * rate_hz
        found = [_trough(sinking_m_s, int(peak), rate_hz) for peak in peaks]
    else:
        velocity_m_s = np.gradient(toe_m, axis=0) * rate_hz
        speed_m_s = np.hypot(velocity_m_s @ bout.forward_lab - bout.belt_m_s, velocity_m_s[:, 1])
        found = [_rise(speed_m_s, LIFT_SHARE * bout.speed_m_s, int(peak), rate_hz) for peak in peaks]
    return [bout.start + frame for frame in found]


def _trough(velocity_m_s: Float[np.ndarray, " frame"], near: int, rate_hz: float) -> float:
    """Give the contact by the trough of the vertical velocity about a frame, on a parabola through its lowest three frames.

    Where there is no trough, the frame itself.
    """
    first, last = max(1, near - round(0.03 * rate_hz)), min(len(velocity_m_s) - 2, near + round(0.12 * rate_hz))
    if last <= first:
        return float(near)
    k = first + int(np.argmin(velocity_m_s[first : last + 1]))
    before, here, after = velocity_m_s[k - 1 : k + 2]
    if not before >= here <= after or before + after == 2 * here:
        return float(near)
    return k + 0.5 * (before - after) / (before - 2 * here + after) - TROUGH_LATE_S * rate_hz


def _rise(speed_m_s: Float[np.ndarray, " frame"], level_m_s: float, near: int, rate_hz: float) -> float:
    """Give where a speed first rises above a level about a frame; the frame itself where it does not."""
    first, last = max(0, near - round(0.15 * rate_hz)), min(len(speed_m_s) - 1, near + round(0.1 * rate_hz))
    over = speed_m_s[first : last + 1] > level_m_s
    passes = np.flatnonzero(~over[:-1] & over[1:])
    if passes.size == 0:
        return float(near)
    k = first + int(passes[0])
    return k + _passing(speed_m_s[k], speed_m_s[k + 1], level_m_s)


def _contacts(times_s: Float[np.ndarray, " sample"], loaded: Bool[np.ndarray, " sample"]) -> list[tuple[int, int]]:
    """List the first and last sample of each contact: short breaks closed, short contacts dropped."""
    joined: list[tuple[int, int]] = []
    for first, last in ((start, stop - 1) for start, stop in runs(loaded)):
        if joined and times_s[first] - times_s[joined[-1][1]] < LONGEST_BREAK_S:
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    return [(first, last) for first, last in joined if times_s[last] - times_s[first] >= SHORTEST_STANCE_S]


def _confine(mean: float, sd: float, half: float) -> tuple[float, float]:
    """Give mean and standard deviation of a normal distribution that is cut to ± ``half``.

    Where it says that it can't lie there, those of the even distribution.
    """
    low, high = (-half - mean) / sd, (half - mean) / sd
    inside = float(ndtr(high) - ndtr(low))
    if inside < LEAST_AGREEMENT:
        return 0.0, half / np.sqrt(3.0)
    at_low, at_high = (float(np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)) / inside for x in (low, high))
    shift = at_low - at_high
    return mean + sd * shift, sd * float(np.sqrt(max(1.0 + low * at_low - high * at_high - shift**2, 0.0)))


def _passing(before: float, after: float, level: float) -> float:
    """Give the fraction of the way from one sample to the next at which a straight line passes a level."""
    return float(np.clip((level - before) / (after - before), 0.0, 1.0)) if after != before else 0.5


def _train(frames: list[float], sd_s: float) -> EventTrain:
    return EventTrain(
        frames=np.array(sorted(frames), dtype=float),
        sd_s=np.full(len(frames), sd_s),
        from_force=np.zeros(len(frames), dtype=bool),
    )
