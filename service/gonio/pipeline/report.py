"""Stage ``report``: everything that was computed, judged and written down, for people and for programs."""

import base64
import hashlib
import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gonio.pipeline.figures import TITLES, angle_figure
from gonio.pipeline.params import Parameters, parameters_document
from gonio.pipeline.reconstruction import Reconstruction as ReconstructionResult
from gonio.pipeline.reconstruction import camera_bias_px, segment_lengths_m
from gonio.pipeline.report_schema import (
    Angle,
    BodyFit,
    CameraReport,
    GaitReport,
    InputFile,
    Level,
    Provenance,
    Reconstruction,
    ReportFinding,
    SegmentReport,
    Series,
    Verdict,
)
from gonio.pipeline.run import CaptureFile
from gonio.records import Capture, Finding, LabPoints

SENTENCES: dict[Level, str] = {
    "good": "The cameras and the body model agree: the angles can be trusted within a few degrees.",
    "usable": "The angles can be used with care: read the findings first.",
    "poor": "Don't rest a decision on these angles: something serious is wrong with the recording.",
}


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """Weigh the findings: a serious one makes the result poor, a warning usable."""
    severities = {f.severity for f in findings}
    level: Level = "poor" if "serious" in severities else "usable" if "warning" in severities else "good"
    return Verdict(level=level, sentence=SENTENCES[level])


def describe_reconstruction(
    capture: Capture, raw: ReconstructionResult, smoothed: LabPoints, seen: np.ndarray, parameters: Parameters
) -> Reconstruction:
    """Describe the cameras' agreement; ``seen`` (camera, frame) says where a camera saw the subject."""
    error_px = np.linalg.norm(raw.points.residual_px, axis=-1)
    bias = camera_bias_px(raw.points)
    cameras: list[CameraReport] = []
    for i, view in enumerate(capture.views):
        observed = np.isfinite(error_px[i])
        cameras.append(
            CameraReport(
                name=view.camera_name,
                file=view.file_name,
                image_width_px=view.image_size_px[0],
                image_height_px=view.image_size_px[1],
                recorded_rate_hz=view.rate_hz,
                recorded_frames=view.frame_count,
                observations=int(observed.sum()),
                seen_fraction=round(float(seen[i].mean()), 4),
                reprojection_mean_px=number(mean(error_px[i])),
                reprojection_median_px=number(median(error_px[i])),
                bias_u_px=number(bias[i, 0]),
                bias_v_px=number(bias[i, 1]),
                rejected_fraction=round(float((raw.camera_weight[i][observed] < 0.25).mean()), 4)
                if observed.any()
                else 0.0,
            )
        )
    before, after = segment_lengths_m(raw.points), segment_lengths_m(smoothed)
    segments = [
        SegmentReport(
            name=name,
            mean_mm=number(1e3 * mean(after[name]), 1),
            sd_mm=number(1e3 * spread(after[name])),
            sd_raw_mm=number(1e3 * spread(before[name])),
        )
        for name in after
    ]
    return Reconstruction(
        method=parameters.reconstruction.method,
        keypoint_model=parameters.keypoints.model,
        observations=int(np.isfinite(error_px).sum()),
        reprojection_mean_px=number(mean(error_px)),
        reprojection_median_px=number(median(error_px)),
        disagreement_median_mm=number(1e3 * median(raw.miss_m)),
        cameras=cameras,
        segments=segments,
    )


def describe_angle(joint: str, side: str, positive: str, values_rad: np.ndarray) -> Angle:
    """Describe one joint angle over time, in degrees."""
    degrees = np.rad2deg(values_rad)
    known = degrees[np.isfinite(degrees)]
    low, high = (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)
    return Angle.model_validate(
        {
            "joint": joint,
            "side": side,
            "name": TITLES[joint],
            "positive": positive,
            "values_deg": series(degrees),
            "min_deg": number(low),
            "max_deg": number(high),
            "range_deg": number(high - low),
        }
    )


