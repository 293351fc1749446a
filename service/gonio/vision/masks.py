"""Masks of what a photograph shows: read them from PNG files, or cut something out of its box."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from gonio.errors import CaptureError, InputError
from gonio.vision.stills import decoded

AROUND = 0.25
"""How much of its size is looked at around a box: the background has to be seen to be told from what is in the box."""

WORKED_PX = 640
"""The longer side of the picture that GrabCut works on: its time goes with the pixels, and an edge is found finer than this."""

SPECK = 0.02
"""A piece that is a smaller share of the largest one is a speck."""


def read_mask(path: Path, size_px: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Read the mask of one part in one picture: white, or not transparent, where the part is; ``size_px`` is the picture's.

    Raises:
        InputError: ``mask-wrong-size``, ``mask-empty``, ``mask-full`` or ``mask-cut``, or the file is no picture.
    """
    picture = decoded(path, cv2.IMREAD_UNCHANGED)
    bright = np.atleast_3d(picture) > (np.iinfo(picture.dtype).max // 2 if picture.dtype.kind == "u" else 0)
    see_through = bright.shape[2] == 4 and not bright[..., 3].all()
    mask = np.asarray(bright[..., 3] if see_through else bright[..., :3].any(axis=-1), dtype=bool)
    where = f"The mask {path.parent.name}/{path.name}"
    if mask.shape[::-1] != tuple(size_px):
        raise InputError(
            f"{where} has {mask.shape[1]} × {mask.shape[0]} pixels, the picture {size_px[0]} × {size_px[1]}.",
            hint="Draw the mask over the photograph itself, without cutting or scaling it.",
            code="mask-wrong-size",
        )
    if not mask.any():
        raise InputError(
            f"{where} is empty.",
            hint="Paint the part white, or leave out the mask of a picture that does not show it.",
            code="mask-empty",
        )
    if mask.all():
        raise InputError(f"{where} covers the whole picture.", hint="Paint all but the part black.", code="mask-full")
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        raise InputError(
            f"{where} reaches the picture's border: the part is cut, and what lies beyond would be carved away.",
            hint="Leave out this picture's mask of the part, or take a picture that shows it whole.",
            code="mask-cut",
        )
    return mask


def write_mask(path: Path, mask: Bool[np.ndarray, "height width"]) -> None:
    """Write a mask as PNG, white where the part is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(".png", mask.astype(np.uint8) * 255)
    path.write_bytes(data.tobytes())


def cut_out(
    rgb: UInt8[np.ndarray, "height width 3"],
    box_px: tuple[int, int, int, int],
    *,
    without: Bool[np.ndarray, "height width"] | None = None,
) -> Bool[np.ndarray, "height width"]:
    """Find the thing in a box by GrabCut [Rother 2004]: what in the box looks unlike all around it. Deterministic.

    Args:
        rgb: The photograph.
        box_px: Left, top, right and bottom, half-open; as tight as can be without cutting the thing.
        without: Pixels that are surely something else, such as another part's mask.

    Raises:
        InputError: ``box-unfit``: the box is not in the picture, or leaves nothing around it.
        CaptureError: ``nothing-cut-out``: all in the box looks like what is around it.
    """
    height, width = rgb.shape[:2]
    left, top, right, bottom = box_px
    if not (0 <= left < right <= width and 0 <= top < bottom <= height) or min(right - left, bottom - top) < 8:
        raise InputError(
            f"The box {left}, {top}, {right}, {bottom} does not lie in the picture of {width} × {height} pixels, or is "
            "smaller than 8 pixels.",
            hint="Give left, top, right and bottom in pixels, from the picture's upper left corner.",
            code="box-unfit",
        )
    dx, dy = round(AROUND * (right - left)) + 4, round(AROUND * (bottom - top)) + 4
    x0, y0, x1, y1 = max(left - dx, 0), max(top - dy, 0), min(right + dx, width), min(bottom + dy, height)
    if (x0, y0, x1, y1) == (left, top, right, bottom):
        raise InputError(
            "The box is the whole picture: there is no background to tell the thing from.",
            hint="Draw the box closely around the thing.",
            code="box-unfit",
        )
    window = rgb[y0:y1, x0:x1]
    scale = min(1.0, WORKED_PX / max(window.shape[:2]))
    size = max(round(window.shape[1] * scale), 8), max(round(window.shape[0] * scale), 8)
    small = cv2.cvtColor(cv2.resize(window, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    inner = [round(v * scale) for v in (left - x0, top - y0, right - x0, bottom - y0)]
    labels[inner[1] : inner[3], inner[0] : inner[2]] = cv2.GC_PR_FGD
    if without is not None:
        other = cv2.resize(without[y0:y1, x0:x1].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
        labels[other] = cv2.GC_BGD
    cv2.setRNGSeed(0)
    cv2.grabCut(small, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 5, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload] - no rectangle
    found = _without_specks(labels == cv2.GC_PR_FGD)
    if not found.any():
        raise CaptureError(
            "Nothing in the box looks unlike what is around it.",
            hint="Draw the box closer, choose a plainer background, or paint the mask by hand.",
            code="nothing-cut-out",
        )
    mask = np.zeros((height, width), dtype=bool)
    fine = cv2.resize(found.astype(np.float32), (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
    mask[y0:y1, x0:x1] = fine > 0.5
    return mask if without is None else mask & ~without


def _without_specks(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas > SPECK * areas.max())[labels]
