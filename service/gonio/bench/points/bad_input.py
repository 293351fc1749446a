"""Recordings that went wrong, on the way of an analysis: is it said, by name, and is what is given still right?"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gonio.bench import Bench
from gonio.bench.points.ladder import film_paper
from gonio.errors import CaptureError
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.kinematics.clinical import clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.kernel.virtual_lab import make_rig
from gonio.pipeline.body import scale_to_subject
from gonio.pipeline.checks import check_keypoints, leave_out_moved_cameras
from gonio.pipeline.motion import fit_motion
from gonio.pipeline.params import Parameters, Subject
from gonio.pipeline.reconstruction import hold_lengths, reconstruct, refine_cameras, smooth, synchronize
from gonio.pipeline.run import LocalRunner
from gonio.records import ImagePoints, Rig, VirtualTrial

RATE_HZ = 60.0
SEED = 1
DARK = slice(144, 204)
KNOCKED_FRAME, KNOCKED_CAMERA = 150, 2
KNOCK_RAD, KNOCK_M = 0.02, 0.01
Index = tuple[int | slice, ...] | slice

BESIDE_S = 0.25
"""How far the edges of a dark second reach: further away the body is as well known as ever."""


def measure_bad_input(bench: Bench) -> None:
    """Let five things go wrong, each in a recording of preset ``paper``.

    ``bad_*_said`` is 1 where the finding or the error names what is wrong; ``bad_*_mm`` is the mean error of the points that
    are given all the same, beside ``bad_nothing_mm`` of the recording before it was spoiled.
    """
    trial = film_paper(SEED, RATE_HZ, start_m=-3.0)
    bench.add("bad_nothing_mm", _go(trial, trial.points)[1], "mm")
    dark = _spoilt(trial.points, np.s_[1:, DARK], np.nan, 0.0)
    said, error_mm = _go(trial, dark)
    bench.add("bad_dark_second_said", float(said.get("too-few-cameras", "").startswith("only cam1")), "1", at_least=1.0)
    bench.add("bad_dark_second_mm", error_mm, "mm")
    bench.add("bad_dark_second_coverage95_knee_pct", _cover_beside(trial, dark), "%")
    said, error_mm = _go(trial, _knock(trial))
    named = said.get("camera-moved", "").startswith(f"cam{KNOCKED_CAMERA + 1};")
    bench.add("bad_moved_camera_said", float(named), "1", at_least=1.0)
    bench.add("bad_moved_camera_mm", error_mm, "mm")
    wild = _spoilt(_spoilt(trial.points, np.s_[1, ::7, ::3], np.inf, None), np.s_[3, :9, 4], None, np.nan)
    said, error_mm = _go(trial, wild)
    bench.add("bad_infinite_pixels_said", float("keypoints-invalid" in said), "1", at_least=1.0)
    bench.add("bad_infinite_pixels_mm", error_mm, "mm")
    blind = _spoilt(trial.points, np.s_[:], None, 0.0)
    bench.add("bad_zero_confidence_said", float(_refusal(blind, trial.rig)[0] == "nothing-trusted"), "1", at_least=1.0)
    bench.add("bad_exchanged_cameras_said", _exchange(), "1", at_least=1.0)


def _go(trial: VirtualTrial, points: ImagePoints) -> tuple[dict[str, str], float]:
    """Go the way from keypoints to smooth points; give what the findings say where, and the points' mean error, mm."""
    run, chosen = LocalRunner(), Parameters().reconstruction
    checked = run("checks", lambda _: check_keypoints(points, trial.rig, chosen))
    _, synchronous = run("synchronization", lambda _: synchronize(checked, trial.rig, chosen))
    steady = run("tripods", lambda _: leave_out_moved_cameras(synchronous, trial.rig, chosen))
    refined = run("cameras", lambda _: refine_cameras(steady, trial.rig, chosen))
    raw = run("triangulation", lambda _: reconstruct(steady, refined.rig, chosen))
    found = hold_lengths(run("smoothing", lambda _: smooth(steady, raw, chosen)), chosen)
    # The walk is along X: turning to the heading changes little.
    error_mm = 1e3 * float(np.nanmean(np.linalg.norm(found.xyz_lab_m - trial.seen_lab_m, axis=-1)))
    return {finding.code: finding.where for finding in run.findings}, error_mm


