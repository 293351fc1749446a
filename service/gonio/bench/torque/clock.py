"""Synchronization of pressure soles on virtual walks: how far off, how sure, and what is refused.

Walks of 2 s by four people at four speeds. Keypoints are off as measured ones are (half of it constant, most of the rest
wandering within 0.2 s), inverse kinematics and a 6 Hz filter make the movement of them, soles of three qualities give 20 Hz.
The rival is the plain correlation of low-passed force and need of force, which has no idea of its own error.

Streams of other people, who may walk at nearly the same cadence, are tried on clips of 2 s and of 4 s. One that is accepted is
noticed where the report says that the soles carry another weight than the subject's (``pressure-gain``).
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from gonio.bench import Bench
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.kernel.smoothing.filters import low_pass
from gonio.kernel.synchronization.pressure import SEARCH_S, BodyCourse, PressureClock, find_clock
from gonio.kernel.virtual_lab import SOLES, grow, press, truth_at, walk
from gonio.kernel.virtual_lab.chance import correlated
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.pressure import GAIN_RANGE, body_course
from gonio.records import FootPressure, Walk
from gonio.resources import models_dir

WALKERS = (
    ("male", 1.78, 74.0, 1.25),
    ("female", 1.62, 58.0, 1.0),
    ("female", 1.70, 66.0, 1.45),
    ("male", 1.85, 95.0, 0.8),
)
"""Sex, stature (m), mass (kg) and speed (m/s)."""

REPEATS = 12
RATE_HZ, DURATION_S, LONGER_S = 60.0, 2.0, 4.0
OFFSETS_S = (-0.05, 0.05)
WITHIN_S = 0.010


class Trial(NamedTuple):
    """One walk as the video gives it."""

    walker: Walk
    seed: int
    course: BodyCourse


class Answer(NamedTuple):
    """What was found of a stream whose clock was ahead by ``offset_s``."""

    offset_s: float
    clock: PressureClock
    plain_s: float


def measure_clock(bench: Bench) -> None:
    """Add the metrics of the synchronization."""
    bench.explain(__doc__)
    walkers = [
        walk(grow(read_osim(models_dir() / "bodies" / f"fullbody_{sex}.osim"), stature_m, mass_kg), speed_m_s)
        for sex, stature_m, mass_kg, speed_m_s in WALKERS
    ]
    good, rough = (
        [_film(walker, sd_m, seed) for walker, seed in product(walkers, range(REPEATS))] for sd_m in (0.015, 0.030)
    )
    for name, trials, kind in (
        ("15mm_good", good, "good"),
        ("15mm_realistic", good, "realistic"),
        ("30mm_realistic", rough, "realistic"),
        ("30mm_poor", rough, "poor"),
    ):
        answers = list(_answers(trials, kind))
        found = [answer for answer in answers if not answer.clock.refused]
        error_s = np.array([answer.clock.offset_s - answer.offset_s for answer in found])
        sd_s = np.array([answer.clock.sd_s for answer in found])
        plain_s = np.array([answer.plain_s - answer.offset_s for answer in answers])
        at_least = 90.0 if name.startswith("15mm") else None
        within = 100 * float((np.abs(error_s) <= WITHIN_S).sum()) / len(answers)
        suffix = "" if name == "15mm_realistic" else f"_{name}"
        bench.add(f"sync_within_10ms_pct{suffix}", within, "%", at_least=at_least)
        bench.add(f"sync_within_10ms_pct_plain_{name}", 100 * float((np.abs(plain_s) <= WITHIN_S).mean()), "%")
        bench.add(f"sync_{name}_refused", 100 * (1 - len(found) / len(answers)), "%")
        if found:
            bench.add(f"sync_{name}_rms", 1e3 * float(np.sqrt(np.mean(error_s**2))), "ms")
            bench.add(f"sync_{name}_stated_sd", 1e3 * float(np.median(sd_s)), "ms")
            bench.add(
                f"sync_{name}_in_band95", 100 * float((np.abs(error_s) <= 1.96 * sd_s).mean()), "%", at_least=90.0
            )
            bench.add(f"sync_{name}_silently_wrong", float((np.abs(error_s) > 3 * sd_s).sum()), "walks", at_most=0.0)
    bench.add("sync_swapped_found", 100 * _swapped_share(good), "%", at_least=99.0)
    longer = [_film(trial.walker, 0.015, trial.seed, LONGER_S) for trial in good[::3]]
    for suffix, trials, at_most in (("", good[::3], 10.0), ("_4s", longer, 2.0)):
        accepted, unnoticed = _foreign_shares(trials)
        bench.add(f"sync_other_walk_accepted{suffix}", 100 * accepted, "%", at_most=at_most)
        bench.add(f"sync_other_walk_unnoticed{suffix}", 100 * unnoticed, "%", at_most=2.0)


def _film(walker: Walk, sd_m: float, seed: int, duration_s: float = DURATION_S) -> Trial:
    """Give what the video says of a walk whose keypoints are off by ``sd_m`` along each axis."""
    rng = np.random.default_rng([seed, 1])
    times_s = rng.uniform(0.0, 1.2) + np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    card = read_markerset(models_dir() / "markersets" / "blazepose33.toml")
    body = attach(walker.body, card)
    seen_m = marker_positions(body, truth_at(walker, times_s).q)
    wandering = correlated(rng, seen_m.shape, RATE_HZ, 0.2)
    constant, white = rng.standard_normal((1, *seen_m.shape[1:])), rng.standard_normal(seen_m.shape)
    noisy_m = seen_m + sd_m * (0.5 * constant + 0.75 * wandering + 0.43 * white)
    motion = solve_motion(body, make_tasks(body, card), noisy_m, times_s)
    course = body_course(BodyMotion(motion=motion, model=body, two_step=motion, fit=None, distrusted=""))
    assert course is not None
    return Trial(walker, seed, course)


def _soles(trial: Trial, kind: str, offset_s: float) -> FootPressure:
    duration_s = 2.0 + len(trial.course.times_s) / RATE_HZ
    errors = replace(SOLES[kind], offset_s=offset_s)
    return press(trial.walker, errors=errors, duration_s=duration_s, seed=trial.seed).pressure


def _answers(trials: list[Trial], kind: str) -> Iterator[Answer]:
    for number, trial in enumerate(trials):
        offset_s = OFFSETS_S[number % 2]
        stream = _soles(trial, kind, offset_s)
        yield Answer(offset_s, find_clock(stream, trial.course), _plain_correlation_s(stream, trial.course))


def _swapped_share(trials: list[Trial]) -> float:
    """Give the share of swapped pairs of soles that are seen to be."""
    found = []
    for trial in trials:
        stream = _soles(trial, "realistic", 0.0)
        force, place = stream.vertical_n[:, ::-1].copy(), stream.cop_foot_m[:, ::-1].copy()
        found.append(find_clock(replace(stream, vertical_n=force, cop_foot_m=place), trial.course).swapped)
    return float(np.mean(found))


def _foreign_shares(trials: list[Trial]) -> tuple[float, float]:
    """Give the shares of other people's streams, begun at any time, that are taken for the walk's: in all, and unnoticed."""
    rng, accepted, unnoticed = np.random.default_rng(5), [], []
    for trial, other in product(trials, trials):
        if other.walker is not trial.walker:
            stream = _soles(other, "realistic", float(rng.uniform(-0.6, 0.6)))
            clock = find_clock(stream, trial.course)
            accepted.append(not clock.refused)
            shown = float(np.nanmean(stream.vertical_n.sum(axis=1))) / trial.course.weight_n
            unnoticed.append(not clock.refused and GAIN_RANGE[0] <= shown <= GAIN_RANGE[1])
    return float(np.mean(accepted)), float(np.mean(unnoticed))


def _plain_correlation_s(stream: FootPressure, course: BodyCourse) -> float:
    """Give the lag at which force and need, both low-passed at 5 Hz, correlate best: on a grid of 5 ms, then a parabola."""
    known = np.isfinite(stream.vertical_n).all(axis=1)
    grid_s = np.arange(course.times_s[0], course.times_s[-1], 0.005)
    need = low_pass(CubicSpline(course.times_s, course.need_n)(grid_s), 200.0, 5.0)
    soles_s = np.arange(stream.times_s[known][0], stream.times_s[known][-1], 0.005)
    total = stream.vertical_n[known].sum(axis=1)
    force = CubicSpline(soles_s, low_pass(np.interp(soles_s, stream.times_s[known], total), 200.0, 5.0))
    inner = slice(20, -20)
    lags_s = np.arange(-SEARCH_S, SEARCH_S + 0.0025, 0.005)
    match = np.array([_correlation(need[inner], force(grid_s[inner] + lag_s)) for lag_s in lags_s])
    best = int(np.clip(match.argmax(), 1, len(match) - 2))
    before, here, after = match[best - 1 : best + 2]
    bend = before - 2 * here + after
    return float(lags_s[best] + (0.0025 * (before - after) / bend if bend < 0 else 0.0))


def _correlation(a: Float[np.ndarray, " point"], b: Float[np.ndarray, " point"]) -> float:
    return float(np.corrcoef(a, b)[0, 1])
