"""Describe what was computed in the words of the report's schema: numbers rounded, units turned, unknowns null."""

import hashlib
import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gonio.kernel.calibration.person import PersonRefinement
from gonio.kernel.kinematics.clinical import ClinicalAngle, clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.kernel.synchronization.delays import Synchronization
from gonio.pipeline.body import SubjectBody
from gonio.pipeline.describe_gait import describe_gait
from gonio.pipeline.describe_kinetics import describe_kinetics, describe_pressure
from gonio.pipeline.keypoints import Keypoints
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.params import Parameters, parameters_document
from gonio.pipeline.pressure import Measured
from gonio.pipeline.reconstruction import Reconstruction as Reconstructed
from gonio.pipeline.reconstruction import camera_bias_px, segment_lengths_m
from gonio.pipeline.report_base import Level
from gonio.pipeline.report_schema import (
    Angle,
    BodyFit,
    CameraReport,
    GaitReport,
    InputFile,
    PersonReport,
    Provenance,
    Reconstruction,
    ReportFinding,
    SegmentReport,
    Verdict,
)
from gonio.pipeline.rounding import number, series
from gonio.pipeline.run import CaptureFile
from gonio.records import (
    PARTIAL,
    TOO_FEW_MARKERS,
    Capture,
    Finding,
    ForceCoefficients,
    GaitAnalysis,
    GroundForces,
    LabPoints,
    Torques,
)

JOINTS = {
    "hip_flexion": ("hip", "Hip flexion", "flexion"),
    "knee_flexion": ("knee", "Knee flexion", "flexion"),
    "ankle_dorsiflexion": ("ankle", "Ankle dorsiflexion", "dorsiflexion"),
}


@dataclass(frozen=True)
class Analysis:
    """All that the river computed, from the files to the motion."""

    files: tuple[CaptureFile, ...]
    parameters: Parameters
    capture: Capture
    keypoints: Keypoints
    synchronization: Synchronization
    refinement: PersonRefinement
    raw: Reconstructed
    tracks: LabPoints
    """Smooth, each keypoint for itself; ``points`` are these, with the segments' lengths held."""
    points: LabPoints
    body: SubjectBody
    motion: BodyMotion
    measured: Measured
    coefficients: ForceCoefficients
    forces: GroundForces | None
    torques: Torques | None
    gait: GaitAnalysis


SENTENCES: dict[Level, str] = {
    "good": "The cameras and the body model agree: the angles can be trusted within a few degrees{torques}.",
    "usable": "The angles{torques} can be used with care: read the findings first.",
    "poor": "Don't rest a decision on these angles{torques}: something serious is wrong with the recording.",
}
WITH_TORQUES: dict[Level, str] = {
    "good": ", the torques within their bands",
    "usable": " and torques",
    "poor": " or torques",
}
FORCE_STAGES = {"sensors", "pressure", "forces", "dynamics"}


def verdict_of(findings: Sequence[Finding], *, torques: bool = False) -> Verdict:
    """Weigh the findings: a serious one makes the result poor, a warning usable.

    A serious fault of soles or plates does not touch the angles: where there are no ``torques`` because of it, the rest is
    usable; where there are, the sentence says what of it is meant.
    """
    serious = {f.stage in FORCE_STAGES for f in findings if f.severity == "serious"}
    if serious == {True} and torques:
        return Verdict(
            level="poor",
            sentence="Don't rest a decision on these torques: something serious is wrong with the forces. The angles don't "
            "depend on it.",
        )
    if serious == {True}:
        return Verdict(
            level="usable",
            sentence="The angles can be used with care; there are no torques, for something serious is wrong with soles or "
            "plates.",
        )
    level: Level = "poor" if serious else "usable" if any(f.severity == "warning" for f in findings) else "good"
    sentence = SENTENCES[level].format(torques=WITH_TORQUES[level] if torques else "")
    if any(f.code == "torque-mass-missing" for f in findings):
        sentence += " There are no torques, for the subject's mass was not given."
    return Verdict(level=level, sentence=sentence)


