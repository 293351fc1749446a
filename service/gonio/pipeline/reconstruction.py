"""From keypoints in the images to points in the lab, judged: stages ``synchronization`` to ``smoothing``."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.formats.calibration import read_own_calibration
from gonio.kernel.calibration.lab_frame import heading_rad
from gonio.kernel.calibration.person import PersonRefinement, refine_on_person, unrefined
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import rotation_about_y, transform
from gonio.kernel.smoothing.filters import low_pass, median_filter, median_window
from gonio.kernel.synchronization.delays import (
    SMALLEST_DELAY_FRAMES,
    Synchronization,
    confirm_delays,
    estimate_delays,
    trusted,
)
from gonio.kernel.synchronization.looks import shift
from gonio.kernel.triangulation.fusion import fuse, mark_spans
from gonio.kernel.triangulation.points import triangulate
from gonio.kernel.triangulation.segments import hold_segments
from gonio.pipeline.findings import finding
from gonio.pipeline.moments import longest_stretch, worst_moment
from gonio.pipeline.params import ReconstructionParameters
from gonio.pipeline.run import CaptureFile, Outcome
from gonio.pipeline.trial_lab import find_trial_lab, move_lab
from gonio.records import MEASURED, MISSING, Finding, ImagePoints, LabPoints, LabSource, Rig, record

SEGMENTS: dict[str, tuple[str, str]] = {
    f"{side} {segment}": (f"{side}_{start}", f"{side}_{end}")
    for segment, start, end in (
        ("thigh", "hip", "knee"),
        ("shank", "knee", "ankle"),
        ("upper arm", "shoulder", "elbow"),
        ("forearm", "elbow", "wrist"),
    )
    for side in ("right", "left")
}
"""The segments whose length must not change: the cheapest test of a reconstruction."""

LEG_KEYPOINTS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle"))


@record
class Reconstruction:
    """Points in the lab, the rig turned with them, and how far the cameras agreed.

    ``camera_weight`` is what the robust loss left to each observation (0 where there was none). ``miss_m`` is each
    observation's reprojection error at the point's depth. ``R_lab_calibrated`` turns the lab as it was calibrated, in which
    force plates and mats lie, to this one.
    """

    rig: Rig
    points: LabPoints
    camera_weight: Float[np.ndarray, "camera frame keypoint"]
    miss_m: Float[np.ndarray, "camera frame keypoint"]
    R_lab_calibrated: Float[np.ndarray, "3 3"]


def synchronize(
    keypoints: ImagePoints,
    rig: Rig,
    parameters: ReconstructionParameters,
    calibrated_s: Mapping[str, float] | None = None,
) -> Outcome[tuple[Synchronization, ImagePoints]]:
    """Put all cameras on the first one's clock, where that is wanted and the movement tells the delays.

    ``calibrated_s`` are the delays that the calibration found, by camera. What belongs to the cameras (their latency, their
    trigger) is in the trial too; what belongs to a recording (who pressed when) is not. So the trial's own movement goes
    first, and where it can't tell the delays by itself, those are taken that the calibration found, if it bears them out.
    """
    before = calibrated_s or {}
    known_s = np.array([before.get(name, 0.0) for name in rig.names])
    known_s = known_s - known_s[0]
    matters = bool(np.abs(known_s).max() * keypoints.timebase.rate_hz > SMALLEST_DELAY_FRAMES)
    if parameters.synchronization == "hardware":
        worst = int(np.argmax(np.abs(known_s)))
        unused = finding("delays-not-applied", camera=rig.names[worst], value=1e3 * float(known_s[worst]))
        return Outcome((trusted(rig), keypoints), (unused,) if matters else ())
    found = estimate_delays(rig, keypoints, parameters.min_confidence)
    if found.status == "corrected":
        late = _late(rig.names, found.delay_s)
        told = tuple(finding("cameras-not-synchronous", camera=name, value=ms) for name, ms in late)
        return Outcome((found, shift(keypoints, found.delay_s)), told)
    if found.status == "unknown" and matters:
        found = confirm_delays(rig, keypoints, known_s, parameters.min_confidence)
        if found.status == "corrected":
            late = _late(rig.names, found.delay_s)
            told = tuple(finding("delays-from-calibration", camera=name, value=ms) for name, ms in late)
            return Outcome((found, shift(keypoints, found.delay_s)), told)
    findings = (finding("synchronization-unknown"),) if found.status == "unknown" else ()
    return Outcome((found, keypoints), findings)


def calibrated_delays(files: Sequence[CaptureFile]) -> dict[str, float]:
    """Give the delays that gonio's own calibration of the session found, seconds by camera; none of another program's."""
    own = next((read_own_calibration(file.path) for file in files if file.role == "calibration"), None)
    if own is None or own.verdict.level == "reject":
        return {}
    return dict(zip(own.rig.names, own.delay_s.tolist(), strict=True))


def _late(names: Sequence[str], delay_s: Float[np.ndarray, " camera"]) -> list[tuple[str, float]]:
    """List the cameras that run late, and by how many milliseconds."""
    return [(name, 1e3 * float(late_s)) for name, late_s in zip(names, delay_s, strict=True) if late_s != 0]


def refine_cameras(keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters) -> Outcome[PersonRefinement]:
    """Correct the cameras' poses on the subject's own movement, where that is wanted and proves itself."""
    if not parameters.refine_cameras:
        return Outcome(unrefined(rig))
    refinement = refine_on_person(rig, keypoints, parameters.min_confidence)
    if not refinement.kept:
        return Outcome(refinement)
    most = rig.names[int(np.argmax(refinement.moved_m))]
    fall = 100 * (1 - refinement.error_after_px / refinement.error_before_px)
    return Outcome(refinement, (finding("cameras-refined", camera=most, value=fall),))


def reconstruct(
    keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters, source: LabSource | None = None
) -> Outcome[Reconstruction]:
    """Triangulate all keypoints, find the lab, turn it to the subject's heading, and judge how far the cameras agree.

    ``source`` is what the calibration took its lab from, None where that is not known.
    """
    cameras, frames, names = keypoints.confidence.shape
    confidence = np.where(keypoints.confidence >= parameters.min_confidence, keypoints.confidence, 0.0)
    solved = triangulate(
        projection_matrices(rig),
        focal_lengths_px(rig),
        undistort_rig(rig, keypoints.uv_px).reshape(cameras, -1, 2),
        confidence.reshape(cameras, -1),
        method=parameters.method,
    )
    xyz = solved.xyz_lab_m.reshape(frames, names, 3)
    points = LabPoints(
        camera_names=keypoints.camera_names,
        keypoint_names=keypoints.keypoint_names,
        timebase=keypoints.timebase,
        xyz_lab_m=xyz,
        origin=np.where(np.isfinite(xyz[..., 0]), MEASURED, MISSING).astype(np.uint8),
        covariance_m2=solved.covariance_m2.reshape(frames, names, 3, 3),
        residual_px=solved.residual_px.reshape(cameras, frames, names, 2),
    )
    projections = projection_matrices(rig)
    depth_m = np.einsum("ci,fki->cfk", projections[:, 2, :3], xyz) + projections[:, 2, 3, None, None]
    miss_m = np.linalg.norm(points.residual_px, axis=-1) * depth_m / focal_lengths_px(rig)[:, None, None]
    upright, standing, told = find_trial_lab(points, rig, keypoints.stride, source, parameters.lab)
    turned = turn_to_heading(upright, standing)
    reconstruction = Reconstruction(
        rig=turned[1],
        points=turned[0],
        camera_weight=np.where(confidence > 0, solved.camera_weight.reshape(cameras, frames, names), 0.0),
        miss_m=miss_m,
        R_lab_calibrated=turned[1].cameras[0].T_lab_cam[:3, :3] @ rig.cameras[0].T_lab_cam[:3, :3].T,
    )
    return Outcome(reconstruction, (*told, *judge(reconstruction)))


def turn_to_heading(points: LabPoints, rig: Rig) -> tuple[LabPoints, Rig]:
    """Turn the lab about its vertical so that the subject heads towards +X; points and cameras turn together."""
    angle = heading_rad(points.of("left_hip"), points.of("right_hip"))
    return move_lab(points, rig, transform(rotation_about_y(-angle), np.zeros(3)))


def smooth(keypoints: ImagePoints, raw: Reconstruction, parameters: ReconstructionParameters) -> Outcome[LabPoints]:
    """Make smooth tracks of the points, by fusing all observations over time or frame by frame."""
    rate_hz = raw.points.timebase.rate_hz
    if parameters.smoothing == "fusion":
        tracks = fuse(
            projection_matrices(raw.rig),
            focal_lengths_px(raw.rig),
            undistort_rig(raw.rig, keypoints.uv_px),
            np.where(keypoints.confidence >= parameters.min_confidence, keypoints.confidence, 0.0),
            raw.points.xyz_lab_m,
            rate_hz=rate_hz,
            cutoff_hz=parameters.cutoff_hz,
        )
        points = mark_spans(raw.points, tracks)
    else:
        smoothed = median_filter(raw.points.xyz_lab_m, median_window(rate_hz))
        smoothed = low_pass(smoothed, rate_hz, min(parameters.cutoff_hz, 0.45 * rate_hz))
        points = replace(raw.points, xyz_lab_m=smoothed)
    return Outcome(points, (*judge_gaps(points), *judge_segments(points)))


def hold_lengths(tracks: LabPoints, parameters: ReconstructionParameters) -> LabPoints:
    """Correct tracks by what is known of arms and legs, where that is wanted: that their segments keep their lengths."""
    names = tracks.keypoint_names
    ends = [[names.index(end) for end in both] for both in SEGMENTS.values() if set(both) <= set(names)]
    if parameters.segments == "free" or not ends:
        return tracks
    xyz_lab_m, covariance_m2 = hold_segments(tracks.xyz_lab_m, tracks.covariance_m2, np.array(ends))
    return replace(tracks, xyz_lab_m=xyz_lab_m, covariance_m2=covariance_m2)


def camera_bias_px(points: LabPoints) -> Float[np.ndarray, "camera 2"]:
    """Give each camera's mean reprojection residual over the whole trial (NaN for one that saw nothing)."""
    cameras = points.residual_px.shape[0]
    flat = points.residual_px.reshape(cameras, -1, 2)
    return np.stack(
        [r[np.isfinite(r[:, 0])].mean(axis=0) if np.isfinite(r).any() else np.full(2, np.nan) for r in flat]
    )


