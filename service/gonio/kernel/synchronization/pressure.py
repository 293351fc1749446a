"""How far the clock of pressure soles runs ahead of the cameras', found from the walk itself, with its uncertainty.

Two witnesses that fail for different reasons. *Force*: both feet together must carry what the movement of the whole body
needs, m (g + a); the lag at which they agree is exact with good soles, but soles that miss the toes bend it. *Contact*: each
foot's load begins and ends when the foot's movement says so; that holds with poor soles too, but people differ by some
milliseconds. Where both agree, they are put together; where they contradict each other, the uncertainty says so; where there
is no evidence, there is no answer.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from gonio.kernel.smoothing.filters import low_pass, runs
from gonio.records import FootPressure, record

SEARCH_S = 0.25
"""Half a step of quick walking: further away, one step is taken for the next."""

GRID_S, STEP_S = 0.005, 0.005
CUTOFF_HZ = 3.0
"""The need of force comes from accelerations, whose noise grows with frequency: the first harmonics tell most."""
TRIM_S = 0.15
"""Filters distort so much at each end of the need of force."""

FORCE_BIAS_S, FORCE_BIAS_SD_S = 0.0015, 0.003
"""Recordings with plates give +3 ms, of which part is their plates' own lag; exact forces give none."""

GAIN_SD, PLACE_SD, OFFSET_SD = 0.10, 0.03, 0.02
"""What soles may do to a force: a factor for each foot, one that changes from heel to toe, and an offset in body weights."""

NOISE = np.geomspace(0.008, 0.12, 10)
"""Of the need of force, body weights: not known beforehand."""

INDEPENDENT = 2.0
"""The residuals of a signal of bandwidth B are worth 2 B values a second; these are nearer to twice that: measured."""

LEAST_EXPLAINED = 0.3
"""Share of the need's variance that the soles' force must explain to be a witness, or without steps alone."""
LEAST_EXPLAINED_ALONE = 0.6

LACKING_BW = 0.4
"""Soles that carry so much less than the movement needs miss a foot, or somebody sits."""

LOADED = 0.1
"""Share of the body's weight above which a foot is taken as loaded."""

STRIKE_LATE_S, LIFT_EARLY_S = 0.039, 0.024
"""So much after the heel was farthest in front a foot is loaded, and so much before the toe is farthest behind it is bare, in
the mean over recordings with plates."""

CONTACT_BIAS_S, CONTACT_BIAS_SD_S = -0.0075, 0.008
"""Of the mean of both, beside that of recordings with plates (+7.5 ms), which have a lag of their own; normal curves show −5
ms, so the middle is taken. From person to person it differs by the second number."""

EVENT_SD_S = 0.008
"""The least scatter of an event: with few events, their own scatter says little."""

FEWEST_EVENTS = 3
LARGEST_SCATTER_S = 0.030
LARGEST_DRIFT_SD, LARGEST_DRIFT = 3.0, 0.005
"""Events that scatter more, or that come later and later (standard deviations; seconds a second), are another walk's."""

STILL_BW, STILL_M, STILL_M_S = 0.10, 0.02, 0.15
"""Loads and their places that change by less within the searched time, and a body whose centre of mass and heels move slower,
are the same whatever the clock: most of the time, see :func:`is_idle`."""

LARGEST_SD_S = 0.025
"""A worse offset costs more torque than pressure gives."""


class Witness(NamedTuple):
    """What one kind of evidence says: the offset, its standard deviation, and how strong the evidence is."""

    offset_s: float
    sd_s: float
    strength: float


@record
class PressureClock:
    """How far a pressure stream's clock runs ahead: its time stamps minus ``offset_s`` are times of the video.

    ``sd_s`` is the standard deviation of the offset. ``refused`` says why there is no offset (NaN), and is empty where there
    is one. The witnesses' own answers are kept, NaN where one has none: of ``force`` with the share of variance that it
    explains, of ``contact`` with its number of events. ``swapped``: the right sole fits the left foot and the left one the
    right foot.
    """

    offset_s: float
    sd_s: float
    force_offset_s: float
    force_sd_s: float
    explained: float
    contact_offset_s: float
    contact_sd_s: float
    events: int
    swapped: bool
    refused: str


