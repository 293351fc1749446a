"""When a foot strikes the ground and when it leaves it.

From a vertical force, where there is one: the instant at which it passes a threshold. Else from the movement, in two steps:

1. Where to look: a foot strikes near the instant at which its heel is farthest in front of the pelvis, and leaves the ground
   near the one at which its toes are farthest behind [Zeni et al. 2008, Gait & Posture 27:710-714].
2. When exactly. Strike: the middle of the foot sinks fastest; that is late by 16 ms on average, which is taken off [O'Connor
   et al. 2007, Gait & Posture 25:469-474]. Lift: the toes' speed in the sagittal plane, relative to the ground, rises above a
   share of the walking speed [Bruening & Ridge 2014, Gait & Posture 39:472-477].

The first step alone is 20 to 60 ms early at the strike, by person, but hardly scatters; the second is right in the mean, and
scatters. The trial's own strides calibrate the one by the other (:func:`steady`).
"""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
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

Kind = Literal["strike", "lift"]

SD_S: Mapping[Kind, float] = {"strike": 0.015, "lift": 0.012}
"""Of events found from movement."""

EXACT_SD_S, LEAST_FREEDOM = 0.0045, 3
"""How the exact instants scatter about a trial's mean, where fewer degrees of freedom are left to tell: measured on virtual
people; in a marker laboratory it is 1 ms."""

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

LEAST_PROMINENCE, LEAST_HEIGHT = 0.3, 0.7
"""Of the way to and fro: so much a foot's farthest reach stands out, and so high it is in a stride that the recording cuts."""

EDGE_S, CUT_STRIDE_S = 0.02, 0.25
"""Nearer to the recording's begin or end a farthest reach may be none, farther from it a stride is not cut."""

LEAST_SINKING = 0.15
"""Of the walking speed: with less a foot does not strike. In recordings it is 0.35 to 0.55."""

SLOWEST_M_S = 0.1

LEAST_AGREEMENT = 0.01
"""A movement that puts an event into the interval that a force allows with less than this chance is wrong."""

SAME_EVENT_S = 0.15
"""Events of one kind and foot that are closer are one."""


def events_from_movement(paths: FootPaths, bouts: tuple[Bout, ...]) -> GaitEvents:
    """Find the events of both feet from where heels, toes and pelvis are; none in turns and where someone stands."""
    trains: dict[Kind, tuple[EventTrain, EventTrain]] = {}
    for kind, sd_s in SD_S.items():
        right, left = (
            np.concatenate(
                [_in_bout(paths, bout, foot, kind) for bout in bouts if bout.speed_m_s >= SLOWEST_M_S]
                or [np.empty((0, 2))]
            )
            for foot in (0, 1)
        )
        frames = steady(right, left, paths.timebase.rate_hz)
        trains[kind] = _train(frames[0], sd_s), _train(frames[1], sd_s)
    return GaitEvents(strikes=trains["strike"], lifts=trains["lift"])


def steady(
    right: Float[np.ndarray, "right 2"], left: Float[np.ndarray, "left 2"], rate_hz: float
) -> tuple[Float[np.ndarray, " right"], Float[np.ndarray, " left"]]:
    """Put the exact instants of one kind of event, and those of the farthest reach, together over a trial.

    The farthest reach comes early or late by a time that differs from person to person by 10 ms, but hardly from stride to
    stride; the exact instant is right in the mean, and noisy, for it hangs on a velocity. So the trial's own strides tell
    the time between the two, and each event is its reach, later by that. Both feet share this time, but for what they
    differ by more than chance would have it [the positive-part estimator of James and Stein 1961]: people may limp.

    Args:
        right: Exact instant and farthest reach of each event of the right foot, frames; the exact one NaN where it was not
            seen.
        left: The same of the left one.
        rate_hz: Of the frames.
    """
    later = [foot[:, 0] - foot[:, 1] for foot in (right, left)]
    known = [values[np.isfinite(values)] for values in later]
    every = np.concatenate(known)
    if not every.size:
        return right[:, 1], left[:, 1]
    shared, counts = float(every.mean()), [len(values) for values in known]
    own = [float(values.mean()) if len(values) else shared for values in known]
    if min(counts) > 0 and own[0] != own[1]:
        left_over = np.concatenate([values - mean for values, mean in zip(known, own, strict=True)])
        freedom = len(every) - 2
        variance = float(left_over @ left_over) / freedom if freedom >= LEAST_FREEDOM else (EXACT_SD_S * rate_hz) ** 2
        chance = variance * sum(1.0 / count for count in counts)
        kept = max(0.0, 1.0 - chance / (own[0] - own[1]) ** 2)
        own = [shared + kept * (mean - shared) for mean in own]
    return right[:, 1] + own[0], left[:, 1] + own[1]


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


