"""Read a Qualisys calibration (``.qca.txt``): an XML file in millimetres, Z up, with cameras that look along -z.

What the file means, as measured on real recordings: focal lengths and principal points are in 1/64 pixel; the distortion
coefficients are OpenCV's, not divided by anything; the rows of ``transform``'s rotation are the camera's axes in the lab
in the order right, up, backward; the translation is the optical centre.
"""

from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - no types

from gonio.errors import InputError
from gonio.records import Camera, Rig

SUBPIXELS = 64.0
T_LAB_QUALISYS = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Qualisys has Z up; the lab has Y up. X stays."""

_BAD_FILE_HINT = "Export the calibration again from Qualisys Track Manager (File > Export > Calibration)."


def read_qualisys_calibration(path: Path) -> Rig:
    """Read the cameras of a Qualisys calibration, in the order of their names.

    Raises:
        InputError: ``calibration-unreadable`` if the file is no Qualisys calibration, ``calibration-incomplete`` if a
            camera lacks a value; both name the file and the element.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(path.read_bytes(), parser)
    except etree.XMLSyntaxError as error:
        raise InputError(
            f"{path.name} is no Qualisys calibration: {error.msg}.", hint=_BAD_FILE_HINT, code="calibration-unreadable"
        ) from error
    elements = root.findall("cameras/camera")
    if root.tag != "calibration" or not elements:
        raise InputError(f"{path.name} holds no cameras.", hint=_BAD_FILE_HINT, code="calibration-unreadable")
    cameras = [_camera(element, path.name) for element in elements]
    return Rig(cameras=tuple(sorted(cameras, key=lambda camera: camera.name)), source=path.name)


def _camera(element: etree._Element, file: str) -> Camera:
    name = element.get("serial")
    if not name:
        raise InputError(
            f"{file}: a camera has no serial.", hint="Give each camera a serial.", code="calibration-incomplete"
        )

    def number(tag: str, attribute: str, default: float | None = None) -> float:
        text = element.find(tag).get(attribute) if element.find(tag) is not None else None  # pyright: ignore[reportOptionalMemberAccess]
        if text is None and default is not None:
            return default
        try:
            value = float(text)  # pyright: ignore[reportArgumentType] - None raises TypeError, handled below
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            raise InputError(
                f"{file}, camera {name}: <{tag}> has no number {attribute} (it says {text!r}).",
                hint=_BAD_FILE_HINT,
                code="calibration-incomplete",
            )
        return value

    left, top = number("fov_video", "left"), number("fov_video", "top")
    intrinsic_px = np.array(
        [
            [number("intrinsic", "focalLengthU"), number("intrinsic", "skew", 0.0), number("intrinsic", "centerPointU")],
            [0.0, number("intrinsic", "focalLengthV"), number("intrinsic", "centerPointV")],
            [0.0, 0.0, SUBPIXELS],
        ]
    ) / SUBPIXELS  # fmt: skip
    intrinsic_px[:2, 2] -= (left, top)
    axes_in_qualisys = np.array([[number("transform", f"r{row}{column}") for column in "123"] for row in "123"])
    T_qualisys_cam = np.eye(4)
    T_qualisys_cam[:3, :3] = (
        np.diag([1.0, -1.0, -1.0]) @ axes_in_qualisys
    ).T  # right, up, back -> right, down, forward
    T_qualisys_cam[:3, 3] = [number("transform", axis) / 1000.0 for axis in "xyz"]
    return Camera(
        name=name,
        image_size_px=(
            round(number("fov_video", "right") - left) + 1,
            round(number("fov_video", "bottom") - top) + 1,
        ),
        intrinsic_px=intrinsic_px,
        distortion=np.array(
            [
                number("intrinsic", "radialDistortion1"),
                number("intrinsic", "radialDistortion2"),
                number("intrinsic", "tangentalDistortion1", 0.0),
                number("intrinsic", "tangentalDistortion2", 0.0),
                number("intrinsic", "radialDistortion3", 0.0),
            ]
        ),
        T_lab_cam=T_LAB_QUALISYS @ T_qualisys_cam,
    )