@record
class BodyCourse:
    """What the video says of a walk, for :func:`find_clock`: uniform times, and NaN where nothing is known.

    ``need_n`` is the vertical force that the whole body's movement needs, m (g + a).
    """

    times_s: Float[np.ndarray, " frame"]
    need_n: Float[np.ndarray, " frame"]
    com_lab_m: Float[np.ndarray, "frame 3"]
    heel_lab_m: Float[np.ndarray, "frame foot 3"]
    toe_lab_m: Float[np.ndarray, "frame foot 3"]
    weight_n: float


def find_clock(pressure: FootPressure, body: BodyCourse, search_s: float = SEARCH_S) -> PressureClock:
    """Find the offset of a pressure stream.

    Args:
        pressure: The stream, with its own time stamps. Lost samples are left out.
        body: What the video says.
        search_s: How far the offset is searched each way.
    """
    force = force_witness(pressure, body, search_s)
    steps = match_steps(pressure, body, search_s)
    contact, foreign = contact_witness(steps)
    others = len(match_steps(pressure, body, search_s, swapped=True).lags_s)
    swapped = others >= FEWEST_EVENTS and others > 2 * len(steps.lags_s)
    offset_s, sd_s, refused = _put_together(force, contact, search_s)
    refused = foreign or refused
    if swapped:
        refused = "the right sole's loads fit the left foot's steps, and the left one's the right foot's"
    return PressureClock(
        offset_s=np.nan if refused else offset_s,
        sd_s=np.nan if refused else sd_s,
        force_offset_s=force.offset_s,
        force_sd_s=force.sd_s,
        explained=force.strength,
        contact_offset_s=contact.offset_s,
        contact_sd_s=contact.sd_s,
        events=int(contact.strength),
        swapped=swapped,
        refused=refused,
    )


def _put_together(force: Witness, contact: Witness, search_s: float) -> tuple[float, float, str]:
    """Weigh both witnesses; say why not, if they can't be believed."""
    heard = [contact] if np.isfinite(contact.offset_s) else []
    if np.isfinite(force.offset_s) and force.strength >= (LEAST_EXPLAINED if heard else LEAST_EXPLAINED_ALONE):
        heard.append(force)
    if not heard:
        return np.nan, np.nan, "its loads have nothing in common with the movement, or there is too little movement"
    weights = np.array([1.0 / witness.sd_s**2 for witness in heard])
    offsets_s = np.array([witness.offset_s for witness in heard])
    offset_s, sd_s = float(weights @ offsets_s / weights.sum()), float(weights.sum() ** -0.5)
    # Witnesses that contradict each other are both doubted, as much as they do [Birge 1932].
    sd_s *= max(1.0, float(np.sqrt(weights @ (offsets_s - offset_s) ** 2)))
    if sd_s > LARGEST_SD_S:
        return np.nan, np.nan, f"its offset is known to {1e3 * sd_s:.0f} ms only"
    if abs(offset_s) > search_s - 2 * sd_s:
        return np.nan, np.nan, f"its offset may be more than the {1e3 * search_s:.0f} ms that are searched"
    return offset_s, sd_s, ""


def is_idle(pressure: FootPressure, body: BodyCourse, search_s: float = SEARCH_S) -> bool:
    """Say whether somebody stands so still that nothing depends on the clock, and that the soles carry the body's weight."""
    inside = (pressure.times_s > body.times_s[0] - search_s) & (pressure.times_s < body.times_s[-1] + search_s)
    times_s, force_n = pressure.times_s[inside], pressure.vertical_n[inside]
    if len(times_s) < 5 or not 0.7 < np.nan_to_num(np.nanmean(force_n.sum(axis=1))) / body.weight_n < 1.3:
        return False
    place_m = pressure.cop_foot_m[inside].reshape(len(times_s), -1)
    place_m = np.where(np.repeat(force_n > LOADED * body.weight_n, 2, axis=1), place_m, np.nan)
    width = max(round(2 * search_s / float(np.median(np.diff(times_s)))), 2)
    for values, most in ((force_n, STILL_BW * body.weight_n), (place_m, STILL_M)):
        windows = sliding_window_view(values, min(width, len(values)), axis=0)
        known = np.isfinite(windows).any(axis=-1)
        ranges = np.fmax.reduce(windows, axis=-1) - np.fmin.reduce(windows, axis=-1)
        if known.any() and np.percentile(ranges[known], 95) > most:
            return False
    for path_m in (body.com_lab_m, body.heel_lab_m[:, 0], body.heel_lab_m[:, 1]):
        speed_m_s = np.linalg.norm(np.gradient(path_m, body.times_s, axis=0), axis=-1)
        if not np.nanpercentile(speed_m_s, 95) < STILL_M_S:
            return False
    return True


