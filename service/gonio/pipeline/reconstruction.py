"""From keypoints in the images to points in the lab, judged: stages ``synchronization`` to ``smoothing``."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.kernel.calibration.lab_frame import heading_rad
from gonio.kernel.calibration.person import PersonRefinement, refine_on_person, unrefined
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import apply, rotation_about_y, transform
from gonio.kernel.smoothing.filters import low_pass, median_filter, median_window
from gonio.kernel.synchronization.delays import Synchronization, estimate_delays, trusted
from gonio.kernel.synchronization.looks import shift
from gonio.kernel.triangulation.fusion import fuse, mark_spans
from gonio.kernel.triangulation.points import triangulate
from gonio.pipeline.findings import finding
from gonio.pipeline.params import ReconstructionParameters
from gonio.pipeline.run import Outcome
from gonio.records import MEASURED, MISSING, Finding, ImagePoints, LabPoints, Rig, record

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
    keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters
) -> Outcome[tuple[Synchronization, ImagePoints]]:
    """Put all cameras on the first one's clock, where that is wanted and the movement tells the delays."""
    if parameters.synchronization == "hardware":
        return Outcome((trusted(rig), keypoints))
    found = estimate_delays(rig, keypoints, parameters.min_confidence)
    if found.status == "corrected":
        late = [
            finding("cameras-not-synchronous", where=name, value=1e3 * float(delay_s))
            for name, delay_s in zip(rig.names, found.delay_s, strict=True)
            if delay_s != 0
        ]
        return Outcome((found, shift(keypoints, found.delay_s)), tuple(late))
    findings = (finding("synchronization-unknown"),) if found.status == "unknown" else ()
    return Outcome((found, keypoints), findings)


def refine_cameras(keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters) -> Outcome[PersonRefinement]:
    """Correct the cameras' poses on the subject's own movement, where that is wanted and proves itself."""
    if not parameters.refine_cameras:
        return Outcome(unrefined(rig))
    refinement = refine_on_person(rig, keypoints, parameters.min_confidence)
    if not refinement.kept:
        return Outcome(refinement)
    most = rig.names[int(np.argmax(refinement.moved_m))]
    fall = 100 * (1 - refinement.error_after_px / refinement.error_before_px)
    return Outcome(refinement, (finding("cameras-refined", where=most, value=fall),))


def reconstruct(keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters) -> Outcome[Reconstruction]:
    """Triangulate all keypoints, turn the lab to the subject's heading, and judge how far the cameras agree."""
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
    turned = turn_to_heading(points, rig)
    reconstruction = Reconstruction(
        rig=turned[1],
        points=turned[0],
        camera_weight=np.where(confidence > 0, solved.camera_weight.reshape(cameras, frames, names), 0.0),
        miss_m=miss_m,
        R_lab_calibrated=turned[2],
    )
    return Outcome(reconstruction, judge(reconstruction))


def turn_to_heading(points: LabPoints, rig: Rig) -> tuple[LabPoints, Rig, Float[np.ndarray, "3 3"]]:
    """Turn the lab about its vertical so that the subject heads towards +X, points and cameras together; also give the turn."""
    angle = heading_rad(points.of("left_hip"), points.of("right_hip"))
    T_lab_calibrated = transform(rotation_about_y(-angle), np.zeros(3))
    rotation = T_lab_calibrated[:3, :3]
    cameras = tuple(replace(camera, T_lab_cam=T_lab_calibrated @ camera.T_lab_cam) for camera in rig.cameras)
    turned = replace(
        points,
        xyz_lab_m=apply(T_lab_calibrated, points.xyz_lab_m),
        covariance_m2=rotation @ points.covariance_m2 @ rotation.T,
    )
    return turned, replace(rig, cameras=cameras), rotation


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
            findings.append(finding("camera-biased", where=name, value=bias_mm))
        rejected = 100 * float((reconstruction.camera_weight[camera][seen] < 0.25).mean())
        if rejected > 20:
            findings.append(finding("observations-rejected", where=name, value=rejected))
    median_mm = 1e3 * float(np.nanmedian(miss_m)) if np.isfinite(miss_m).any() else np.nan
    if median_mm > 25:
        severity = "serious" if median_mm > 50 else None
        findings.append(finding("reprojection-large", value=median_mm, severity=severity))
    return tuple(findings)


def judge_gaps(points: LabPoints) -> tuple[Finding, ...]:
    """Find the leg keypoints that are unknown for much of the trial."""
    findings: list[Finding] = []
    for name in LEG_KEYPOINTS:
        missing = 100 * float(np.isnan(points.of(name)[:, 0]).mean())
        if missing > 10:
            severity = "serious" if missing > 50 else None
            findings.append(finding("keypoint-missing", where=name.replace("_", " "), value=missing, severity=severity))
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
            findings.append(finding("segment-unsteady", where=name, value=variation))
    return tuple(findings)