def segment_lengths_m(points: LabPoints) -> dict[str, Float[np.ndarray, " frame"]]:
    """Give the length over time of each of :data:`SEGMENTS` that the keypoints know."""
    return {
        name: np.linalg.norm(points.of(start) - points.of(end), axis=-1)
        for name, (start, end) in SEGMENTS.items()
        if start in points.keypoint_names and end in points.keypoint_names
    }


def judge(reconstruction: Reconstruction) -> tuple[Finding, ...]:
    """Find what the reader has to know about the cameras' agreement."""
    points, miss_m = reconstruction.points, reconstruction.miss_m
    times_s = points.timebase.times_s(len(points.xyz_lab_m))
    findings: list[Finding] = []
    for camera, (name, bias) in enumerate(zip(points.camera_names, camera_bias_px(points), strict=True)):
        seen = np.isfinite(miss_m[camera])
        if not seen.any():
            continue
        px_per_m = np.nanmedian(
            np.linalg.norm(points.residual_px[camera], axis=-1)[seen] / np.maximum(miss_m[camera][seen], 1e-12)
        )
        bias_mm = 1e3 * float(np.linalg.norm(bias)) / px_per_m
        if bias_mm > 15:  # three times what a good calibration leaves; 15 mm at a joint are about 2° at the knee
            findings.append(finding("camera-biased", camera=name, value=bias_mm))
        rejected = 100 * float((reconstruction.camera_weight[camera][seen] < 0.25).mean())
        if rejected > 20:
            lost = (reconstruction.camera_weight[camera] < 0.25) & seen
            mostly = 2 * lost.sum(axis=1) > seen.sum(axis=1)
            span_s = longest_stretch(mostly, times_s)
            findings.append(finding("observations-rejected", camera=name, value=rejected, span_s=span_s))
    median_mm = 1e3 * float(np.nanmedian(miss_m)) if np.isfinite(miss_m).any() else np.nan
    if median_mm > 25:
        severity = "serious" if median_mm > 50 else None
        counts = np.isfinite(miss_m).sum(axis=(0, 2))
        by_frame = np.where(counts, np.nansum(miss_m, axis=(0, 2)) / np.maximum(counts, 1), np.nan)
        span_s = worst_moment(by_frame, times_s)
        findings.append(finding("reprojection-large", value=median_mm, severity=severity, span_s=span_s))
    return tuple(findings)