def _in_bout(paths: FootPaths, bout: Bout, foot: int, kind: Kind) -> Float[np.ndarray, "event 2"]:
    """Give the exact instant (NaN where it was not seen) and the farthest reach of each event of a foot, frames."""
    rate_hz = paths.timebase.rate_hz
    chosen = slice(bout.start, bout.stop)
    points_m = np.stack([paths.heel_lab_m[chosen, foot], paths.toe_lab_m[chosen, foot], paths.pelvis_lab_m[chosen]])
    smooth_m = low_pass(np.moveaxis(points_m, 0, 1), rate_hz, min(CUTOFF_HZ, 0.4 * rate_hz))
    heel_m, toe_m, pelvis_m = smooth_m[:, 0], smooth_m[:, 1], smooth_m[:, 2]
    reach_m = (heel_m - pelvis_m if kind == "strike" else pelvis_m - toe_m) @ bout.forward_lab
    if float(np.ptp(reach_m)) < LEAST_SWING_M:
        return np.empty((0, 2))
    peaks, cut = _farthest(reach_m, rate_hz)
    if kind == "strike":
        sinking_m_s = np.gradient((heel_m[:, 1] + toe_m[:, 1]) / 2) * rate_hz
        exact = [_trough(sinking_m_s, LEAST_SINKING * bout.speed_m_s, peak, rate_hz) for peak in peaks]
    else:
        velocity_m_s = np.gradient(toe_m, axis=0) * rate_hz
        speed_m_s = np.hypot(velocity_m_s @ bout.forward_lab - bout.belt_m_s, velocity_m_s[:, 1])
        exact = [_rise(speed_m_s, LIFT_SHARE * bout.speed_m_s, peak, rate_hz) for peak in peaks]
    found = np.array([exact, [_top(reach_m, peak) for peak in peaks]]).T.reshape(-1, 2)
    return bout.start + found[np.isfinite(found[:, 0]) | ~cut]


def _farthest(
    reach_m: Float[np.ndarray, " frame"], rate_hz: float
) -> tuple[Int[np.ndarray, " peak"], Bool[np.ndarray, " peak"]]:
    """List where a foot reaches farthest, and which of these strides the bout's begin or end cuts.

    A whole stride's peak stands out to both sides. That of a cut one can do so to one side only: it must be as high as a
    stride's, so that feet that stand together at the end are none.
    """
    from scipy.signal import find_peaks, peak_prominences  # slow to load, and a worker starts without it

    extent_m, last = float(np.ptp(reach_m)), len(reach_m) - 1
    least_m, apart = LEAST_PROMINENCE * extent_m, max(1, LEAST_STRIDE_S * rate_hz)
    fenced_m = np.concatenate([[-np.inf], reach_m, [-np.inf]])
    peaks = find_peaks(fenced_m, distance=apart, prominence=least_m)[0] - 1
    peaks = peaks[(peaks > 0) & (peaks < last)]
    cut = np.asarray(peak_prominences(reach_m, peaks)[0] < least_m)
    to_edge = np.minimum(peaks, last - peaks)
    high = reach_m[peaks] > reach_m.min() + LEAST_HEIGHT * extent_m
    kept = ~cut | (high & (to_edge > EDGE_S * rate_hz) & (to_edge < CUT_STRIDE_S * rate_hz))
    return peaks[kept], cut[kept]


def _top(values: Float[np.ndarray, " frame"], peak: int) -> float:
    """Give where the parabola through a peak and its neighbours has its top, frames."""
    before, here, after = values[peak - 1 : peak + 2]
    bend = before - 2 * here + after
    return peak + (0.5 * float((before - after) / bend) if bend < 0 else 0.0)


def _trough(velocity_m_s: Float[np.ndarray, " frame"], least_m_s: float, near: int, rate_hz: float) -> float:
    """Give the contact by the trough of the vertical velocity about a frame, on a parabola through its lowest three frames.

    NaN where there is no trough, or none as deep as ``least_m_s``.
    """
    first, last = max(1, near - round(0.03 * rate_hz)), min(len(velocity_m_s) - 2, near + round(0.12 * rate_hz))
    if last <= first:
        return np.nan
    k = first + int(np.argmin(velocity_m_s[first : last + 1]))
    if not velocity_m_s[k - 1] >= velocity_m_s[k] <= velocity_m_s[k + 1] or velocity_m_s[k] > -least_m_s:
        return np.nan
    return _top(-velocity_m_s, k) - TROUGH_LATE_S * rate_hz


def _rise(speed_m_s: Float[np.ndarray, " frame"], level_m_s: float, near: int, rate_hz: float) -> float:
    """Give where a speed first rises above a level about a frame; NaN where it does not."""
    first, last = max(0, near - round(0.15 * rate_hz)), min(len(speed_m_s) - 1, near + round(0.1 * rate_hz))
    over = speed_m_s[first : last + 1] > level_m_s
    passes = np.flatnonzero(~over[:-1] & over[1:])
    if passes.size == 0:
        return np.nan
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


def _train(frames: Float[np.ndarray, " event"], sd_s: float) -> EventTrain:
    return EventTrain(
        frames=np.sort(frames),
        sd_s=np.full(len(frames), sd_s),
        from_force=np.zeros(len(frames), dtype=bool),
    )
