"""gonio's own calibration file: JSON with everything that is known of a rig. docs/reference/calibration.schema.json.

Numbers are written with all their digits, so a file read back gives the same calibration to the last bit. What is not known
is null.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from gonio.errors import InputError
from gonio.formats.strict import Strict
from gonio.records import (
    INTRINSIC_NAMES,
    UNKNOWNS,
    Calibration,
    Camera,
    Finding,
    Intrinsics,
    Judgement,
    LabFrame,
    LabSource,
    LensModel,
    Level,
    Rig,
    Severity,
    Verdict,
    Volume,
)
from gonio.records.intrinsics import Origin

FORMAT = "gonio calibration"

Pair = tuple[float, float]
Three = tuple[float, float, float]
Matrix3 = tuple[Three, Three, Three]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


class OpticsDocument(Strict):
    """How a camera's optics were found before the rig was solved: its prior."""

    model: LensModel
    origin: Origin
    source: str
    parameters: dict[str, float] = Field(description="By name: " + ", ".join(INTRINSIC_NAMES) + ".")
    covariance: list[list[float]] = Field(description="9 × 9, in the order of the parameters.")
    held_out_px: float | None
    rms_px: float | None
    views: int
    tilted_views: int
    covered: list[list[bool]] = Field(description="4 rows of 6 cells of the picture: where corners were seen.")


class CameraDocument(Strict):
    """One camera. Pixels are counted from the centre of the top-left one; the lens is OpenCV's (k1, k2, p1, p2, k3)."""

    name: str
    image_width_px: Annotated[int, Field(gt=0)]
    image_height_px: Annotated[int, Field(gt=0)]
    intrinsic_px: Matrix3 = Field(description="The camera matrix.")
    distortion: tuple[float, float, float, float, float]
    T_lab_cam: Matrix4 = Field(
        description="Maps camera coordinates (x right, y down, z forward) to the lab (Y up), metres."
    )
    delay_s: float = Field(description="By how much the camera runs late against the first one; negative: early.")
    delay_sd_s: float
    optics: OpticsDocument


class LabDocument(Strict):
    """Where the lab is: X is forward, Y up, the origin on the floor."""

    source: LabSource
    T_lab_ref: Matrix4 = Field(description="From the first camera's frame to the lab.")
    misfit_m: float | None
    tilt_sd_rad: float | None


class VolumeDocument(Strict):
    """The volume that the board was swept through, and the error to expect of a point in it (rms)."""

    lower_lab_m: Three
    upper_lab_m: Three
    error_m: float | None


class JudgementDocument(Strict):
    """A criterion's measured value, and up to where it is accepted, or accepted with a warning."""

    name: str
    level: Level
    value: float | None
    accept: float
    warn: float
    where: str


class VerdictDocument(Strict):
    """Whether the calibration may be used: the worst of its judgements."""

    level: Level
    judgements: list[JudgementDocument]


class FindingDocument(Strict):
    """Something that whoever uses the calibration should know, in words, and what to do about it."""

    code: str
    severity: Severity
    stage: str
    message: str
    hint: str
    where: str
    value: float | None
    unit: str
    camera: str = Field(default="", description="The camera that is meant.")
    joint: str = Field(default="", description="Always empty: a board has none.")


class CalibrationDocument(Strict):
    """A calibrated rig."""

    format: Literal["gonio calibration"]
    version: Literal[1]
    source: str
    board: str
    left_out: list[str] = Field(description="Cameras that could not be connected with the others.")
    cameras: Annotated[list[CameraDocument], Field(min_length=1)]
    sigma_px: float = Field(description="Noise of a board's corner, per axis.")
    covariance: list[list[float]] = Field(
        description="Of all cameras' unknowns, in the order camera, unknown: " + ", ".join(UNKNOWNS) + "."
    )
    lab: LabDocument
    volume: VolumeDocument
    verdict: VerdictDocument
    findings: list[FindingDocument] = Field(default=[])


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration."""
    document = _document(calibration).model_dump(mode="json")
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_calibration_document(path: Path) -> Calibration:
    """Read a calibration that :func:`write_calibration` wrote.

    Raises:
        InputError: ``calibration-unreadable``: it is damaged, or says something impossible; the field is named.
    """
    try:
        document = CalibrationDocument.model_validate_json(path.read_bytes())
        return _calibration(document)
    except InputError as error:
        raise InputError(f"{path.name}: {error.message}", hint=error.hint, code=error.code) from error
    except (ValidationError, ValueError, TypeError) as error:
        raise InputError(
            f"{path.name} is no valid calibration: {_first_words(error)}.",
            hint="Take the file as gonio wrote it, or calibrate again.",
            code="calibration-unreadable",
        ) from error


def is_calibration_document(head: bytes) -> bool:
    """Say whether a JSON file that begins like this is gonio's own."""
    return FORMAT.encode() in head


def calibration_schema() -> dict[str, Any]:
    """Give the JSON schema of the file."""
    return CalibrationDocument.model_json_schema()


