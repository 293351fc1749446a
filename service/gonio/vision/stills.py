"""Read photographs: 8 or 16 bit, grey or colour, as they are viewed."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from gonio.errors import InputError
from gonio.vision import MAX_PIXELS

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

Grey = UInt8[np.ndarray, "height width"]


def read_grey(path: Path) -> Grey:
    """Read a photograph as grey values, turned as its camera says it is to be viewed.

    Sixteen-bit pictures are spread over their own range: a 12-bit camera's picture would else be black.

    Raises:
        InputError: ``image-missing``, ``image-empty`` or ``image-unreadable``.
    """
    grey = decoded(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if grey.dtype != np.uint8:
        dark, light = np.percentile(grey, [0.5, 99.5])
        grey = np.clip((grey.astype(np.float64) - dark) * (255.0 / max(light - dark, 1e-9)), 0, 255)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def read_rgb(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read a photograph in colour, turned as its camera says it is to be viewed; raises as :func:`read_grey`."""
    bgr = decoded(path, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def decoded(path: Path, flags: int) -> np.ndarray:
    """Decode a picture's file by OpenCV's flags; raises as :func:`read_grey`."""
    if not path.is_file():
        raise InputError(f"The picture {path.name} does not exist.", hint="Check its path.", code="image-missing")
    data = np.frombuffer(path.read_bytes(), np.uint8)
    if not data.size:
        raise InputError(
            f"{path.name} contains nothing at all.",
            hint="The copy failed: copy it from the camera again.",
            code="image-empty",
        )
    try:
        picture = cv2.imdecode(data, flags)
    except cv2.error:
        picture = None
    if picture is None or not 0 < picture.shape[0] * picture.shape[1] <= MAX_PIXELS or min(picture.shape[:2]) < 16:
        raise InputError(
            f"{path.name} can't be read as a picture.",
            hint="Give the camera's own JPEG, PNG or TIFF; copy it again if it is damaged.",
            code="image-unreadable",
        )
    return picture


def still_pictures(paths: Sequence[Path]) -> Callable[[], Iterator[tuple[int, Grey]]]:
    """Give photographs one after the other, numbered in their order; may be gone through several times."""

    def pictures() -> Iterator[tuple[int, Grey]]:
        for number, path in enumerate(paths):
            yield number, read_grey(path)

    return pictures