def describe_provenance(files: Sequence[CaptureFile], parameters: Parameters, models: Mapping[str, Path]) -> Provenance:
    """Describe where the report came from: inputs, settings, software and models, each by its hash or version."""
    packages = ("numpy", "scipy", "numba", "onnxruntime", "av", "opencv-contrib-python-headless")
    return Provenance(
        inputs=[
            InputFile(name=f.name, role=f.role, sha256=sha256_of(f.path), size_bytes=f.path.stat().st_size)
            for f in files
        ],
        parameters=parameters_document(parameters),
        software={
            "gonio": importlib.metadata.version("gonio"),
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in packages},
        },
        models={name: sha256_of(path) for name, path in models.items()},
    )


def assemble(
    capture: Capture,
    findings: Sequence[Finding],
    reconstruction: Reconstruction,
    body: BodyFit,
    angles: Sequence[Angle],
    provenance: Provenance,
) -> GaitReport:
    """Put the report together; the worst findings come first."""
    order = {"serious": 0, "warning": 1, "info": 2}
    ranked = sorted(findings, key=lambda f: order[f.severity])
    return GaitReport(
        created=datetime.now(UTC).replace(microsecond=0),
        verdict=verdict_of(findings),
        findings=[
            ReportFinding(
                code=f.code,
                severity=f.severity,
                stage=f.stage,
                message=f.message,
                hint=f.hint,
                where=f.where,
                value=f.value,
                unit=f.unit,
            )
            for f in ranked
        ],
        rate_hz=capture.timebase.rate_hz,
        frames=capture.frame_count,
        duration_s=round(capture.frame_count / capture.timebase.rate_hz, 4),
        reconstruction=reconstruction,
        body=body,
        time_s=[round(float(t), 5) for t in capture.timebase.times_s(capture.frame_count)],
        angles=list(angles),
        provenance=provenance,
    )


def render_html(report: GaitReport, pictures: Mapping[str, bytes]) -> str:
    """Render the report as one self-contained page; ``pictures`` holds a JPEG a camera."""
    environment = Environment(
        loader=PackageLoader("gonio.pipeline", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("report.html.jinja").render(
        report=report,
        angle_svg=angle_figure(report.time_s, report.angles),
        pictures={name: base64.b64encode(jpeg).decode() for name, jpeg in pictures.items()},
        titles=TITLES,
    )


def key_lines(report: GaitReport) -> list[str]:
    """Give the six lines of a report that matter most, for a terminal."""
    r, b = report.reconstruction, report.body
    worst = max(r.cameras, key=lambda c: abs(complex(c.bias_u_px or 0, c.bias_v_px or 0)))
    legs = [s for s in r.segments if s.name.endswith(("thigh", "shank"))]

    def extent(joint: str, side: str) -> str:
        angle = next(a for a in report.angles if a.joint == joint and a.side == side)
        return "unknown" if angle.min_deg is None else f"{angle.min_deg:.0f}° to {angle.max_deg:.0f}°"

    return [
        f"Verdict: {report.verdict.level}. {report.verdict.sentence}",
        f"Recording: {len(r.cameras)} cameras, {report.frames} frames at {report.rate_hz:g} Hz ({report.duration_s:.2f} s), "
        f"{len(report.findings)} findings",
        f"Cameras: reprojection mean {r.reprojection_mean_px} px, median {r.reprojection_median_px} px over "
        f"{r.observations} observations; largest bias {worst.name} ({worst.bias_u_px}, {worst.bias_v_px}) px",
        "Leg segments, SD over time: " + ", ".join(f"{s.name} {s.sd_mm} mm" for s in legs),
        f"Body fit: {b.marker_rms_mean_mm} mm RMS in {b.frames_solved} of {report.frames} frames",
        f"Knee flexion: right {extent('knee', 'right')}, left {extent('knee', 'left')}",
    ]


def sha256_of(path: Path) -> str:
    """Give the sha256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def number(value: float, digits: int = 2) -> float | None:
    """Round a number for the report; NaN becomes null."""
    return round(float(value), digits) if np.isfinite(value) else None


def series(values: np.ndarray) -> Series:
    """Round a curve for the report; NaN becomes null."""
    return [number(v, 3) for v in values]


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