def lacking_share(pressure: FootPressure, body: BodyCourse) -> float:
    """Give in which share of the frames both soles carry much less than the movement needs: something else carries it."""
    known = np.isfinite(pressure.vertical_n).all(axis=1)
    frames = np.isfinite(body.need_n)
    if known.sum() < 2 or not frames.any():
        return 0.0
    total_n = np.interp(body.times_s[frames], pressure.times_s[known], pressure.vertical_n[known].sum(axis=1))
    return float((body.need_n[frames] - total_n > LACKING_BW * body.weight_n).mean())


def force_witness(pressure: FootPressure, body: BodyCourse, search_s: float) -> Witness:
    """Find the offset at which the soles' force is what the movement needs; strength is the explained share of variance.

    At each lag the need is explained by both feet's forces, each with a gain, a gain that changes along the sole and an
    offset, all with priors; what remains is noise of unknown size. The marginal likelihood over the lags is the posterior of
    the offset.
    """
    unknown = Witness(np.nan, np.inf, 0.0)
    need = _filtered_need(body)
    known, soles = _filtered_soles(pressure)
    if need is None or known is None:
        return unknown
    grid_s, inside = known
    (begin_s, end_s), curve = need
    lags_s = np.arange(-search_s, search_s + STEP_S / 2, STEP_S)
    evidence, explained = np.full(len(lags_s), -np.inf), np.zeros(len(lags_s))
    for row, lag_s in enumerate(lags_s):
        used = inside & (grid_s - lag_s >= begin_s) & (grid_s - lag_s <= end_s)
        if used.sum() * GRID_S < 0.5:
            continue
        evidence[row], explained[row] = _evidence(
            curve(grid_s[used] - lag_s) / body.weight_n, soles[used] / body.weight_n
        )
    if not np.isfinite(evidence).all():
        return unknown
    posterior = np.exp(evidence - evidence.max())
    posterior /= posterior.sum()
    offset_s = float(posterior @ lags_s)
    sd_s = float(np.sqrt(posterior @ (lags_s - offset_s) ** 2 + STEP_S**2 / 12))
    return Witness(offset_s - FORCE_BIAS_S, float(np.hypot(sd_s, FORCE_BIAS_SD_S)), float(explained[evidence.argmax()]))


class Steps(NamedTuple):
    """Events that soles and video have in common: when (video), how much later the soles show each, and if it is a lift."""

    times_s: Float[np.ndarray, " event"]
    lags_s: Float[np.ndarray, " event"]
    lift: Bool[np.ndarray, " event"]


def match_steps(pressure: FootPressure, body: BodyCourse, search_s: float, *, swapped: bool = False) -> Steps:
    """Match when feet are loaded and bare to when their movement says so.

    The heel is farthest before the body shortly before it strikes, the toe farthest behind it shortly after it left
    [Zeni 2008]; the soles' events are where the load crosses :data:`LOADED`.
    """
    forwards = _forwards(body)
    found: list[tuple[float, float, bool]] = []
    for foot in range(2):
        shown = pressure.vertical_n[:, 1 - foot if swapped else foot]
        loads = _crossings(pressure.times_s, shown, LOADED * body.weight_n)
        for kind, (place, sign, late_s) in enumerate(
            ((body.heel_lab_m, 1.0, STRIKE_LATE_S), (body.toe_lab_m, -1.0, -LIFT_EARLY_S))
        ):
            reach_m = sign * (place[:, foot] - body.com_lab_m) @ forwards
            for event_s in _peaks(body.times_s, reach_m):
                apart_s = loads[kind] - event_s
                if apart_s.size:
                    nearest_s = float(apart_s[np.abs(apart_s - late_s).argmin()])
                    if abs(nearest_s - late_s) <= search_s + 0.05:
                        found.append((float(event_s), nearest_s, kind == 1))
    times_s, lags_s, lift = np.array(found, dtype=float).reshape(-1, 3).T
    return Steps(times_s, lags_s, lift > 0)