def describe_camera(analysis: Analysis, camera: int) -> CameraReport:
    """Describe one camera: its video, what it saw, and how that agrees with the other cameras."""
    view = analysis.capture.views[camera]
    error_px = np.linalg.norm(analysis.raw.points.residual_px[camera], axis=-1)
    observed = np.isfinite(error_px)
    bias = camera_bias_px(analysis.raw.points)[camera]
    rejected = (analysis.raw.camera_weight[camera][observed] < 0.25).mean() if observed.any() else 0.0
    return CameraReport(
        name=view.camera_name,
        file=view.file_name,
        image_width_px=view.image_size_px[0],
        image_height_px=view.image_size_px[1],
        recorded_rate_hz=view.rate_hz,
        recorded_frames=view.frame_count,
        observations=int(observed.sum()),
        seen_fraction=round(float(analysis.keypoints.seen[camera].mean()), 4),
        reprojection_mean_px=number(mean(error_px)),
        reprojection_median_px=number(median(error_px)),
        bias_u_px=number(bias[0]),
        bias_v_px=number(bias[1]),
        rejected_fraction=round(float(rejected), 4),
        delay_ms=number(1e3 * analysis.synchronization.delay_s[camera]),
        corrected_by_mm=number(1e3 * analysis.refinement.moved_m[camera], 1),
        corrected_by_deg=number(np.rad2deg(analysis.refinement.turned_rad[camera])),
    )


def describe_person(keypoints: Keypoints, number: int) -> PersonReport:
    """Describe where and when somebody was seen."""
    person, subject = keypoints.people[number], keypoints.people[keypoints.subject]
    way = person.centre_lab_m[person.met][:, [0, 2]]
    times_s = person.points.timebase.times_s(person.place.shape[1])
    first, last = person.span
    apart_m = np.linalg.norm((person.centre_lab_m - subject.centre_lab_m)[:, [0, 2]], axis=1)
    met = np.isfinite(apart_m).any() and number != keypoints.subject
    return PersonReport(
        number=number + 1,
        subject=number == keypoints.subject,
        from_s=round(float(times_s[first]), 3),
        to_s=round(float(times_s[last]), 3),
        seen_fraction=round(person.sightings / (len(person.place) * len(person.points.looks)), 4),
        path_m=round(float(np.linalg.norm(np.ptp(way, axis=0))), 2),
        mean_x_m=round(float(way[:, 0].mean()), 2),
        mean_z_m=round(float(way[:, 1].mean()), 2),
        nearest_to_subject_m=round(float(np.nanmin(apart_m)), 2) if met else None,
    )


def describe_reconstruction(analysis: Analysis) -> Reconstruction:
    """Describe how far the cameras agree, and how steady the segments are."""
    error_px = np.linalg.norm(analysis.raw.points.residual_px, axis=-1)
    before, after = segment_lengths_m(analysis.raw.points), segment_lengths_m(analysis.tracks)
    return Reconstruction(
        method=analysis.parameters.reconstruction.method,
        smoothing=analysis.parameters.reconstruction.smoothing,
        looks_hz=round(analysis.keypoints.points.sampled.timebase.rate_hz, 3),
        keypoint_model=("uploaded", *analysis.keypoints.networks)[-1],
        observations=int(np.isfinite(error_px).sum()),
        reprojection_mean_px=number(mean(error_px)),
        reprojection_median_px=number(median(error_px)),
        disagreement_median_mm=number(1e3 * median(analysis.raw.miss_m)),
        synchronization=analysis.synchronization.status,
        cameras_refined=analysis.refinement.kept,
        held_out_before_px=number(analysis.refinement.error_before_px),
        held_out_after_px=number(analysis.refinement.error_after_px),
        people=[describe_person(analysis.keypoints, number) for number in range(len(analysis.keypoints.people))],
        cameras=[describe_camera(analysis, camera) for camera in range(len(analysis.capture.views))],
        segments=[
            SegmentReport(
                name=name,
                mean_mm=number(1e3 * mean(after[name]), 1),
                sd_mm=number(1e3 * spread(after[name])),
                sd_raw_mm=number(1e3 * spread(before[name])),
            )
            for name in after
        ],
    )


def describe_body(analysis: Analysis) -> BodyFit:
    """Describe the body model and how well it fits."""
    model, motion, fit = analysis.motion.model, analysis.motion.motion, analysis.motion.fit
    used = fit is not None and not analysis.motion.distrusted
    rms = motion.residual_rms_m
    factors = analysis.body.scales[:, 1] * (fit.body_factor if fit is not None and used else 1.0)
    return BodyFit(
        model=model.name,
        method="pixels" if used else "points",
        mass_kg=round(model.mass_kg, 2),
        frames_solved=int((motion.status != TOO_FEW_MARKERS).sum()),
        frames_partial=int((motion.status == PARTIAL).sum()),
        marker_rms_mean_mm=number(1e3 * mean(rms), 1),
        marker_rms_max_mm=number(1e3 * float(np.nanmax(rms)), 1) if np.isfinite(rms).any() else None,
        kept_fraction=number(fit.inlier_share, 4) if fit is not None else None,
        error_lasts_s=number(fit.error_lasts_s, 3) if fit is not None else None,
        # The factor along the segment's length: Y in the bodies' frames.
        segment_scales={
            name: round(float(factor), 4) for name, factor in zip(model.bodies.names, factors, strict=True)
        },
    )


