"""Events, cycles and parameters of walks whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from gonio.formats.osim import read_osim
from gonio.kernel.gait.cycles import average, cut_cycles, leave_out_odd, normalise
from gonio.kernel.gait.events import events_from_force, events_from_movement, fuse, steady
from gonio.kernel.gait.parameters import measure_gait, symmetry_index_percent
from gonio.kernel.gait.paths import bridge_gaps, foot_paths
from gonio.kernel.gait.phases import phase_bounds
from gonio.kernel.gait.progression import find_bouts
from gonio.kernel.virtual_lab import truth_at, walk
from gonio.records import (
    EventTrain,
    FootPaths,
    GaitCycle,
    GaitEvents,
    Measure,
    Motion,
    Timebase,
    Walk,
    WalkTruth,
)
from gonio.resources import models_dir

RATE_HZ = 60.0
SECONDS = 5.0


@pytest.fixture(scope="module", params=[0.8, 1.25, 1.6])
def trial(request: pytest.FixtureRequest) -> tuple[Walk, WalkTruth, FootPaths]:
    walker = walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), request.param)
    return walker, *_seen(walker)


def _seen(walker: Walk) -> tuple[WalkTruth, FootPaths]:
    times_s = 0.013 + np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    truth = truth_at(walker, times_s)
    motion = Motion(
        coordinate_names=truth.coordinate_names,
        rotational=walker.body.coordinates.rotational,
        times_s=times_s,
        values=truth.q,
        status=np.zeros(len(times_s), dtype=np.uint8),
        iterations=np.zeros(len(times_s), dtype=int),
        residual_rms_m=np.zeros(len(times_s)),
    )
    paths = foot_paths(walker.body, motion, Timebase(rate_hz=RATE_HZ))
    assert paths is not None
    return truth, paths


def _turned(paths: FootPaths, yaw_rad: float, drift_m_s: float = 0.0) -> FootPaths:
    """The same walk seen from elsewhere: turned about the vertical, or from beside a belt."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    drift_m = np.outer(paths.timebase.times_s(len(paths.pelvis_lab_m)), [drift_m_s, 0.0, 0.0])
    return replace(
        paths,
        heel_lab_m=(paths.heel_lab_m + drift_m[:, None]) @ turn.T,
        toe_lab_m=(paths.toe_lab_m + drift_m[:, None]) @ turn.T,
        pelvis_lab_m=(paths.pelvis_lab_m + drift_m) @ turn.T,
    )


def _errors_frames(
    events: GaitEvents, truth: WalkTruth, edges_s: tuple[float, float] = (0.2, 0.3)
) -> tuple[list[float], int]:
    """How far found events are from the nearest true ones, and how many true ones well inside the trial were missed."""
    errors: list[float] = []
    missed = 0
    for foot in (0, 1):
        for found, true in (
            (events.strikes[foot].frames, truth.events[foot].strike_frames),
            (events.lifts[foot].frames, truth.events[foot].lift_frames),
        ):
            errors += [float(f - true[np.argmin(np.abs(true - f))]) for f in found]
            inside = true[(true > edges_s[0] * RATE_HZ) & (true < len(truth.times_s) - 1 - edges_s[1] * RATE_HZ)]
            missed += sum(np.min(np.abs(found - t), initial=np.inf) > 0.1 * RATE_HZ for t in inside)
    return errors, missed