def contact_witness(steps: Steps) -> tuple[Witness, str]:
    """Find the offset from the events in common; also why they are those of another walk, empty if they are not."""
    count, lifts = len(steps.lags_s), int(steps.lift.sum())
    if count < FEWEST_EVENTS or lifts in (0, count):
        return Witness(np.nan, np.inf, float(count)), ""
    kinds = [steps.lags_s[steps.lift == lift] for lift in (False, True)]
    middles_s = [float(np.median(kind)) for kind in kinds]
    left_s = steps.lags_s - np.where(steps.lift, kinds[1].mean(), kinds[0].mean())
    scatter_s = float(np.sqrt(left_s @ left_s / max(count - 2, 1)))
    since_s = (
        steps.times_s
        - np.array([steps.times_s[steps.lift == lift].mean() for lift in (False, True)])[steps.lift.astype(int)]
    )
    spread = float(since_s @ since_s)
    drift = float(since_s @ left_s) / spread if spread > 0 else 0.0
    rest_s = float(np.sqrt(np.sum((left_s - drift * since_s) ** 2) / max(count - 3, 1)))
    drift_sd = float(np.hypot(rest_s, EVENT_SD_S)) / np.sqrt(spread) if spread > 0 else np.inf
    foreign = ""
    if scatter_s > LARGEST_SCATTER_S:
        foreign = f"its loads scatter by {1e3 * scatter_s:.0f} ms about the steps in the video"
    elif abs(drift) > max(LARGEST_DRIFT, LARGEST_DRIFT_SD * drift_sd):
        foreign = f"its loads fall behind the steps in the video, or run ahead, by {1e3 * abs(drift):.0f} ms a second"
    event_sd_s = float(np.hypot(scatter_s, EVENT_SD_S))
    sd_s = event_sd_s * 0.5 * float(np.sqrt(sum(1.0 / len(kind) for kind in kinds)))
    offset_s = sum(middles_s) / 2 - (STRIKE_LATE_S - LIFT_EARLY_S) / 2 - CONTACT_BIAS_S
    return Witness(offset_s, float(np.hypot(sd_s, CONTACT_BIAS_SD_S)), float(count)), foreign


def _evidence(need: Float[np.ndarray, " point"], soles: Float[np.ndarray, "point part"]) -> tuple[float, float]:
    """Give the log marginal likelihood of the need at one lag, and the share of its variance that the soles explain."""
    parts = np.column_stack([soles, np.ones(len(need))])
    left = need - soles[:, :2].sum(axis=1)
    precision = np.diag([GAIN_SD**-2.0, GAIN_SD**-2.0, PLACE_SD**-2.0, OFFSET_SD**-2.0])
    worth = INDEPENDENT * 2.0 * CUTOFF_HZ * GRID_S  # of one point of the grid, in independent values
    found = []
    squares, cross = parts.T @ parts, parts.T @ left
    for noise in NOISE:
        weight = worth / noise**2
        system = weight * squares + precision
        solved = np.linalg.solve(system, weight * cross)
        cost = weight * (left @ left) - weight * (cross @ solved)
        # The prior of the parts is the same at each lag; the noise's is flat in its logarithm.
        found.append(-0.5 * cost - worth * len(need) * np.log(noise) - 0.5 * np.linalg.slogdet(system)[1])
    best = int(np.argmax(found))
    solved = np.linalg.solve(squares * worth / NOISE[best] ** 2 + precision, cross * worth / NOISE[best] ** 2)
    return float(np.logaddexp.reduce(found)), 1.0 - float(np.var(left - parts @ solved) / np.var(need))