def describe_angles(analysis: Analysis) -> list[Angle]:
    """Describe hip, knee and ankle of both legs over time, in degrees, positive in the clinical sense."""
    return [describe_angle(angle, analysis.motion) for angle in find_clinical_angles(analysis.motion.model)]


def describe_angle(angle: ClinicalAngle, found: BodyMotion) -> Angle:
    """Describe one joint angle over time, its error bar, and how far the other way of computing it comes out."""
    joint, title, positive = JOINTS[angle.name]
    degrees, other = clinical_deg(found.motion, angle), clinical_deg(found.two_step, angle)
    known = degrees[np.isfinite(degrees)]
    low, high = (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)
    apart, sd = degrees - other, clinical_sd_deg(found.motion, angle)
    return Angle.model_validate(
        {
            "joint": joint,
            "side": angle.side,
            "name": title,
            "positive": positive,
            "values_deg": series(degrees),
            "sd_deg": series(sd),
            "band_deg": number(1.96 * median(sd)),
            "min_deg": number(low),
            "max_deg": number(high),
            "range_deg": number(high - low),
            "check_offset_deg": number(mean(apart)),
            "check_sd_deg": number(spread(apart)),
        }
    )


def describe_provenance(files: Sequence[CaptureFile], parameters: Parameters, models: Mapping[str, Path]) -> Provenance:
    """Describe where the report came from: inputs, settings, software and models, each by its hash or version."""
    packages = ("numpy", "scipy", "numba", "onnxruntime", "av", "opencv-contrib-python-headless")
    return Provenance(
        inputs=[
            InputFile(name=f.name, role=f.role, sha256=sha256_of(f.path), size_bytes=size_of(f.path)) for f in files
        ],
        parameters=parameters_document(parameters),
        software={
            "gonio": importlib.metadata.version("gonio"),
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in packages},
        },
        models={name: sha256_of(path) for name, path in models.items()},
    )


def describe(analysis: Analysis, findings: Sequence[Finding], models: Mapping[str, Path]) -> GaitReport:
    """Put the report together; the worst findings come first."""
    order = {"serious": 0, "warning": 1, "info": 2}
    capture = analysis.capture
    return GaitReport(
        created=datetime.now(UTC).replace(microsecond=0),
        verdict=verdict_of(findings, torques=analysis.torques is not None),
        findings=[describe_finding(f) for f in sorted(findings, key=lambda f: order[f.severity])],
        rate_hz=capture.timebase.rate_hz,
        frames=capture.frame_count,
        duration_s=round(capture.frame_count / capture.timebase.rate_hz, 4),
        reconstruction=describe_reconstruction(analysis),
        body=describe_body(analysis),
        time_s=[round(float(t), 5) for t in capture.timebase.times_s(capture.frame_count)],
        angles=describe_angles(analysis),
        gait=describe_gait(analysis.gait, analysis.parameters.subject),
        pressure=describe_pressure(analysis.measured),
        kinetics=describe_kinetics(analysis.forces, analysis.torques, analysis.motion, analysis.coefficients.source),
        provenance=describe_provenance(analysis.files, analysis.parameters, models),
    )


def describe_finding(finding: Finding) -> ReportFinding:
    """Describe a finding."""
    start_s, end_s = finding.span_s or (None, None)
    return ReportFinding(
        code=finding.code,
        severity=finding.severity,
        stage=finding.stage,
        message=finding.message,
        hint=finding.hint,
        where=finding.where,
        value=finding.value if finding.value is None else number(finding.value, 3),
        unit=finding.unit,
        start_s=None if start_s is None else number(start_s, 3),
        end_s=None if end_s is None else number(end_s, 3),
        camera=finding.camera,
        joint=finding.joint,
    )


def size_of(path: Path) -> int:
    """Give the bytes of a file, or of a folder's files."""
    return sum(file.stat().st_size for file in path.iterdir()) if path.is_dir() else path.stat().st_size


def sha256_of(path: Path) -> str:
    """Give the sha256 of a file, in hex; of a folder, that of the lines ``hash  name`` of its files, sorted by name."""
    if path.is_dir():
        lines = "".join(f"{sha256_of(file)}  {file.name}\n" for file in sorted(path.iterdir()) if file.is_file())
        return hashlib.sha256(lines.encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def mean(values: np.ndarray) -> float:
    """Give the mean of the known values, NaN if none is known."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def median(values: np.ndarray) -> float:
    """Give the median of the known values, NaN if none is known."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else np.nan


def spread(values: np.ndarray) -> float:
    """Give the standard deviation of the known values, NaN with fewer than two."""
    known = values[np.isfinite(values)]
    return float(known.std()) if known.size > 1 else np.nan
