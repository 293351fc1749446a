"""Read named points on the floor: where each camera shows them, and where they are in the lab.

::

    [points.corner_a]
    lab_m = [0.0, 0.0, 0.0]  # X forward, Y up, Z to the right; may be missing for a point that only ends a length
    cam_1 = [812.5, 633.0]  # pixels in that camera's picture
    cam_2 = [411.0, 702.5]
"""

import tomllib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records import record


@record
class FloorPoints:
    """Named points: their pixels in each camera and their places in the lab, NaN where not given."""

    names: tuple[str, ...]
    uv_px: Float[np.ndarray, "camera point 2"]
    xyz_lab_m: Float[np.ndarray, "point 3"]


def read_floor_points(path: Path, camera_names: tuple[str, ...] | None) -> FloorPoints:
    """Read the points; cameras that are not named in ``camera_names`` are an error, with None all that the file names are.

    Raises:
        InputError: ``floor-points-unreadable``; the message names the point and what is wrong with it.
    """
    try:
        points = tomllib.loads(path.read_text(encoding="utf-8-sig")).get("points")
    except ValueError as error:
        raise _bad(path, str(error).splitlines()[0]) from error
    if not isinstance(points, dict) or not points:
        raise _bad(path, "it has no table [points.…]")
    if camera_names is None:
        entries_of = (entries for entries in points.values() if isinstance(entries, dict))
        camera_names = tuple(dict.fromkeys(key for entries in entries_of for key in entries if key != "lab_m"))
    uv_px = np.full((len(camera_names), len(points), 2), np.nan)
    xyz_lab_m = np.full((len(points), 3), np.nan)
    for index, (name, entries) in enumerate(points.items()):
        if not isinstance(entries, dict):
            raise _bad(path, f"{name} is no table")
        for key, value in entries.items():
            if key == "lab_m":
                xyz_lab_m[index] = _numbers(path, f"{name}.{key}", value, 3)
            elif key in camera_names:
                uv_px[camera_names.index(key), index] = _numbers(path, f"{name}.{key}", value, 2)
            else:
                raise _bad(path, f"{name} names camera {key}; known are {', '.join(camera_names)}")
    return FloorPoints(names=tuple(points), uv_px=uv_px, xyz_lab_m=xyz_lab_m)


def _numbers(path: Path, where: str, value: object, count: int) -> Float[np.ndarray, " number"]:
    try:
        numbers = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        numbers = np.full(0, np.nan)
    if numbers.shape != (count,) or not (np.isfinite(numbers).all() and np.abs(numbers).max() < 1e6):
        raise _bad(path, f"{where} is not {count} numbers")
    return numbers


def _bad(path: Path, what: str) -> InputError:
    return InputError(
        f"{path.name} can't be read as floor points: {what}.",
        hint="Give each point a table [points.NAME] with lab_m = [x, y, z] and its pixel in two cameras or more.",
        code="floor-points-unreadable",
    )
