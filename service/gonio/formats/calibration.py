"""Read and write calibrations of every format that gonio knows; a file is known by what it holds."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gonio.errors import InputError
from gonio.formats.calibration_json import is_calibration_document, read_calibration_document, write_calibration
from gonio.formats.opencv_calibration import (
    read_opencv_calibration,
    read_opencv_optics,
    write_opencv_calibration,
)
from gonio.formats.qualisys import read_qualisys_calibration, write_qualisys_calibration
from gonio.formats.toml_calibration import read_toml_calibration, read_toml_optics, write_toml_calibration
from gonio.records import Calibration, Camera, Intrinsics, Rig

HEAD_BYTES = 4096


def read_calibration(path: Path) -> Rig:
    """Read the calibrated cameras of a file: gonio's own JSON, Qualisys, TOML (anipose, Pose2Sim, Caliscope), OpenCV.

    Raises:
        InputError: ``calibration-format-unknown`` if no reader knows the file; else what its reader says.
    """
    kind = _kind(path)
    if kind == "gonio":
        return read_calibration_document(path).rig
    readers: dict[str, Callable[[Path], Rig]] = {
        "qualisys": read_qualisys_calibration,
        "opencv": read_opencv_calibration,
        "toml": read_toml_calibration,
    }
    return readers[kind](path)


def read_own_calibration(path: Path) -> Calibration | None:
    """Read all of gonio's own file, verdict and error bars included; None for a file of another program.

    Raises:
        InputError: As :func:`read_calibration`.
    """
    return read_calibration_document(path) if _kind(path) == "gonio" else None


def read_intrinsics(path: Path) -> tuple[Intrinsics, ...]:
    """Read the optics of the cameras in a file, with their error bars where it has them (gonio's own).

    Raises:
        InputError: As :func:`read_calibration`.
    """
    kind = _kind(path)
    if kind == "gonio":
        return read_calibration_document(path).intrinsics
    if kind == "qualisys":
        cameras = read_qualisys_calibration(path).cameras
    else:
        cameras = read_opencv_optics(path) if kind == "opencv" else read_toml_optics(path)
    return tuple(intrinsics_of(camera, path.name) for camera in cameras)


def intrinsics_of(camera: Camera, source: str) -> Intrinsics:
    """Take a camera's optics as given: nothing is known of how well they are known."""
    K = camera.intrinsic_px
    return Intrinsics(
        camera_name=camera.name,
        image_size_px=camera.image_size_px,
        model="k1k2",
        parameters=np.array([K[0, 0], K[1, 1] / K[0, 0], K[0, 2], K[1, 2], *camera.distortion]),
        covariance=np.zeros((9, 9)),
        held_out_px=np.nan,
        rms_px=np.nan,
        views=0,
        tilted_views=0,
        covered=np.zeros((4, 6), dtype=bool),
        origin="file",
        source=source,
    )


def write_calibration_as(path: Path, calibration: Calibration) -> None:
    """Write a calibration in the format that the file's name asks for.

    ``.qca.txt`` is Qualisys, ``.toml`` anipose, Pose2Sim and Caliscope, ``.yml`` and ``.yaml`` OpenCV; ``.opencv.json`` is
    OpenCV's JSON and any other ``.json`` gonio's own, which alone keeps error bars, delays and the verdict.

    Raises:
        InputError: ``calibration-format-unknown``.
    """
    name = path.name.lower()
    if name.endswith(".qca.txt"):
        write_qualisys_calibration(path, calibration.rig)
    elif name.endswith(".toml"):
        write_toml_calibration(path, calibration.rig)
    elif name.endswith((".yml", ".yaml", ".opencv.json")):
        write_opencv_calibration(path, calibration.rig)
    elif name.endswith(".json"):
        write_calibration(path, calibration)
    else:
        raise InputError(
            f"{path.name} names no calibration format that gonio writes.",
            hint="End it in .json, .qca.txt, .toml, .yml or .opencv.json.",
            code="calibration-format-unknown",
        )


def _kind(path: Path) -> str:
    """Find out which format a file has."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES).lstrip(b"\xef\xbb\xbf \t\r\n")
    if head.startswith(b"<"):
        return "qualisys"
    if head.startswith(b"{"):
        return "gonio" if is_calibration_document(head) else "opencv"
    if head.startswith(b"%YAML"):
        return "opencv"
    try:
        if tomllib.loads(path.read_text(encoding="utf-8-sig")):
            return "toml"
    except ValueError:
        pass
    raise InputError(
        f"{path.name} is in no calibration format that gonio reads.",
        hint="Give gonio's own calibration (.json), a Qualisys calibration (.qca.txt), or one of anipose, Pose2Sim, "
        "Caliscope (.toml) or OpenCV (.yml, .json).",
        code="calibration-format-unknown",
    )
