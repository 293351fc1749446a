"""Still pictures for the report: a frame as JPEG, and the reconstructed skeleton drawn over it."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SIDE_COLOURS_RGB = {"right": (213, 94, 0), "left": (0, 114, 178)}
"""Vermillion and blue (Okabe & Ito), as in the report's curves."""

MIDDLE_COLOUR_RGB = (240, 228, 66)


def encode_jpeg(rgb: UInt8[np.ndarray, "height width 3"], quality: int = 85) -> bytes:
    """Encode a picture as JPEG."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def decode_jpeg(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """Decode a JPEG that :func:`encode_jpeg` made."""
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None  # it is our own
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


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
