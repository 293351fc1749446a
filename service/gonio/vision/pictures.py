"""Still pictures for the report: a frame as JPEG, and the reconstructed skeleton drawn over it."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SIDE_COLOURS_RGB = {"right": (213, 94, 0), "left": (0, 114, 178)}
"""Vermillion and blue (Okabe & Ito), as in the report's curves."""

MIDDLE_COLOUR_RGB = (240, 228, 66)

CLOSE, LEAST_SHARE = 1.5, 0.1
"""A closer look shows 1.5 times what the skeleton extends over, and a tenth of the picture beside it."""


def encode_jpeg(rgb: UInt8[np.ndarray, "height width 3"], quality: int = 85) -> bytes:
    """Encode a picture as JPEG."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def decode_jpeg(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """Decode a JPEG that :func:`encode_jpeg` made."""
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None  # it is our own
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def look_closer(
    rgb: UInt8[np.ndarray, "height width 3"], uv_px: Float[np.ndarray, "keypoint 2"]
) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "keypoint 2"]]:
    """Enlarge the part of a picture around points to the picture's size, and give the points' places in it.

    Where the points fill the picture, or none is in it, all of it stays. NaN points stay NaN.
    """
    size_px = np.array([rgb.shape[1], rgb.shape[0]], dtype=float)
    inside = uv_px[np.all((uv_px >= 0) & (uv_px < size_px), axis=1)]  # NaN is not inside
    if len(inside) == 0:
        return rgb, uv_px
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = min(1.0, CLOSE * float(np.max((high - low) / size_px)) + LEAST_SHARE)
    part_px = np.maximum(np.round(share * size_px), 1.0)
    corner = np.clip(np.round((low + high) / 2 - part_px / 2), 0, size_px - part_px)
    (left, top), (width, height) = corner.astype(int), part_px.astype(int)
    part = cv2.resize(
        rgb[top : top + height, left : left + width], (rgb.shape[1], rgb.shape[0]), interpolation=cv2.INTER_CUBIC
    )
    # A pixel's centre is at a whole number, its edges at halves: enlarging acts on the edges.
    return np.asarray(part, dtype=np.uint8), (uv_px + 0.5 - corner) * (size_px / part_px) - 0.5


def draw_skeleton(
    rgb: UInt8[np.ndarray, "height width 3"],
    uv_px: Float[np.ndarray, "keypoint 2"],
    names: Sequence[str],
    segments: Sequence[tuple[str, str]],
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a skeleton over a picture: right vermillion, left blue, the rest yellow. NaN points draw nothing."""
    picture = rgb.copy()
    thickness = max(2, round(max(rgb.shape) / 240))
    place = dict(zip(names, uv_px, strict=True))
    for start, end in segments:
        if np.isfinite([place[start], place[end]]).all():
            sides = {side for side in SIDE_COLOURS_RGB if start.startswith(side) and end.startswith(side)}
            colour = SIDE_COLOURS_RGB[sides.pop()] if sides else MIDDLE_COLOUR_RGB
            first, last = (
                (round(16 * float(place[name][0])), round(16 * float(place[name][1]))) for name in (start, end)
            )
            # White below the colour: seen on any background. Sixteenths of a pixel keep thin limbs smooth.
            cv2.line(picture, first, last, (255, 255, 255), thickness + 2, cv2.LINE_AA, shift=4)
            cv2.line(picture, first, last, colour, thickness, cv2.LINE_AA, shift=4)
    return picture