def _filtered_need(body: BodyCourse) -> tuple[tuple[float, float], CubicSpline] | None:
    """Give the need of force, low-passed, as a curve over the longest time without a gap."""
    known = np.asarray(np.isfinite(body.need_n))
    found = runs(known)
    if not found:
        return None
    begin, end = max(found, key=lambda run: run[1] - run[0])
    if body.times_s[end - 1] - body.times_s[begin] < 2 * TRIM_S + 0.5:
        return None
    rate_hz = (end - 1 - begin) / (body.times_s[end - 1] - body.times_s[begin])
    smooth = low_pass(body.need_n[begin:end], float(rate_hz), CUTOFF_HZ)
    return (
        (float(body.times_s[begin]) + TRIM_S, float(body.times_s[end - 1]) - TRIM_S),
        CubicSpline(body.times_s[begin:end], smooth),
    )


def _filtered_soles(
    pressure: FootPressure,
) -> tuple[tuple[Float[np.ndarray, " point"], Bool[np.ndarray, " point"]] | None, Float[np.ndarray, "point part"]]:
    """Give both feet's force and its first moment along the sole, low-passed on a fine grid, and where it is known."""
    known = np.isfinite(pressure.vertical_n).all(axis=1)
    if known.sum() < 10:
        return None, np.empty((0, 3))
    times_s, force = pressure.times_s[known], pressure.vertical_n[known]
    along_m = np.nan_to_num(pressure.cop_foot_m[known, :, 0], nan=0.1)
    parts = np.column_stack([force, (force * (along_m / 0.25 - 0.4)).sum(axis=1)])
    grid_s = np.arange(times_s[0], times_s[-1], GRID_S)
    filled = np.stack([np.interp(grid_s, times_s, part) for part in parts.T], axis=1)
    inside = np.ones(len(grid_s), dtype=bool)
    steps_s = np.diff(times_s)
    # Across a lost sample the straight line is not data: it only keeps the filter from ringing.
    for gap in np.flatnonzero((steps_s > 2.5 * np.median(steps_s)) | (np.diff(np.flatnonzero(known)) > 1)):
        inside &= (grid_s < times_s[gap] - 0.05) | (grid_s > times_s[gap + 1] + 0.05)
    return (grid_s, inside), low_pass(filled, 1.0 / GRID_S, CUTOFF_HZ)


def _forwards(body: BodyCourse) -> Float[np.ndarray, "3"]:
    """Give the level direction in which the feet point, in the mean."""
    sole = np.nanmean((body.toe_lab_m - body.heel_lab_m).reshape(-1, 3), axis=0) * [1.0, 0.0, 1.0]
    return sole / max(float(np.linalg.norm(sole)), 1e-9)


def _peaks(times_s: Float[np.ndarray, " frame"], reach_m: Float[np.ndarray, " frame"]) -> Float[np.ndarray, " peak"]:
    """Give when a foot reaches farthest: the strides' maxima, between frames by a parabola."""
    if np.isfinite(reach_m).sum() < 5:
        return np.empty(0)
    low, high = np.nanpercentile(reach_m, [2, 98])
    if high - low < 0.2:  # a foot that goes nowhere takes no steps
        return np.empty(0)
    before, here, after = reach_m[:-2], reach_m[1:-1], reach_m[2:]
    top = np.flatnonzero((here > before) & (here >= after) & (here > low + 0.7 * (high - low))) + 1
    top = top[(times_s[top] > times_s[0] + 0.1) & (times_s[top] < times_s[-1] - 0.1)]
    bend = reach_m[top - 1] - 2 * reach_m[top] + reach_m[top + 1]
    shift = 0.5 * (reach_m[top - 1] - reach_m[top + 1]) / np.where(bend < 0, bend, -np.inf)
    return times_s[top] + shift * (times_s[1] - times_s[0])


def _crossings(
    times_s: Float[np.ndarray, " sample"], shown: Float[np.ndarray, " sample"], level: float
) -> tuple[Float[np.ndarray, " up"], Float[np.ndarray, " down"]]:
    """Give when a load rises and falls through a level, between two samples that are both known."""
    before, after = shown[:-1], shown[1:]
    found = []
    for sign in (1.0, -1.0):
        at = np.flatnonzero((sign * (before - level) < 0) & (sign * (after - level) >= 0))
        share = (level - before[at]) / (after[at] - before[at])
        found.append(times_s[at] + share * (times_s[at + 1] - times_s[at]))
    return found[0], found[1]
