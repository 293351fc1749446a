"""Recordings that went wrong, in the virtual laboratory: each is answered in words, and what is given is still right."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.kinematics.clinical import clinical_sd_deg, find_clinical_angles
from gonio.kernel.smoothing.filters import low_pass, median_filter
from gonio.kernel.triangulation.fusion import LONGEST_SPAN_S
from gonio.kernel.virtual_lab import PRESETS, film, make_rig, walk
from gonio.pipeline.body import scale_to_subject
from gonio.pipeline.checks import check_keypoints, leave_out_moved_cameras
from gonio.pipeline.motion import fit_motion
from gonio.pipeline.params import Parameters, ReconstructionParameters, Subject
from gonio.pipeline.reconstruction import hold_lengths, reconstruct, refine_cameras, smooth, synchronize
from gonio.pipeline.run import LocalRunner
from gonio.records import FILLED, MEASURED, MISSING, Finding, ImagePoints, LabPoints, MarkerSet, Rig, VirtualTrial, Walk
from gonio.resources import models_dir

RATE_HZ = 60.0
HALF = 144  # of the frames of a walk through the volume
CHOSEN = ReconstructionParameters()


@pytest.fixture(scope="module")
def blazepose33() -> MarkerSet:
    return read_markerset(models_dir() / "markersets" / "blazepose33.toml")


@pytest.fixture(scope="module")
def walker() -> Walk:
    return walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.25, start_m=-3.0)


@pytest.fixture(scope="module")
def trial(walker: Walk, blazepose33: MarkerSet) -> VirtualTrial:
    """A good detector in an ordinary rig, whose cameras stand still and bear the right names."""
    return film(walker, make_rig(), blazepose33, effects=PRESETS["paper"], rate_hz=RATE_HZ, seed=1)


@dataclass(frozen=True)
class Answer:
    points: LabPoints
    findings: dict[str, Finding]

    def error_mm(self, trial: VirtualTrial) -> float:
        return 1e3 * float(np.nanmean(np.linalg.norm(self.points.xyz_lab_m - trial.seen_lab_m, axis=-1)))


def river(points: ImagePoints, rig: Rig, parameters: ReconstructionParameters = CHOSEN) -> Answer:
    """The river from keypoints to smooth tracks. The walk is along X already: turning to the heading changes little."""
    run = LocalRunner()
    checked = run("checks", lambda _: check_keypoints(points, rig, parameters))
    _, synchronous = run("synchronization", lambda _: synchronize(checked, rig, parameters))
    steady = run("tripods", lambda _: leave_out_moved_cameras(synchronous, rig, parameters))
    refined = run("cameras", lambda _: refine_cameras(steady, rig, parameters))
    raw = run("triangulation", lambda _: reconstruct(steady, refined.rig, parameters))
    tracks = run("smoothing", lambda _: smooth(steady, raw, parameters))
    return Answer(points=hold_lengths(tracks, parameters), findings={f.code: f for f in run.findings})


def edited(points: ImagePoints, edit: Callable[[np.ndarray, np.ndarray], None]) -> ImagePoints:
    uv_px, confidence = points.uv_px.copy(), points.confidence.copy()
    edit(uv_px, confidence)
    return replace(points, uv_px=uv_px, confidence=confidence)


def darkened(trial: VirtualTrial, first: int, last: int, cameras: slice) -> ImagePoints:
    def darken(uv_px: np.ndarray, confidence: np.ndarray) -> None:
        uv_px[cameras, first:last], confidence[cameras, first:last] = np.nan, 0.0

    return edited(trial.points, darken)


def knocked(
    trial: VirtualTrial, walker: Walk, markerset: MarkerSet, camera: int, angle_deg: float, frame: int
) -> ImagePoints:
    """The recording of a rig whose one camera is turned, and shifted by 10 mm a degree, from a frame on."""
    turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * np.array([0.5, 0.8, 0.33])).as_matrix()
    T_cam_knocked = transform(turn, angle_deg * np.array([0.008, 0.0, 0.006]))
    cameras = list(trial.rig_true.cameras)
    cameras[camera] = replace(cameras[camera], T_lab_cam=cameras[camera].T_lab_cam @ T_cam_knocked)
    rig = replace(trial.rig_true, cameras=tuple(cameras))
    after = film(walker, rig, markerset, effects=PRESETS["paper"], rate_hz=RATE_HZ, seed=1).points

    def knock(uv_px: np.ndarray, confidence: np.ndarray) -> None:
        uv_px[camera, frame:], confidence[camera, frame:] = (
            after.uv_px[camera, frame:],
            after.confidence[camera, frame:],
        )

    return edited(trial.points, knock)


def test_a_recording_in_which_nothing_is_wrong_hears_nothing(trial: VirtualTrial) -> None:
    answer = river(trial.points, trial.rig)
    assert {f.stage for f in answer.findings.values()} <= {"triangulation"}
    assert answer.error_mm(trial) < 20


@pytest.mark.parametrize("smoothing", ["fusion", "median"])
def test_a_second_that_only_one_camera_saw_is_a_gap_and_said(trial: VirtualTrial, smoothing: str) -> None:
    points = darkened(trial, HALF, HALF + 60, slice(1, None))
    answer = river(points, trial.rig, replace(CHOSEN, smoothing=smoothing))
    said = answer.findings["too-few-cameras"]
    assert said.value == pytest.approx(1.0)
    assert said.where == "only cam1"
    assert said.span_s == pytest.approx((HALF / RATE_HZ, (HALF + 60) / RATE_HZ), abs=0.05)
    assert np.isnan(answer.points.xyz_lab_m[HALF : HALF + 60]).all()
    assert (answer.points.origin[HALF : HALF + 60] == MISSING).all()
    # What is known is as right as ever; without fusion over time, a burst of outliers at the gap's edge stays.
    assert answer.error_mm(trial) < (20 if smoothing == "fusion" else 30)


def test_the_body_is_fitted_around_a_dark_second_and_is_less_sure_at_its_edges(trial: VirtualTrial) -> None:
    points = darkened(trial, HALF, HALF + 60, slice(1, None))
    raw = reconstruct(points, trial.rig, CHOSEN).value
    tracks = hold_lengths(smooth(points, raw, CHOSEN).value, CHOSEN)
    body = scale_to_subject(tracks, Subject(sex="male")).value
    found = fit_motion(body, tracks, points, raw.rig, Parameters()).value
    assert found.fit is not None
    assert found.fit.converged
    assert not found.distrusted
    for angle in find_clinical_angles(found.model):
        if angle.name == "knee_flexion":
            sd_deg = clinical_sd_deg(found.motion, angle)
            # The looks are every second frame: the last one before the dark may lie a frame into it.
            assert np.isnan(sd_deg[HALF + 1 : HALF + 60]).all()
            known = np.flatnonzero(np.isfinite(sd_deg))
            edges = known[known < HALF + 30][-1], known[known > HALF + 30][0]
            assert sd_deg[list(edges)].min() > np.nanmedian(sd_deg)


@pytest.mark.parametrize("smoothing", ["fusion", "median"])
def test_tracks_end_where_the_observations_end(trial: VirtualTrial, smoothing: str) -> None:
    """The subject is seen from 1 s to 3 s only: nothing is invented before and after."""
    points = edited(
        trial.points, lambda uv, c: (uv.__setitem__(np.s_[:, :60], np.nan), c.__setitem__(np.s_[:, :60], 0))
    )
    points = edited(points, lambda uv, c: (uv.__setitem__(np.s_[:, 180:], np.nan), c.__setitem__(np.s_[:, 180:], 0)))
    answer = river(points, trial.rig, replace(CHOSEN, smoothing=smoothing))
    known = np.isfinite(answer.points.xyz_lab_m[..., 0])
    assert not known[:60].any()
    assert not known[180:].any()
    assert known[62:178].mean() > 0.9


def test_short_gaps_are_filled_and_marked_and_long_ones_are_not(trial: VirtualTrial, blazepose33: MarkerSet) -> None:
    frames = round(LONGEST_SPAN_S * RATE_HZ)  # a span of so many frames has one unknown frame less in it
    for missing, origin in ((frames - 1, FILLED), (frames, MISSING)):
        clear = film(trial.walk, make_rig(), blazepose33, effects=PRESETS["clean"], rate_hz=RATE_HZ, seed=1)
        points = darkened(clear, HALF, HALF + missing, slice(None))
        answer = river(points, clear.rig)
        trunk = answer.points.index("left_hip")
        assert (answer.points.origin[HALF : HALF + missing, trunk] == origin).all()
        assert answer.points.origin[HALF - 1, trunk] == answer.points.origin[HALF + missing, trunk] == MEASURED
        assert np.isnan(answer.points.xyz_lab_m[HALF, trunk, 0]) == (origin == MISSING)


def test_filters_leave_gaps_and_ends_as_they_are() -> None:
    track = np.sin(np.arange(200) / 9.0)[:, None] * np.ones(3)
    track[:20], track[90:120], track[185:] = np.nan, np.nan, np.nan
    smoothed = low_pass(median_filter(track, 5), RATE_HZ, 6.0)
    np.testing.assert_array_equal(np.isnan(smoothed), np.isnan(track))


@pytest.mark.parametrize(("camera", "angle_deg"), [(2, 1.0), (0, 2.0), (3, 6.0)])
def test_a_camera_that_was_moved_is_named_and_left_out_from_then_on(
    trial: VirtualTrial, walker: Walk, blazepose33: MarkerSet, camera: int, angle_deg: float
) -> None:
    frame = 150
    points = knocked(trial, walker, blazepose33, camera, angle_deg, frame)
    answer = river(points, trial.rig)
    said = answer.findings["camera-moved"]
    assert said.camera == f"cam{camera + 1}"
    assert said.where == f"{said.camera}; left out: what it saw after"
    assert said.span_s == pytest.approx((frame / RATE_HZ, frame / RATE_HZ), abs=0.3)
    # Three cameras instead of four, in half of the trial: without the check 1° costs 20 mm and 6° more than 100 mm.
    assert answer.error_mm(trial) < river(trial.points, trial.rig).error_mm(trial) + 6


def test_with_two_cameras_nobody_can_say_which_was_moved(
    trial: VirtualTrial, walker: Walk, blazepose33: MarkerSet
) -> None:
    points = knocked(trial, walker, blazepose33, 1, 4.0, 150)
    pair = replace(
        points, camera_names=points.camera_names[:2], uv_px=points.uv_px[:2], confidence=points.confidence[:2]
    )
    outcome = leave_out_moved_cameras(pair, replace(trial.rig, cameras=trial.rig.cameras[:2]), CHOSEN)
    (said,) = outcome.findings
    assert (said.code, said.severity) == ("camera-moved-unclear", "serious")
    assert said.where == "cam1 or cam2"
    np.testing.assert_array_equal(outcome.value.confidence, pair.confidence)


def test_two_exchanged_cameras_are_named_with_the_remedy(walker: Walk, blazepose33: MarkerSet) -> None:
    crooked = replace(make_rig(), cameras=(*make_rig().cameras[:3], make_rig(height_m=1.6, radius_m=4.0).cameras[3]))
    seen = film(walker, crooked, blazepose33, effects=PRESETS["mismatch"], rate_hz=RATE_HZ, seed=2)
    for a, b in ((0, 1), (1, 3), (0, 2)):
        order = np.arange(4)
        order[[a, b]] = b, a
        wrong = replace(seen.points, uv_px=seen.points.uv_px[order], confidence=seen.points.confidence[order])
        with pytest.raises(CaptureError, match=f"cam{a + 1} and cam{b + 1} are exchanged") as caught:
            check_keypoints(wrong, seen.rig, CHOSEN)
        assert caught.value.code == "cameras-exchanged"
        assert f"the video of cam{a + 1} with camera=cam{b + 1}" in caught.value.hint
    assert check_keypoints(seen.points, seen.rig, CHOSEN).findings == ()


def test_in_a_symmetric_rig_both_exchanges_that_explain_it_are_named(trial: VirtualTrial) -> None:
    wrong = replace(
        trial.points, uv_px=trial.points.uv_px[[2, 1, 0, 3]], confidence=trial.points.confidence[[2, 1, 0, 3]]
    )
    with pytest.raises(CaptureError) as caught:
        check_keypoints(wrong, trial.rig, CHOSEN)
    assert "cam1 and cam3" in caught.value.message
    assert "cam2 and cam4" in caught.value.message


def test_infinite_pixels_are_left_out_and_said(trial: VirtualTrial) -> None:
    bad = np.random.default_rng(3).random(trial.points.confidence.shape) < 0.05
    bad[[0, 2, 3]] = False
    bad &= trial.points.confidence > 0
    points = edited(trial.points, lambda uv, _c: uv.__setitem__(bad, [np.inf, -np.inf]))
    points = edited(points, lambda _uv, c: c.__setitem__((3, slice(0, 9), 4), np.nan))
    answer = river(points, trial.rig)
    assert answer.findings["keypoints-invalid"].where == "cam4"  # the last one said
    checked = check_keypoints(points, trial.rig, CHOSEN)
    assert [f.where for f in checked.findings] == ["cam2", "cam4"]
    assert checked.findings[0].value == pytest.approx(100 * bad[1].mean())
    assert np.isnan(checked.value.uv_px[bad]).all()
    assert answer.error_mm(trial) < 20


def test_zero_confidence_everywhere_is_an_error_with_a_remedy(trial: VirtualTrial) -> None:
    blind = edited(trial.points, lambda _uv, c: c.__setitem__(slice(None), 0.0))
    with pytest.raises(CaptureError, match="No keypoint is trusted by two cameras") as caught:
        check_keypoints(blind, trial.rig, CHOSEN)
    assert caught.value.code == "nothing-trusted"
    alone = darkened(trial, 0, len(trial.points.uv_px[0]), slice(1, None))
    with pytest.raises(CaptureError, match=r"cam1 0\.9"):
        check_keypoints(alone, trial.rig, CHOSEN)


def test_keypoints_with_foreign_names_are_an_error_that_says_which(trial: VirtualTrial) -> None:
    foreign = tuple(name.replace("left_hip", "LHip") for name in trial.points.keypoint_names)
    with pytest.raises(InputError, match=r"no keypoint left_hip; there are: .*LHip") as caught:
        check_keypoints(replace(trial.points, keypoint_names=foreign), trial.rig, CHOSEN)
    assert caught.value.code == "keypoint-names"