def judge_gaps(points: LabPoints) -> tuple[Finding, ...]:
    """Find the leg keypoints that are unknown for much of the trial."""
    findings: list[Finding] = []
    for name in LEG_KEYPOINTS:
        unknown = np.isnan(points.of(name)[:, 0])
        missing = 100 * float(unknown.mean())
        if missing > 10:
            severity = "serious" if missing > 50 else None
            joint, span_s = name.replace("_", " "), longest_stretch(unknown, points.timebase.times_s(len(unknown)))
            findings.append(finding("keypoint-missing", value=missing, severity=severity, span_s=span_s, joint=joint))
    return tuple(findings)


def judge_segments(points: LabPoints) -> tuple[Finding, ...]:
    """Find the leg segments whose length is not steady."""
    findings: list[Finding] = []
    for name, length_m in segment_lengths_m(points).items():
        known = length_m[np.isfinite(length_m)]
        if known.size < 2 or not name.endswith(("thigh", "shank")):
            continue
        variation = 100 * float(known.std() / known.mean())
        if variation > 5:
            off_m = np.abs(length_m - np.median(known))
            span_s = worst_moment(off_m, points.timebase.times_s(len(off_m)))
            findings.append(finding("segment-unsteady", where=name, value=variation, span_s=span_s))
    return tuple(findings)
