"""The clock of pressure soles against the video: found, bounded by its uncertainty, or refused."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.soles import mark_soles
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.kernel.dynamics.zero_lag import differentiate
from gonio.kernel.synchronization.pressure import LARGEST_SD_S, BodyCourse, find_clock
from gonio.kernel.virtual_lab import SOLES, grow, press, truth_at, walk
from gonio.kernel.virtual_lab.chance import correlated
from gonio.records import FootPressure
from gonio.resources import models_dir

WEIGHT_N = 70.0 * 9.80665


@pytest.fixture(scope="module")
def body():
    return grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, 70.0)


@pytest.fixture(scope="module")
def walker(body):
    return walk(body, 1.25)


@pytest.fixture(scope="module")
def stroller(body):
    return walk(body, 0.9)


def film(walker, *, begin_s=0.3, sd_m=0.0, seed=0):
    """Two seconds of a walk as a fit to keypoints would give it: the whole body and each foot wander by ``sd_m`` / 5 and
    ``sd_m`` / 2, since a fit of all coordinates to 33 keypoints averages their noise."""
    times_s = begin_s + np.arange(120) / 60
    truth = truth_at(walker, times_s)
    rng = np.random.default_rng(seed)
    soles = marker_positions(mark_soles(walker.body), truth.q)[:, [0, 4, 1, 5]]
    q = truth.q.copy()
    slides = [walker.body.coordinates.index(f"pelvis_t{axis}") for axis in "xyz"]
    q[:, slides] += sd_m / 5 * correlated(rng, (120, 3), 60.0, 0.2)
    soles = soles + sd_m / 2 * correlated(rng, (120, 4, 3), 60.0, 0.2)
    smooth = differentiate(times_s, q, 6.0)
    whole = solve_dynamics(walker.body, smooth.q, smooth.velocity, smooth.acceleration)
    return BodyCourse(
        times_s=times_s,
        need_n=whole.net_force_n[:, 1],
        com_lab_m=whole.com_lab_m,
        heel_lab_m=soles[:, :2],
        toe_lab_m=soles[:, 2:],
        weight_n=WEIGHT_N,
    )


def soles(walker, kind="realistic", offset_s=0.0, seed=0):
    return press(walker, errors=replace(SOLES[kind], offset_s=offset_s), duration_s=4.0, seed=seed).pressure


@pytest.mark.parametrize("offset_s", [-0.05, 0.0, 0.05, 0.15])
def test_an_exact_walk_gives_its_offset_back(walker, offset_s):
    clock = find_clock(soles(walker, "clean", offset_s), film(walker))
    # The constants of both witnesses lie between real recordings and this exact walk: 1.5 and 7 ms beside it.
    assert clock.refused == ""
    assert clock.offset_s == pytest.approx(offset_s, abs=0.006)
    assert clock.sd_s < 0.008
    assert clock.explained > 0.9
    assert clock.events >= 4


def test_noisy_walks_give_it_back_within_10_ms(walker):
    errors_s = np.array(
        [
            find_clock(soles(walker, "realistic", 0.05, seed), film(walker, sd_m=0.015, seed=seed)).offset_s - 0.05
            for seed in range(10)
        ]
    )
    assert (np.abs(errors_s) < 0.010).sum() >= 9


@pytest.mark.parametrize("kind", ["realistic", "poor"])
def test_it_is_never_silently_wrong(walker, kind):
    """Poor soles miss the toes and bend the force witness by 70 ms; the stated uncertainty covers it, or there is no offset."""
    clocks = [find_clock(soles(walker, kind, -0.05, seed), film(walker, sd_m=0.03, seed=seed)) for seed in range(8)]
    for clock in clocks:
        if clock.refused:
            assert np.isnan(clock.offset_s)
        else:
            assert abs(clock.offset_s + 0.05) < 2.5 * clock.sd_s
            assert clock.sd_s <= LARGEST_SD_S
    assert kind == "poor" or not any(clock.refused for clock in clocks)


def test_swapped_feet_are_seen(walker):
    stream = soles(walker)
    swapped = replace(
        stream, vertical_n=stream.vertical_n[:, ::-1].copy(), cop_foot_m=stream.cop_foot_m[:, ::-1].copy()
    )
    assert not find_clock(stream, film(walker)).swapped
    clock = find_clock(swapped, film(walker))
    assert clock.swapped
    assert "fit the left foot" in clock.refused


@pytest.mark.parametrize("offset_s", [0.0, 0.2, 0.4, 0.6, 0.8])
def test_the_stream_of_another_walk_is_refused(stroller, walker, offset_s):
    clock = find_clock(soles(stroller, "clean", offset_s), film(walker))
    assert clock.refused


def test_an_offset_beyond_the_search_is_refused(walker):
    assert find_clock(soles(walker, "clean", 0.33), film(walker)).refused


def standing(times_s, need_n):
    still = np.zeros((len(times_s), 2, 3))
    return BodyCourse(
        times_s=times_s,
        need_n=need_n,
        com_lab_m=np.zeros((len(times_s), 3)),
        heel_lab_m=still,
        toe_lab_m=still + np.array([0.2, 0.0, 0.0]),
        weight_n=WEIGHT_N,
    )


def stream_of(total_n, times_s):
    force = np.stack([total_n / 2, total_n / 2], axis=1)
    return FootPressure(times_s=times_s, vertical_n=force, cop_foot_m=np.full((len(times_s), 2, 2), 0.1))


def test_standing_still_tells_nothing():
    rng = np.random.default_rng(0)
    video_s, soles_s = np.arange(180) / 60, np.arange(60) / 20
    clock = find_clock(
        stream_of(WEIGHT_N + rng.normal(0, 5, 60), soles_s), standing(video_s, WEIGHT_N + rng.normal(0, 5, 180))
    )
    assert "too little movement" in clock.refused


def test_squats_have_no_steps_but_force_enough():
    def need(times_s):
        return WEIGHT_N * (1 + 0.2 * np.sin(2 * np.pi * 0.7 * times_s) + 0.1 * np.sin(2 * np.pi * 1.7 * times_s))

    video_s, soles_s = np.arange(300) / 60, np.arange(100) / 20
    clock = find_clock(stream_of(need(soles_s), soles_s + 0.04), standing(video_s, need(video_s)))
    assert clock.events == 0
    assert clock.offset_s == pytest.approx(0.04, abs=0.004)


def test_lost_samples_are_no_evidence(walker):
    stream = soles(walker, "clean", 0.03)
    lost = (stream.times_s > 1.0) & (stream.times_s < 1.6)
    force = np.where(lost[:, None], np.nan, stream.vertical_n)
    clock = find_clock(replace(stream, vertical_n=force), film(walker))
    assert clock.offset_s == pytest.approx(0.03, abs=2 * clock.sd_s)
    nothing = replace(stream, vertical_n=np.full_like(force, np.nan))
    assert find_clock(nothing, film(walker)).refused