def test_events_from_movement(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    _, truth, paths = trial
    errors, missed = _errors_frames(events_from_movement(paths, find_bouts(paths)), truth, (0.1, 0.1))
    assert missed == 0
    # One frame at 60 Hz is 17 ms; measured: 11 ms at most.
    assert np.max(np.abs(errors)) < 1.0


@pytest.mark.parametrize("from_frame", [0, 15, 40, 65])
def test_a_stride_that_the_recording_cuts_shows_its_event(
    trial: tuple[Walk, WalkTruth, FootPaths], from_frame: int
) -> None:
    """Wherever a recording of 1.5 s begins, events more than 0.1 s from its ends are found, once, and no others are."""
    _, truth, paths = trial
    part = slice(from_frame, from_frame + 90)
    cut = replace(
        paths,
        heel_lab_m=paths.heel_lab_m[part],
        toe_lab_m=paths.toe_lab_m[part],
        pelvis_lab_m=paths.pelvis_lab_m[part],
    )
    events = events_from_movement(cut, find_bouts(cut))
    for foot in (0, 1):
        for found, true in (
            (events.strikes[foot].frames, truth.events[foot].strike_frames),
            (events.lifts[foot].frames, truth.events[foot].lift_frames),
        ):
            apart = np.abs(true[:, None] - from_frame - found)
            inner = (true - from_frame > 0.1 * RATE_HZ) & (true - from_frame < 89 - 0.1 * RATE_HZ)
            assert np.all(apart[inner].min(axis=1, initial=np.inf) < 1.0)
            assert np.all(apart.min(axis=0) < 1.0)
            assert len(found) <= np.sum((true > from_frame - 1) & (true < from_frame + 90))


def test_a_trials_strides_calibrate_each_other() -> None:
    """Exact instants scatter by 0.5 frames about the reach + 6: what is left is the reach's own, and a limp stays."""
    rng = np.random.default_rng(3)
    reach = 20.0 + 100.0 * np.arange(40)
    noisy = [np.column_stack([reach + 6.0 + 0.5 * rng.standard_normal(40), reach]) for _ in (0, 1)]
    noisy[0][4, 0] = np.nan
    for found in steady(noisy[0], noisy[1], 100.0):
        # The mean of 79 is known to 0.5/√79 = 0.06; it is the same for all.
        assert_allclose(found, reach + 6.0, atol=0.2)
        assert_allclose(np.diff(found), 100.0)
    limping = noisy[1] + [2.0, 0.0]
    right, left = steady(noisy[0], limping, 100.0)
    assert_allclose(left.mean() - right.mean(), 2.0, atol=0.4)
    # With an event of each foot nothing tells a limp from noise but the noise's usual size, 0.45 frames.
    right, left = steady(np.array([[26.0, 20.0]]), np.array([[76.5, 70.0]]), 100.0)
    assert_allclose([*right, *left], [26.25, 76.25])
    nothing = np.empty((0, 2))
    assert steady(nothing, nothing, 100.0)[0].size == 0
    assert_allclose(steady(np.array([[np.nan, 50.0]]), nothing, 100.0)[0], [50.0])


@pytest.mark.parametrize("yaw_deg", [0.0, 77.0, 180.0])
@pytest.mark.parametrize("belt_m_s", [0.0, 1.25])
def test_events_whichever_way_and_on_a_belt(
    trial: tuple[Walk, WalkTruth, FootPaths], yaw_deg: float, belt_m_s: float
) -> None:
    _, _, paths = trial
    plain = events_from_movement(paths, find_bouts(paths))
    moved_paths = _turned(paths, np.deg2rad(yaw_deg), -belt_m_s)
    moved = events_from_movement(moved_paths, find_bouts(moved_paths))
    for a, b in zip(plain.strikes + plain.lifts, moved.strikes + moved.lifts, strict=True):
        # The belt's speed is a median over frames: 1 % of the walking speed, a tenth of a frame.
        assert_allclose(a.frames, b.frames, atol=0.15)


def test_feet_that_slip_under_a_pelvis_that_goes_on_are_on_no_belt(
    trial: tuple[Walk, WalkTruth, FootPaths],
) -> None:
    _, _, paths = trial
    slipping, on_belt = (find_bouts(_turned(paths, 0.0, -speed_m_s))[0] for speed_m_s in (0.3, 1.25))
    assert slipping.belt_m_s == 0.0
    assert_allclose(on_belt.belt_m_s, -1.25, atol=0.03)


def test_events_from_force(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    walker, truth, _ = trial
    events = events_from_force(truth.times_s, truth.wrench[..., 1], Timebase(rate_hz=RATE_HZ, start_s=0.013))
    _, missed = _errors_frames(events, truth)
    assert missed == 0
    for foot, trains in enumerate(zip(events.strikes, events.lifts, strict=True)):
        for train in trains:
            around = train.frames[:, None] + np.array([-0.5, 0.5])
            force_n = truth_at(walker, 0.013 + around.ravel() / RATE_HZ).wrench[:, foot, 1].reshape(-1, 2)
            # Between two frames, the straight line passes 20 N within half a frame of where the force does.
            assert np.all((force_n - 20.0)[:, 0] * (force_n - 20.0)[:, 1] <= 0.0)


def test_a_contact_that_begins_beside_the_plate_has_no_strike() -> None:
    force_n = np.concatenate([np.full(20, np.nan), np.full(30, 700.0), np.zeros(30), np.full(30, 700.0)])
    events = events_from_force(
        np.arange(110) / 100.0, np.stack([force_n, np.zeros(110)], axis=1), Timebase(rate_hz=100.0)
    )
    # From 0 to 700 N in a frame, 20 N are passed after 20/700 of it; the last contact is cut by the recording's end.
    assert_allclose(events.strikes[0].frames, [79.0 + 20 / 700])
    assert_allclose(events.lifts[0].frames, [49.0 + 680 / 700])
    assert events.strikes[1].frames.size == 0


def test_a_short_break_is_no_lift_and_a_short_knock_no_contact() -> None:
    force_n = np.zeros(200)
    force_n[20:80] = 700.0
    force_n[50:55] = 0.0  # 50 ms
    force_n[150:155] = 700.0
    events = events_from_force(
        np.arange(200) / 100.0, np.stack([force_n, np.zeros(200)], axis=1), Timebase(rate_hz=100.0)
    )
    assert len(events.strikes[0].frames) == len(events.lifts[0].frames) == 1


def _events(frames: list[float], sd_s: float, *, force: bool) -> GaitEvents:
    count = len(frames)
    train = EventTrain(frames=np.array(frames), sd_s=np.full(count, sd_s), from_force=np.full(count, force))
    return GaitEvents(strikes=(train, train), lifts=(train, train))


def test_a_sure_force_is_taken_and_movement_fills_in() -> None:
    moved = _events([20.0, 103.0, 200.0], 0.015, force=False)
    fused = fuse(_events([100.0], 0.005, force=True), moved, 100.0).strikes[0]
    assert_allclose(fused.frames, [20.0, 100.0, 200.0])
    assert fused.from_force.tolist() == [False, True, False]
    assert_allclose(fuse(_events([], 0.005, force=True), moved, 100.0).lifts[1].frames, [20.0, 103.0, 200.0])


def test_a_slow_sensor_confines_the_movement() -> None:
    # Twenty samples a second say no more than that the load began between two of them: 50 ms / √12 = 14 ms.
    vertical_n = np.array([0.0, 0.0, 400.0, 700.0, 700.0, 0.0])[:, None] * [1.0, 0.0]
    slow = events_from_force(np.arange(6) / 20.0, vertical_n, Timebase(rate_hz=100.0))
    assert_allclose(slow.strikes[0].frames, [7.5])
    assert_allclose(slow.lifts[0].frames, [22.5])
    sd_s = float(slow.strikes[0].sd_s[0])
    assert sd_s == pytest.approx(np.hypot(0.005, 0.05 / np.sqrt(12)))
    for moved, least, most in ((7.5, 7.5, 7.5), (9.0, 8.2, 9.0), (6.0, 6.0, 6.8), (11.0, 8.5, 10.1), (0.0, 7.5, 7.5)):
        fused = fuse(slow, _events([moved], 0.015, force=False), 100.0).strikes[0]
        assert least - 1e-9 <= fused.frames[0] <= most + 1e-9
        assert fused.sd_s[0] <= sd_s + 1e-12


def test_turning_round_is_cut_out(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    _, _, paths = trial
    half = len(paths.pelvis_lab_m) // 2
    yaw = np.pi / (1.0 + np.exp(-(np.arange(2 * half) - half) / 8.0))  # an about-turn within a second

    def turn(points: np.ndarray) -> np.ndarray:
        centred = points - paths.pelvis_lab_m[half] * [1.0, 0.0, 1.0]
        c, s = np.cos(yaw), np.sin(yaw)
        shape = (-1, *[1] * (points.ndim - 2))
        c, s = c.reshape(shape), s.reshape(shape)
        return np.stack(
            [c * centred[..., 0] - s * centred[..., 2], centred[..., 1], s * centred[..., 0] + c * centred[..., 2]], -1
        )

    turning = replace(
        paths,
        heel_lab_m=turn(paths.heel_lab_m),
        toe_lab_m=turn(paths.toe_lab_m),
        pelvis_lab_m=turn(paths.pelvis_lab_m),
    )
    bouts = find_bouts(turning)
    assert len(bouts) == 2
    assert bouts[0].stop < half < bouts[1].start
    assert bouts[0].forward_lab @ bouts[1].forward_lab < -0.95
    cycles = cut_cycles(events_from_movement(turning, bouts), turning, bouts)
    assert all(c.end_frame < half or c.start_frame > half for c in cycles)


def test_a_lost_moment_does_not_cut_the_walk(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    _, _, paths = trial
    heel_m = paths.heel_lab_m.copy()
    heel_m[100:104, 0] = np.nan  # 67 ms
    heel_m[200:215, 1] = np.nan  # 250 ms
    bridged = bridge_gaps(replace(paths, heel_lab_m=heel_m))
    assert np.flatnonzero(np.isnan(bridged.heel_lab_m).any(axis=(1, 2))).tolist() == list(range(200, 215))
    # A heel that speeds up by 30 m/s² is 30 (5/60)² / 8 = 26 mm off the line across five frames.
    assert_allclose(bridged.heel_lab_m[100:104, 0], paths.heel_lab_m[100:104, 0], atol=0.026)
    assert len(find_bouts(bridged)) == 2


def test_standing_has_no_events() -> None:
    rng = np.random.default_rng(0)
    feet = np.tile([[0.0, 0.0, 0.1], [0.0, 0.0, -0.1]], (300, 1, 1))
    sway = 0.02 * np.sin(np.arange(300) / 40.0)[:, None] * [1.0, 0.0, 0.3] + [0.1, 0.9, 0.0]
    paths = FootPaths(
        timebase=Timebase(rate_hz=100.0),
        heel_lab_m=feet + rng.normal(0, 0.001, feet.shape),
        toe_lab_m=feet + np.array([0.25, 0.0, 0.0]) + rng.normal(0, 0.001, feet.shape),
        pelvis_lab_m=sway,
    )
    bouts = find_bouts(paths)
    assert len(bouts) == 1
    events = events_from_movement(paths, bouts)
    assert all(t.frames.size == 0 for t in events.strikes + events.lifts)
    assert cut_cycles(events, paths, bouts) == ()
    assert measure_gait(events, (), paths, bouts) == ()


def test_cycles_and_parameters(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    walker, _, paths = trial
    steps = walker.steps
    bouts = find_bouts(paths)
    events = events_from_movement(paths, bouts)
    cycles = cut_cycles(events, paths, bouts)
    assert {c.foot for c in cycles} == {0, 1}
    for cycle in cycles:
        marks = [edge for edge, _ in phase_bounds(cycle).values()]
        assert marks == sorted(marks)
        assert 2.0 < marks[1] < 25.0 < marks[2] < marks[3] < 75.0
    measured = {(m.name, m.side): m.mean for m in measure_gait(events, cycles, paths, bouts)}
    # The same bias at every contact cancels in whole strides; a tenth of a frame of 60 to 80 in a stride is 0.2 %.
    assert measured["speed", "both"] == pytest.approx(steps.speed_m_s, rel=0.005)
    assert measured["cadence", "both"] == pytest.approx(120.0 / steps.stride_s, rel=0.005)
    assert measured["stride length", "left"] == pytest.approx(steps.speed_m_s * steps.stride_s, rel=0.005)
    # The heel is still on its way, by some millimetres forward (both alike) and up to 1 cm a foot sideways.
    assert measured["step length", "left"] == pytest.approx(0.5 * steps.speed_m_s * steps.stride_s, rel=0.02)
    assert measured["step width", "both"] == pytest.approx(steps.heel_z_m[0] - steps.heel_z_m[1], abs=0.02)
    # Two events, each off by up to 1.7 of at least 58 frames a stride.
    assert measured["stance", "right"] == pytest.approx(100 * steps.stance[0], abs=4.5)
    assert measured["double support", "right"] == pytest.approx(100 * (2 * steps.stance[0] - 1), abs=9.0)


def test_curves_over_the_cycle_are_those_of_time(trial: tuple[Walk, WalkTruth, FootPaths]) -> None:
    walker, truth, paths = trial
    bouts = find_bouts(paths)
    cycles = cut_cycles(events_from_movement(paths, bouts), paths, bouts)
    knee_deg = np.degrees(truth.of("knee_angle_r"))
    curves = np.stack([normalise(knee_deg, c) for c in cycles if c.foot == 0])
    mean = average(curves)
    # A steady walk repeats itself: cycles differ by the straight lines between frames, 10⁴ °/s² · (1/60 s)² / 8 = 0.35°.
    assert np.nanmax(mean.sd) < 0.4
    first = next(c for c in cycles if c.foot == 0)
    exact = truth_at(walker, 0.013 + np.linspace(first.start_frame, first.end_frame, 101) / RATE_HZ)
    assert_allclose(curves[0], np.degrees(exact.of("knee_angle_r")), atol=0.36)


def _cycle(start: float, end: float, foot: int = 0) -> GaitCycle:
    nan = float("nan")
    return GaitCycle(
        foot=foot,
        start_frame=start,
        other_lift_frame=nan,
        heel_off_frame=nan,
        other_strike_frame=nan,
        lift_frame=nan,
        end_frame=end,
    )


def test_values_beside_a_gap_are_unknown_and_others_are_not() -> None:
    values = np.arange(201.0)
    values[50] = np.nan
    curve = normalise(values, _cycle(0.0, 200.0))
    assert np.flatnonzero(np.isnan(curve)).tolist() == [25]
    assert_allclose(np.delete(curve, 25), np.delete(np.linspace(0.0, 200.0, 101), 25))


def test_odd_cycles_are_named_with_the_reason() -> None:
    base = 30.0 + 30.0 * np.sin(np.linspace(0, 2 * np.pi, 101))
    rng = np.random.default_rng(1)
    curves = base + rng.normal(0, 1.0, (6, 1))
    curves[2] += 25.0
    curves[4, :30] = np.nan
    cycles = [_cycle(100.0 * i, 100.0 * i + (150.0 if i == 5 else 100.0)) for i in range(6)]
    judged = leave_out_odd(cycles, {"knee flexion": curves}, 100.0)
    assert [bool(c.left_out) for c in judged] == [False, False, True, False, True, True]
    assert "off the other cycles" in judged[2].left_out
    assert "not known in 30 %" in judged[4].left_out
    assert "it takes 1.50 s" in judged[5].left_out


def test_two_cycles_cannot_judge_each_other() -> None:
    curves = np.stack([np.zeros(101), np.full(101, 40.0)])
    judged = leave_out_odd([_cycle(0.0, 100.0), _cycle(100.0, 200.0)], {"knee flexion": curves}, 100.0)
    assert not any(c.left_out for c in judged)


def test_average_counts_what_is_known() -> None:
    curves = np.array([[1.0, np.nan, np.nan], [3.0, 5.0, np.nan]])
    mean = average(curves)
    assert_allclose(mean.mean, [2.0, 5.0, np.nan])
    assert_allclose(mean.sd, [np.sqrt(2.0), np.nan, np.nan])


def test_symmetry_and_single_values() -> None:
    assert symmetry_index_percent(0.6, 0.6) == 0.0
    assert symmetry_index_percent(0.66, 0.54) == pytest.approx(20.0)
    assert np.isnan(Measure(name="speed", side="both", unit="m/s", values=np.array([1.2])).sd)
