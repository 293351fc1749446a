"""Read and write Qualisys calibrations (``.qca.txt``): an XML file in millimetres, Z up, with cameras that look along -z.

What the file means, as measured on real recordings: focal lengths and principal points are in 1/64 pixel; the distortion
coefficients are OpenCV's, not divided by anything; the rows of ``transform``'s rotation are the camera's axes in the lab
in the order right, up, backward; the translation is the optical centre.
"""

from decimal import Decimal, InvalidOperation
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
    T_qualisys_cam[:3, 3] = [_metres(element, number("transform", axis), axis) for axis in "xyz"]
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


def write_qualisys_calibration(path: Path, rig: Rig) -> None:
    """Write a calibration that Qualisys' readers understand, Pose2Sim's among them. Reading it back is exact."""
    root = etree.Element("calibration", source=rig.source, type="regular")
    cameras = etree.SubElement(root, "cameras")
    for camera in rig.cameras:
        element = etree.SubElement(cameras, "camera", active="1", model="none", serial=camera.name, viewrotation="0")
        right, bottom = (size - 1 for size in camera.image_size_px)
        for field in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            etree.SubElement(element, field, left="0", top="0", right=str(right), bottom=str(bottom))
        etree.SubElement(element, "transform", _transform_attributes(camera))
        etree.SubElement(element, "intrinsic", _intrinsic_attributes(camera))
    path.write_bytes(etree.tostring(root, pretty_print=True, xml_declaration=True, encoding="UTF-8"))


def _transform_attributes(camera: Camera) -> dict[str, str]:
    T_qualisys_cam = T_LAB_QUALISYS.T @ camera.T_lab_cam
    axes = np.diag([1.0, -1.0, -1.0]) @ T_qualisys_cam[:3, :3].T  # right, down, forward -> right, up, back
    rotation = {f"r{row + 1}{column + 1}": repr(float(axes[row, column])) for row in range(3) for column in range(3)}
    # Decimal: a thousand times a number and a thousandth of that need not be the number again.
    place = {axis: str(Decimal(repr(float(t))) * 1000) for axis, t in zip("xyz", T_qualisys_cam[:3, 3], strict=True)}
    return rotation | place


def _intrinsic_attributes(camera: Camera) -> dict[str, str]:
    K = camera.intrinsic_px * SUBPIXELS
    k1, k2, p1, p2, k3 = camera.distortion
    width, height = camera.image_size_px
    values = {
        "focalLengthU": K[0, 0], "focalLengthV": K[1, 1], "centerPointU": K[0, 2], "centerPointV": K[1, 2],
        "skew": K[0, 1], "radialDistortion1": k1, "radialDistortion2": k2, "radialDistortion3": k3,
        "tangentalDistortion1": p1, "tangentalDistortion2": p2, "sensorMinU": 0.0, "sensorMinV": 0.0,
        "sensorMaxU": (width - 1) * SUBPIXELS, "sensorMaxV": (height - 1) * SUBPIXELS,
    }  # fmt: skip
    return {name: repr(float(value)) for name, value in values.items()}


def _metres(element: etree._Element, millimetres: float, axis: str) -> float:
    """Divide by a thousand in decimals, as the writer multiplied."""
    try:
        return float(Decimal(element.find("transform").get(axis).strip()) / 1000)  # pyright: ignore[reportOptionalMemberAccess]
    except InvalidOperation:  # Python reads some numbers as floats that are no decimals: 1_0
        return millimetres / 1000.0
