"""Read and write calibrations as OpenCV's file storage has them, YAML or JSON.

OpenCV has no layout for several cameras; ours is a list ``cameras``, each with the names that OpenCV's own calibration
sample uses: ``image_width``, ``image_height``, ``camera_matrix``, ``distortion_coefficients``; and with ``rotation`` and
``translation``, which map the world to the camera. ``up_axis`` says which of the world's axes is up; without it the one
nearest to the cameras' own upward direction is taken. A file of a single camera, as the sample writes it, has optics only.

OpenCV's own reader is not used: a damaged file makes it overwrite memory.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from gonio.errors import InputError
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import Camera, Rig

MAX_BYTES = 1_000_000
"""A calibration of a hundred cameras is a tenth of this."""

AXES = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0])}

_HINT = "Write it with cv2.FileStorage again, or compare it with docs/reference/calibration-formats.md."


def read_opencv_calibration(path: Path) -> Rig:
    """Read the cameras with their poses.

    Raises:
        InputError: ``calibration-unreadable``, or ``calibration-incomplete`` if a camera lacks something, such as a pose.
    """
    content, cameras = _content(path), []
    nodes = dict(_cameras(path, content))
    Ts_cam_world = np.stack([_pose(path.name, name, node) for name, node in nodes.items()])
    R_lab_world = _world_to_lab(content.get("up_axis"), Ts_cam_world)
    for (name, node), T_cam_world in zip(nodes.items(), Ts_cam_world, strict=True):
        T_lab_cam = transform(R_lab_world, np.zeros(3)) @ inverse(T_cam_world)
        cameras.append(replace(_optics(path.name, name, node), T_lab_cam=T_lab_cam))
    return Rig(cameras=tuple(cameras), source=path.name)


def read_opencv_optics(path: Path) -> tuple[Camera, ...]:
    """Read the cameras' optics alone; their poses are the identity.

    Raises:
        InputError: As :func:`read_opencv_calibration`.
    """
    return tuple(_optics(path.name, name, node) for name, node in _cameras(path, _content(path)))


def write_opencv_calibration(path: Path, rig: Rig) -> None:
    """Write a file that ``cv2.FileStorage`` reads: JSON if its name ends in ``.json``, else YAML. Metres, Y up."""
    nodes = [
        {
            "name": camera.name,
            "image_width": camera.image_size_px[0],
            "image_height": camera.image_size_px[1],
            "camera_matrix": camera.intrinsic_px,
            "distortion_coefficients": camera.distortion[:, None],
            "rotation": camera.T_cam_lab[:3, :3],
            "translation": camera.T_cam_lab[:3, 3:],
        }
        for camera in rig.cameras
    ]
    if path.suffix.lower() == ".json":
        document = {"up_axis": "y", "cameras": [{k: _matrix_node(v) for k, v in node.items()} for node in nodes]}
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")
        return
    lines = ["%YAML:1.0", "---", "up_axis: y", "cameras:"]
    for node in nodes:
        lines.append("   -")
        for key, value in node.items():
            lines += [f"      {line}" for line in _yaml_lines(key, value)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _matrix_node(value: Any) -> Any:  # noqa: ANN401 - a number, a text or a matrix
    if not isinstance(value, np.ndarray):
        return value
    rows, columns = value.shape
    return {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": value.ravel().tolist()}


def _yaml_lines(key: str, value: Any) -> list[str]:  # noqa: ANN401 - a number, a text or a matrix
    if isinstance(value, np.ndarray):
        data = ", ".join(repr(float(number)) for number in value.ravel())
        return [
            f"{key}: !!opencv-matrix",
            f"   rows: {value.shape[0]}",
            f"   cols: {value.shape[1]}",
            "   dt: d",
            f"   data: [ {data} ]",
        ]
    return [f"{key}: {json.dumps(value) if isinstance(value, str) else value}"]


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV writes it: plain values, and matrices by a tag of its own."""


def _read_matrix(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _read_matrix)


def _content(path: Path) -> dict[str, Any]:
    if path.stat().st_size > MAX_BYTES:
        raise _unreadable(f"{path.name} is larger than any calibration")
    try:
        decoded = path.read_text(encoding="utf-8-sig")
        if decoded.lstrip().startswith("{"):
            content = json.loads(decoded)
        else:
            # OpenCV writes %YAML:1.0, which is no YAML.
            content = yaml.load(decoded.replace("%YAML:1.0", "", 1), _Loader)  # noqa: S506 - a safe loader
    except (ValueError, yaml.YAMLError, RecursionError, TypeError) as error:
        said = " ".join(str(error).split())[:120]
        raise _unreadable(f"{path.name} can't be read as OpenCV's file storage: {said}") from error
    if not isinstance(content, dict):
        raise _unreadable(f"{path.name} holds no cameras")
    return content


def _cameras(path: Path, content: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    nodes = content.get("cameras", [content] if "camera_matrix" in content else [])
    if not isinstance(nodes, list) or not nodes or not all(isinstance(node, dict) for node in nodes):
        raise _unreadable(f"{path.name} holds no cameras")
    for number, node in enumerate(nodes):
        yield str(node.get("name", path.stem if len(nodes) == 1 else f"cam_{number}")), node


def _optics(file: str, name: str, node: dict[str, Any]) -> Camera:
    lens = _matrix(file, name, node, "distortion_coefficients", (4, 5)).ravel()
    size = [_matrix(file, name, node, f"image_{side}", (1,)).item() for side in ("width", "height")]
    return Camera(
        name=name,
        image_size_px=(round(size[0]), round(size[1])),
        intrinsic_px=_matrix(file, name, node, "camera_matrix", (9,)).reshape(3, 3),
        distortion=np.concatenate([lens, np.zeros(5 - len(lens))]),
        T_lab_cam=np.eye(4),
    )


def _pose(file: str, name: str, node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    rotation = _matrix(file, name, node, "rotation", (9,)).reshape(3, 3)
    return transform(rotation, _matrix(file, name, node, "translation", (3,)))


def _matrix(
    file: str, name: str, node: dict[str, Any], entry: str, counts: tuple[int, ...]
) -> Float[np.ndarray, " number"]:
    value = node.get(entry)
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.array(data, dtype=np.float64).ravel()
    except (ValueError, TypeError, OverflowError):
        numbers = np.full(1, np.nan)
    if numbers.size not in counts or not (np.isfinite(numbers).all() and np.abs(numbers).max() < 1e9):
        raise InputError(
            f"{file}, camera {name}: {entry} is not {' or '.join(map(str, counts))} numbers.",
            hint="The pose is missing in a file of optics only; its lens model must be the one with 4 or 5 coefficients."
            if entry == "rotation"
            else _HINT,
            code="calibration-incomplete",
        )
    return numbers


def _world_to_lab(up_axis: object, Ts_cam_world: Float[np.ndarray, "camera 4 4"]) -> Float[np.ndarray, "3 3"]:
    """Give the rotation that turns the world's up into the lab's Y: about one axis, by quarter turns."""
    if isinstance(up_axis, str) and up_axis.lower() in AXES:
        up = AXES[up_axis.lower()]
    else:
        cameras_up = -Ts_cam_world[:, 1, :3].mean(axis=0)
        nearest = max(AXES.values(), key=lambda axis: abs(float(axis @ cameras_up)))
        up = nearest * (np.sign(nearest @ cameras_up) or 1.0)
    forward = AXES["y"] if abs(up[0]) > 0.5 else AXES["x"]
    return np.stack([forward, up, np.cross(forward, up)])


def _unreadable(message: str) -> InputError:
    return InputError(f"{message}.", hint=_HINT, code="calibration-unreadable")