def _first_words(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return " ".join(str(error).split())[:160]


def _document(calibration: Calibration) -> CalibrationDocument:
    return CalibrationDocument.model_validate(
        {
            "format": FORMAT,
            "version": 1,
            "source": calibration.rig.source,
            "board": calibration.board,
            "left_out": list(calibration.left_out),
            "cameras": [_camera_document(calibration, index) for index in range(len(calibration.rig.cameras))],
            "sigma_px": calibration.sigma_px,
            "covariance": calibration.covariance.tolist(),
            "lab": {
                "source": calibration.lab.source,
                "T_lab_ref": calibration.lab.T_lab_ref.tolist(),
                "misfit_m": _number(calibration.lab.misfit_m),
                "tilt_sd_rad": _number(calibration.lab.tilt_sd_rad),
            },
            "volume": {
                "lower_lab_m": calibration.volume.lower_lab_m.tolist(),
                "upper_lab_m": calibration.volume.upper_lab_m.tolist(),
                "error_m": _number(calibration.volume.error_m),
            },
            "verdict": {
                "level": calibration.verdict.level,
                "judgements": [
                    {
                        "name": j.name,
                        "level": j.level,
                        "value": _number(j.value),
                        "accept": j.accept,
                        "warn": j.warn,
                        "where": j.where,
                    }
                    for j in calibration.verdict.judgements
                ],
            },
            # A calibration's findings speak of no moment: a board's recording is not shown.
            "findings": [
                {name: value for name, value in asdict(finding).items() if name != "span_s"}
                for finding in calibration.findings
            ],
        }
    )


def _camera_document(calibration: Calibration, index: int) -> dict[str, Any]:
    camera, optics = calibration.rig.cameras[index], calibration.intrinsics[index]
    return {
        "name": camera.name,
        "image_width_px": camera.image_size_px[0],
        "image_height_px": camera.image_size_px[1],
        "intrinsic_px": camera.intrinsic_px.tolist(),
        "distortion": camera.distortion.tolist(),
        "T_lab_cam": camera.T_lab_cam.tolist(),
        "delay_s": float(calibration.delay_s[index]),
        "delay_sd_s": float(calibration.delay_sd_s[index]),
        "optics": {
            "model": optics.model,
            "origin": optics.origin,
            "source": optics.source,
            "parameters": dict(zip(INTRINSIC_NAMES, optics.parameters.tolist(), strict=True)),
            "covariance": optics.covariance.tolist(),
            "held_out_px": _number(optics.held_out_px),
            "rms_px": _number(optics.rms_px),
            "views": optics.views,
            "tilted_views": optics.tilted_views,
            "covered": optics.covered.tolist(),
        },
    }


def _calibration(document: CalibrationDocument) -> Calibration:
    return Calibration(
        rig=Rig(
            cameras=tuple(
                Camera(
                    name=camera.name,
                    image_size_px=(camera.image_width_px, camera.image_height_px),
                    intrinsic_px=np.array(camera.intrinsic_px),
                    distortion=np.array(camera.distortion),
                    T_lab_cam=np.array(camera.T_lab_cam),
                )
                for camera in document.cameras
            ),
            source=document.source,
        ),
        intrinsics=tuple(_intrinsics(camera) for camera in document.cameras),
        delay_s=np.array([camera.delay_s for camera in document.cameras]),
        covariance=np.array(document.covariance, dtype=np.float64),
        sigma_px=document.sigma_px,
        lab=LabFrame(
            T_lab_ref=np.array(document.lab.T_lab_ref),
            source=document.lab.source,
            misfit_m=_or_nan(document.lab.misfit_m),
            tilt_sd_rad=_or_nan(document.lab.tilt_sd_rad),
        ),
        volume=Volume(
            lower_lab_m=np.array(document.volume.lower_lab_m),
            upper_lab_m=np.array(document.volume.upper_lab_m),
            error_m=_or_nan(document.volume.error_m),
        ),
        verdict=Verdict(
            level=document.verdict.level,
            judgements=tuple(
                Judgement(
                    name=j.name, level=j.level, value=_or_nan(j.value), accept=j.accept, warn=j.warn, where=j.where
                )
                for j in document.verdict.judgements
            ),
        ),
        board=document.board,
        left_out=tuple(document.left_out),
        findings=tuple(Finding(**finding.model_dump()) for finding in document.findings),
    )


def _intrinsics(camera: CameraDocument) -> Intrinsics:
    optics = camera.optics
    return Intrinsics(
        camera_name=camera.name,
        image_size_px=(camera.image_width_px, camera.image_height_px),
        model=optics.model,
        parameters=np.array([optics.parameters.get(name, np.nan) for name in INTRINSIC_NAMES]),
        covariance=np.array(optics.covariance, dtype=np.float64),
        held_out_px=_or_nan(optics.held_out_px),
        rms_px=_or_nan(optics.rms_px),
        views=optics.views,
        tilted_views=optics.tilted_views,
        covered=np.array(optics.covered, dtype=bool),
        origin=optics.origin,
        source=optics.source,
    )


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