def _spoilt(points: ImagePoints, where: Index, pixels: float | None, confidence: float | None) -> ImagePoints:
    """Overwrite some of the keypoints' places, or their confidences."""
    uv_px, trust = points.uv_px.copy(), points.confidence.copy()
    if pixels is not None:
        uv_px[where] = pixels
    if confidence is not None:
        trust[where] = confidence
    return replace(points, uv_px=uv_px, confidence=trust)


def _knock(trial: VirtualTrial) -> ImagePoints:
    """Turn one camera by a degree and shift it by a centimetre in mid-trial."""
    turn = Rotation.from_rotvec(KNOCK_RAD * np.array([0.5, 0.8, 0.33])).as_matrix()
    T_cam_knocked = transform(turn, KNOCK_M * np.array([0.8, 0.0, 0.6]))
    cameras = list(trial.rig_true.cameras)
    before = cameras[KNOCKED_CAMERA]
    cameras[KNOCKED_CAMERA] = replace(before, T_lab_cam=before.T_lab_cam @ T_cam_knocked)
    rig = replace(trial.rig_true, cameras=tuple(cameras))
    after = film_paper(SEED, RATE_HZ, start_m=-3.0, rig=rig).points
    uv_px, trust = trial.points.uv_px.copy(), trial.points.confidence.copy()
    later = np.s_[KNOCKED_CAMERA, KNOCKED_FRAME:]
    uv_px[later], trust[later] = after.uv_px[later], after.confidence[later]
    return replace(trial.points, uv_px=uv_px, confidence=trust)


def _refusal(points: ImagePoints, rig: Rig) -> tuple[str, str]:
    """Give the code and the message with which keypoints are refused, empty where they are not."""
    try:
        check_keypoints(points, rig, Parameters().reconstruction)
    except CaptureError as error:
        return error.code, error.message
    return "", ""


def _exchange() -> float:
    """Exchange each pair of cameras of a rig without symmetry; give the share of pairs that is named."""
    crooked = replace(make_rig(), cameras=(*make_rig().cameras[:3], make_rig(height_m=1.6, radius_m=4.0).cameras[3]))
    seen = film_paper(SEED, RATE_HZ, start_m=-3.0, rig=crooked)
    named: list[bool] = []
    for a in range(4):
        for b in range(a + 1, 4):
            order = np.arange(4)
            order[[a, b]] = b, a
            wrong = replace(seen.points, uv_px=seen.points.uv_px[order], confidence=seen.points.confidence[order])
            code, message = _refusal(wrong, seen.rig)
            named.append(code == "cameras-exchanged" and f"cam{a + 1} and cam{b + 1}" in message)
    return float(np.mean(named))


def _cover_beside(trial: VirtualTrial, points: ImagePoints) -> float:
    """Give how often the knees' 95 % bands hold the truth beside a dark second, in per cent."""
    chosen = Parameters()
    raw = reconstruct(points, trial.rig, chosen.reconstruction).value
    found_points = hold_lengths(smooth(points, raw, chosen.reconstruction).value, chosen.reconstruction)
    body = scale_to_subject(found_points, Subject(sex="male")).value
    found = fit_motion(body, found_points, points, raw.rig, chosen).value
    truth = replace(found.motion, coordinate_names=trial.truth.coordinate_names, values=trial.truth.q)
    reach = round(BESIDE_S * RATE_HZ)
    beside = np.r_[DARK.start - reach : DARK.start, DARK.stop : DARK.stop + reach]
    inside: list[np.ndarray] = []
    for angle in find_clinical_angles(found.model):
        if angle.name == "knee_flexion":
            error = clinical_deg(found.motion, angle) - clinical_deg(truth, angle)
            known = beside[np.isfinite(error[beside])]
            inside.append(np.abs(error[known]) < 1.96 * clinical_sd_deg(found.motion, angle)[known])
    return 100 * float(np.concatenate(inside).mean())
