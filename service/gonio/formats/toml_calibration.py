"""Read and write the TOML calibrations of anipose, Pose2Sim and Caliscope: one dialect, with a table a camera.

``rotation`` (Rodrigues' vector, or a 3 × 3 matrix) and ``translation`` are OpenCV's ``[R|t]``: they map the world to the
camera. Pose2Sim and Caliscope have a world in metres with Z up. anipose has no vertical of its own: its world is where its
board or its first camera was, in the unit of its board, which is usually the millimetre.
"""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import Camera, Rig

T_LAB_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The files' world has Z up, the lab Y up. X stays."""

FARTHEST_M = 100.0
"""Cameras further apart than this are in millimetres: no laboratory is larger, and none smaller than 0.1 m."""

_HINT = "Export the calibration again, or compare it with what the program that wrote it documents."


def read_toml_calibration(path: Path) -> Rig:
    """Read the cameras with their poses, in the order of the file.

    Raises:
        InputError: ``calibration-unreadable``: no TOML, or no cameras in it; ``calibration-incomplete``: a camera lacks
            something; ``calibration-lens-unknown``: its lens model is another one (fisheye). The camera is named.
    """
    tables = _tables(path)
    Ts_cam_world = np.stack([_pose(path.name, name, table) for name, table in tables.items()])
    Ts_lab_cam = T_LAB_WORLD @ inverse(Ts_cam_world)
    if np.ptp(Ts_lab_cam[:, :3, 3], axis=0).max() > FARTHEST_M:
        Ts_lab_cam[:, :3, 3] /= 1000.0
    optics = [_optics(path.name, name, table) for name, table in tables.items()]
    return Rig(
        cameras=tuple(replace(camera, T_lab_cam=T) for camera, T in zip(optics, Ts_lab_cam, strict=True)),
        source=path.name,
    )


def read_toml_optics(path: Path) -> tuple[Camera, ...]:
    """Read the cameras' optics alone; their poses are the identity, whether the file has any or not.

    Raises:
        InputError: As :func:`read_toml_calibration`.
    """
    return tuple(_optics(path.name, name, table) for name, table in _tables(path).items())


def write_toml_calibration(path: Path, rig: Rig) -> None:
    """Write a calibration that anipose, Pose2Sim and Caliscope read: metres, Z up.

    Raises:
        InputError: ``calibration-skewed``: a camera matrix has a skew, which these programs don't know.
    """
    lines: list[str] = []
    for number, camera in enumerate(rig.cameras):
        K = camera.intrinsic_px
        if K[0, 1] != 0:
            raise InputError(
                f"Camera {camera.name} has skewed pixels, which a TOML calibration can't say.",
                hint="Write the calibration as JSON or for Qualisys instead.",
                code="calibration-skewed",
            )
        T_cam_world = inverse(camera.T_lab_cam) @ T_LAB_WORLD
        distortion = camera.distortion if camera.distortion[4] != 0 else camera.distortion[:4]
        lines += [
            f"[cam_{number}]",
            f"name = {_quoted(camera.name)}",
            f"size = {_list(camera.image_size_px)}",
            f"matrix = [{', '.join(_list(row) for row in K)}]",
            f"distortions = {_list(distortion)}",
            f"rotation = {_list(Rotation.from_matrix(T_cam_world[:3, :3]).as_rotvec())}",
            f"translation = {_list(T_cam_world[:3, 3])}",
            "fisheye = false",
            "",
        ]
    lines += ["[metadata]", "adjusted = false", "error = 0.0", ""]
    path.write_text("\n".join(lines), encoding="utf-8")


def _tables(path: Path) -> dict[str, dict[str, Any]]:
    """Give each camera's table: those of Caliscope are one level down, and its older files hold other tables too."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise _unreadable(f"{path.name} is no TOML: {str(error).splitlines()[0]}") from error
    nested = content.get("cameras")
    found: dict[str, dict[str, Any]] = {}
    for key, table in (nested if isinstance(nested, dict) else content).items():
        if isinstance(table, dict) and "matrix" in table and table.get("ignore") is not True:
            default = f"cam_{table['cam_id']}" if "cam_id" in table else f"cam_{key}" if key.isdigit() else key
            found[str(table.get("name", default))] = table
    if not found:
        raise _unreadable(f"{path.name} holds no cameras")
    return found


def _optics(file: str, name: str, table: dict[str, Any]) -> Camera:
    if table.get("fisheye", False):
        raise InputError(
            f"{file}: camera {name} has a fisheye lens model, which gonio does not have.",
            hint="Calibrate it with gonio: film a board with it, and use the camera's linear or narrow mode.",
            code="calibration-lens-unknown",
        )
    lens = _numbers(file, name, table, "distortions", (4,), (5,), (1, 5), (5, 1), (1,)).ravel()
    size = _numbers(file, name, table, "size", (2,))
    return Camera(
        name=name,
        image_size_px=(round(float(size[0])), round(float(size[1]))),
        intrinsic_px=_numbers(file, name, table, "matrix", (3, 3)),
        distortion=np.concatenate([lens, np.zeros(5 - len(lens))]),
        T_lab_cam=np.eye(4),
    )


def _pose(file: str, name: str, table: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Give ``T_cam_world``, in the file's unit."""
    rotation = _numbers(file, name, table, "rotation", (3,), (3, 3), (3, 1))
    translation = _numbers(file, name, table, "translation", (3,), (3, 1)).ravel()
    turn = rotation if rotation.shape == (3, 3) else Rotation.from_rotvec(rotation.ravel()).as_matrix()
    return transform(turn, translation)


def _numbers(
    file: str, camera: str, table: dict[str, Any], entry: str, *shapes: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
    try:
        value = np.array(table[entry], dtype=np.float64)
    except (KeyError, ValueError, TypeError, OverflowError):
        value = np.full(0, np.nan)
    # Beyond 1e9 nothing is a pixel or a metre, and products of it would overflow.
    if value.shape not in shapes or not (np.isfinite(value).all() and np.abs(value).max() < 1e9):
        wanted = " or ".join(" × ".join(map(str, shape)) for shape in shapes)
        raise InputError(
            f"{file}, camera {camera}: {entry} is not {wanted} numbers.", hint=_HINT, code="calibration-incomplete"
        )
    return value


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _list(values: Any) -> str:  # noqa: ANN401 - numbers, in whatever sequence
    return "[" + ", ".join(repr(value.item() if isinstance(value, np.generic) else value) for value in values) + "]"


def _unreadable(message: str) -> InputError:
    return InputError(f"{message}.", hint=_HINT, code="calibration-unreadable")
