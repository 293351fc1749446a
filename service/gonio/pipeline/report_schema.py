"""The gait report as JSON: a versioned schema that programs can rely on.

The version follows the document, not the software: a field that is added raises the minor number, one that is removed or
changes its meaning the major one. ``docs/reference/report.schema.json`` is made from these classes and held by a test.
Units are in the names; unknown numbers are null, never 0.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from gonio.pipeline.report_base import Level, ReportModel, Series, Severity, Side
from gonio.pipeline.report_gait import GaitReportSection
from gonio.pipeline.report_kinetics import Kinetics, PressureReport

SCHEMA_VERSION = "1.4"


class Verdict(ReportModel):
    """How far the result can be trusted, in one sentence."""

    level: Level
    sentence: str


class ReportFinding(ReportModel):
    """Something the reader has to know, with its remedy; the codes are listed in docs/reference/findings.md."""

    code: str
    severity: Severity
    stage: str
    message: str
    hint: str
    where: str
    value: float | None
    unit: str
    start_s: Annotated[
        float | None,
        Field(
            description="Where the stretch begins that it speaks of, on the clock of `time_s`; null where it holds for the "
            "whole trial. Of several stretches it is the longest, of what varies the worst moment."
        ),
    ]
    end_s: Annotated[float | None, Field(description="Where it ends; the same as `start_s` for a moment.")]
    camera: Annotated[str, Field(description="The camera that it is about; empty where it is about none.")]
    joint: Annotated[str, Field(description="The joint or keypoint that it is about, like `right knee`.")]


class CameraReport(ReportModel):
    """One camera: its video, and how well what it saw agrees with the other cameras."""

    name: str
    file: str
    image_width_px: int
    image_height_px: int
    recorded_rate_hz: float
    recorded_frames: int
    observations: Annotated[int, Field(description="Keypoints of the subject that were used in triangulation.")]
    seen_fraction: Annotated[
        float, Field(description="Share of the frames looked at in which this camera saw the subject.")
    ]
    reprojection_mean_px: float | None
    reprojection_median_px: float | None
    bias_u_px: Annotated[float | None, Field(description="Mean residual to the right; a good calibration leaves 0.")]
    bias_v_px: Annotated[float | None, Field(description="Mean residual downwards.")]
    delay_ms: Annotated[float | None, Field(description="By how much the camera ran late; corrected.")]
    corrected_by_mm: Annotated[
        float | None, Field(description="How far the camera's pose was corrected on the subject.")
    ]
    corrected_by_deg: float | None
    rejected_fraction: Annotated[float, Field(description="Share of observations that contradicted the other cameras.")]


class PersonReport(ReportModel):
    """Somebody who was seen, in the order of being the subject; places in the lab as it was calibrated."""

    number: Annotated[int, Field(description="What `keypoints.person` of a request would ask for.")]
    subject: bool
    from_s: float
    to_s: float
    seen_fraction: Annotated[
        float, Field(description="Share of all cameras' looks, over the whole trial, in which the person was seen.")
    ]
    path_m: Annotated[float, Field(description="Diagonal of the floor rectangle in which the person moved.")]
    mean_x_m: float
    mean_z_m: float
    nearest_to_subject_m: Annotated[
        float | None, Field(description="How near the person came to the subject; null for the subject.")
    ]


class SegmentReport(ReportModel):
    """A body segment's length over the trial, after smoothing: bones don't change, so its scatter is error."""

    name: str
    mean_mm: float | None
    sd_mm: float | None
    sd_raw_mm: Annotated[float | None, Field(description="The same before smoothing.")]


class Reconstruction(ReportModel):
    """From image points to lab points."""

    method: str
    smoothing: str
    looks_hz: Annotated[float, Field(description="How often a second keypoints were looked for in each camera.")]
    keypoint_model: str
    observations: int
    reprojection_mean_px: float | None
    reprojection_median_px: float | None
    disagreement_median_mm: Annotated[float | None, Field(description="Median reprojection error at the subject.")]
    synchronization: Annotated[
        Literal["synchronous", "corrected", "unknown", "trusted"],
        Field(description="Whether the cameras ran together, by the subject's movement; trusted: by a common trigger."),
    ]
    cameras_refined: Annotated[bool, Field(description="Whether the cameras' poses were corrected on the subject.")]
    held_out_before_px: Annotated[
        float | None, Field(description="Mean reprojection error in held-out moments, by the calibration as it came.")
    ]
    held_out_after_px: Annotated[float | None, Field(description="The same with corrected cameras.")]
    people: Annotated[list[PersonReport], Field(description="Everybody who was seen; empty for given keypoints.")]
    cameras: list[CameraReport]
    segments: list[SegmentReport]
    heading: str = "The lab is turned about its vertical so that the subject heads towards +X."


class BodyFit(ReportModel):
    """The body model and how well it fits the points."""

    model: str
    method: Annotated[
        Literal["pixels", "points"],
        Field(
            description="Fitted to all cameras' pixels over the whole trial, or to the smoothed points frame by frame."
        ),
    ]
    mass_kg: float
    frames_solved: int
    frames_partial: Annotated[int, Field(description="Frames in which a limb without points is unknown.")]
    marker_rms_mean_mm: float | None
    marker_rms_max_mm: float | None
    kept_fraction: Annotated[
        float | None, Field(description="Share of observations that the fit to the pixels did not reject.")
    ]
    error_lasts_s: Annotated[
        float | None, Field(description="How long the detector's errors last; the error bars count with it.")
    ]
    segment_scales: Annotated[
        dict[str, float], Field(description="Length scale of each body against the generic model.")
    ]


class Angle(ReportModel):
    """A joint angle over the trial."""

    joint: Literal["hip", "knee", "ankle"]
    side: Side
    name: str
    positive: Annotated[str, Field(description="What a positive angle means.")]
    values_deg: Series
    sd_deg: Annotated[Series, Field(description="Standard deviation of each value: 95 % lie within 1.96 of it.")]
    band_deg: Annotated[float | None, Field(description="Half width of the 95 % band in a usual frame.")]
    min_deg: float | None
    max_deg: float | None
    range_deg: float | None
    check_offset_deg: Annotated[
        float | None, Field(description="Mean difference to the angle from the smoothed points, frame by frame.")
    ]
    check_sd_deg: Annotated[float | None, Field(description="Standard deviation over time of that difference.")]


class InputFile(ReportModel):
    """A file that the report was computed from."""

    name: str
    role: str
    sha256: str
    size_bytes: int


class Provenance(ReportModel):
    """All that is needed to compute the same report again."""

    inputs: list[InputFile]
    parameters: dict[str, Any]
    software: dict[str, str]
    models: Annotated[dict[str, str], Field(description="sha256 of each model file.")]


class GaitReport(ReportModel):
    """A gait report."""

    schema_version: Literal["1.4"] = SCHEMA_VERSION
    created: datetime
    verdict: Verdict
    findings: list[ReportFinding]
    rate_hz: float
    frames: int
    duration_s: float
    reconstruction: Reconstruction
    body: BodyFit
    time_s: list[float]
    angles: list[Angle]
    gait: GaitReportSection
    pressure: PressureReport | None
    kinetics: Kinetics | None
    provenance: Provenance


def report_schema() -> dict[str, Any]:
    """Give the JSON schema of the report."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **GaitReport.model_json_schema(mode="serialization"),
    }
