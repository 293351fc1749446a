"""The real trial: four cameras, OpenPose's keypoints, nobody knows the truth, but the cameras must agree.

Held-out errors follow the rule of :func:`gonio.kernel.calibration.person.refine_on_person`: blocks of 0.17 s in turn, the
extrinsics refined on the ones, points triangulated by least squares in the others.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from gonio.bench import Bench
from gonio.bench.points.chain import Points, choose, find_motion, find_points
from gonio.bench.points.rivals import (
    MIN_CONFIDENCE,
    open_rivals,
    run_aniposelib,
    run_pose2sim,
    write_trial,
)
from gonio.bench.realism import read_balancing
from gonio.errors import GonioError
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.calibration.person import BLOCK_S, refine_on_person
from gonio.kernel.geometry.cameras import project
from gonio.kernel.kinematics.resample import resample
from gonio.kernel.synchronization.delays import estimate_delays
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.reconstruction import camera_bias_px
from gonio.records import ImagePoints, Rig, Timebase

_SEGMENTS = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"), ("heel", "big_toe"))
LIMBS = [(f"{side}_{start}", f"{side}_{end}") for side in ("left", "right") for start, end in _SEGMENTS]
WHOLE_FRAMES = ((2, 0, 0), (0, -3, 5), (-1, 4, -6))
HALF_FRAMES = ((1, 0, 0), (0, -3, 0), (1, 0, 5), (-1, 2, 3))
"""By how many frames of 60 Hz the second to the fourth camera run late; as half frames of 30 Hz in the second list."""

Track = Float[np.ndarray, "frame keypoint 3"]


def measure_balancing(bench: Bench, build_dir: Path) -> None:
    """Measure agreement of the cameras, steadiness of the limbs, jerk and synchronization.

    Raises:
        ResourceError: the recording is not there.
    """
    rig, points = read_balancing()
    chosen = choose(min_confidence=MIN_CONFIDENCE)
    refined = refine_on_person(rig, points, MIN_CONFIDENCE)
    bench.add("real_heldout_px", refined.error_after_px, "px", at_most=9.0)
    bench.add("real_heldout_px_unrefined", refined.error_before_px, "px")
    found = find_points(points, rig, chosen.reconstruction)
    bias_px = np.linalg.norm(camera_bias_px(found.raw.points), axis=1)
    bench.add("real_camera_bias_px", bias_px.max(), "px", at_most=2.0)
    _measure_steadiness(bench, "points_free", found.free.xyz_lab_m, points, worst_pct=4.7)
    _measure_steadiness(bench, "points", found.smooth.xyz_lab_m, points)
    _, motion = find_motion(points, found, chosen)
    bench.add("real_pixels_trusted", float(not motion.distrusted), "1")
    if motion.distrusted:
        bench.notes.append(f"real_*_pixels: an analysis would not report this fit, since {motion.distrusted}.")
    motion = _as_fitted(motion)
    placed = marker_positions(motion.model, np.nan_to_num(motion.motion.values))
    _measure_steadiness(bench, "pixels", _in_order(placed, motion, points), points, worst_pct=1.0)
    _measure_held_out_motion(bench, points, refined.rig)
    try:
        _measure_rivals(bench, build_dir, rig, points)
    except GonioError as error:
        bench.leave_out("real_*_pose2sim, real_*_aniposelib", error)
    _measure_synchronization(bench, rig, points)


def _as_fitted(motion: BodyMotion) -> BodyMotion:
    """Give what the fit to the pixels found, even where an analysis would distrust it: it is the fit that is measured."""
    fit = motion.fit
    if fit is None:
        return motion
    return replace(motion, motion=resample(fit.motion, motion.two_step.times_s), model=fit.model)


def _measure_steadiness(
    bench: Bench, who: str, xyz: Track, points: ImagePoints, worst_pct: float | None = None
) -> None:
    """Add the limbs' variation (standard deviation over mean, median of ten limbs) and the keypoints' jerk."""
    names = points.keypoint_names
    lengths = np.stack([np.linalg.norm(xyz[:, names.index(a)] - xyz[:, names.index(b)], axis=-1) for a, b in LIMBS])
    variation = 100 * np.nanstd(lengths, axis=1) / np.nanmean(lengths, axis=1)
    bench.add(f"real_limb_cv_{who}_pct", float(np.median(variation)), "%", at_most=worst_pct)
    ends = sorted({names.index(name) for limb in LIMBS for name in limb})
    jerk = np.diff(xyz[:, ends], n=3, axis=0) * points.timebase.rate_hz**3
    bench.add(f"real_jerk_{who}_m_s3", np.sqrt(np.nanmean((jerk**2).sum(axis=-1))), "m/s3")


def _measure_rivals(bench: Bench, build_dir: Path, rig: Rig, points: ImagePoints) -> None:
    folder, rivals = build_dir / "bench" / "balancing", open_rivals(build_dir)
    trial = write_trial(folder / "trial.npz", rig, points)
    pose2sim = run_pose2sim(rivals, trial, folder / "pose2sim", points.keypoint_names)
    aniposelib, _ = run_aniposelib(rivals, trial, folder / "aniposelib.npz", points.keypoint_names)
    for who, xyz in (("pose2sim_raw", pose2sim.raw), ("pose2sim", pose2sim.filtered), ("aniposelib", aniposelib)):
        _measure_steadiness(bench, who, xyz, points)
        bench.add(f"real_reprojection_{who}_px", float(np.nanmean(_errors_px(rig, points, xyz))), "px")


def _errors_px(rig: Rig, points: ImagePoints, xyz: Track) -> Float[np.ndarray, "camera frame keypoint"]:
    """Give each used observation's distance from a point's image, px."""
    error = np.linalg.norm(points.uv_px - np.stack([project(camera, xyz) for camera in rig.cameras]), axis=-1)
    return np.where(points.confidence >= MIN_CONFIDENCE, error, np.nan)


def _measure_held_out_motion(bench: Bench, points: ImagePoints, rig: Rig) -> None:
    """Hide every fourth observation, or a quarter of the 10-frame blocks of each camera, and see who foretells them.

    Points and body are found from the rest; the body's images carry its constant errors of camera and keypoint, the points'
    images carry the median residual of what was not hidden, so that both are treated alike.
    """
    for kind, hidden in _hide(points).items():
        seen = replace(
            points,
            uv_px=np.where(hidden[..., None], np.nan, points.uv_px),
            confidence=np.where(hidden, 0.0, points.confidence),
        )
        chosen = choose(min_confidence=MIN_CONFIDENCE, refine_cameras=False)
        found = find_points(seen, rig, chosen.reconstruction)
        _, motion = find_motion(seen, found, chosen)
        for way, error in _foretell(found, _as_fitted(motion), points, hidden).items():
            bench.add(f"real_hidden_{kind}_{way}_px", float(np.nanmean(error)), "px")
            bench.add(f"real_hidden_{kind}_{way}_median_px", float(np.nanmedian(error)), "px")


def _in_order(placed: Track, motion: BodyMotion, points: ImagePoints) -> Track:
    """Put markers in the order of the keypoints; NaN for those that the fit leaves out."""
    xyz = np.full((len(placed), len(points.keypoint_names), 3), np.nan)
    for column, name in enumerate(motion.model.markers.names):
        xyz[:, points.keypoint_names.index(name)] = placed[:, column]
    return xyz


def _hide(points: ImagePoints) -> dict[str, Bool[np.ndarray, "camera frame keypoint"]]:
    shape, rng = points.confidence.shape, np.random.default_rng(0)
    blocks = np.arange(shape[1]) // round(BLOCK_S * points.timebase.rate_hz)
    camera = np.arange(shape[0])[:, None, None]
    return {
        "observations": rng.random(shape) < 0.25,
        "blocks": np.broadcast_to((blocks[None, :, None] + camera) % 4 == 0, shape),
    }


def _foretell(
    found: Points, motion: BodyMotion, points: ImagePoints, hidden: Bool[np.ndarray, "camera frame keypoint"]
) -> dict[str, Float[np.ndarray, " hidden"]]:
    """Give the errors with which points and body foretell the hidden observations, where both do."""
    cameras = found.raw.rig.cameras
    ways = {
        "points": found.smooth.xyz_lab_m,
        "pixels": _in_order(marker_positions(motion.model, motion.motion.values), motion, points),
    }
    usable = points.confidence >= MIN_CONFIDENCE
    residual: dict[str, np.ndarray] = {}
    for way, xyz in ways.items():
        error = points.uv_px - np.stack([project(camera, xyz) for camera in cameras])
        known = np.where((usable & ~hidden)[..., None], error, np.nan)
        many = np.isfinite(known[..., 0]).sum(axis=1) > 10
        bias = np.where(many[..., None], np.nanmedian(np.where(many[:, None, :, None], known, 0.0), axis=1), 0.0)
        residual[way] = np.linalg.norm(error - bias[:, None], axis=-1)
    judged = hidden & usable & np.isfinite(residual["points"]) & np.isfinite(residual["pixels"])
    return {way: error[judged] for way, error in residual.items()}


def _measure_synchronization(bench: Bench, rig: Rig, points: ImagePoints) -> None:
    """Let cameras run late by known numbers of frames; and let the subject stand still."""
    rate_hz = points.timebase.rate_hz
    answer = estimate_delays(rig, points, MIN_CONFIDENCE)
    bench.add("sync_real_frames", np.abs(answer.delay_s).max() * rate_hz, "frames", at_most=0.0)
    for name, shifts, keep, worst in (("whole", WHOLE_FRAMES, 1, 0.0), ("half", HALF_FRAMES, 2, 0.1)):
        errors: list[float] = []
        for frames in shifts:
            late = np.array((0, *frames)) / keep
            answer = estimate_delays(rig, _delayed(points, (0, *frames), keep), MIN_CONFIDENCE)
            errors.append(float(np.abs(answer.delay_s * rate_hz / keep - late).max()))
        bench.add(f"sync_{name}_frame_error_frames", round(max(errors), 9), "frames", at_most=worst)
    still = replace(
        points,
        uv_px=np.repeat(points.uv_px[:, :1], points.uv_px.shape[1], axis=1),
        confidence=np.repeat(points.confidence[:, :1], points.uv_px.shape[1], axis=1),
    )
    shaken = replace(still, uv_px=still.uv_px + np.random.default_rng(0).normal(0, 3.0, still.uv_px.shape))
    refused = all(estimate_delays(rig, clip, MIN_CONFIDENCE).status == "unknown" for clip in (still, shaken))
    bench.add("sync_refuses_motionless", float(refused), "1", at_least=1.0)


def _delayed(points: ImagePoints, late_frames: tuple[int, ...], keep: int = 1) -> ImagePoints:
    """Make cameras run late: they show at frame ``t`` what happened at ``t − late``; then keep every ``keep``-th frame.

    With every second frame of two, a frame of the recording is half a frame, and nothing is made up in between.
    """
    uv_px, confidence = np.full_like(points.uv_px, np.nan), np.zeros_like(points.confidence)
    frames = np.arange(points.uv_px.shape[1])
    for camera, late in enumerate(late_frames):
        inside = (frames - late >= 0) & (frames - late < len(frames))
        uv_px[camera, inside] = points.uv_px[camera, (frames - late)[inside]]
        confidence[camera, inside] = points.confidence[camera, (frames - late)[inside]]
    return replace(
        points,
        timebase=Timebase(rate_hz=points.timebase.rate_hz / keep),
        uv_px=uv_px[:, ::keep],
        confidence=confidence[:, ::keep],
    )
