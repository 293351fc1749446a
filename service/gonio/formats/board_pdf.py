"""Write a calibration board as a PDF of exact size, whole or in tiles, with a ruler to check the print's scale."""
# matplotlib's types are partly unknown.
# pyright: standard

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf, PdfPages
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

MM_PER_INCH = 25.4
TILE_OVERLAP_MM, TILE_BORDER_MM = 10.0, 8.0
"""Neighbouring tiles show the same strip, to lay one on the other; printers leave a border blank."""

METADATA = {"Creator": "gonio", "Producer": "gonio", "CreationDate": None}
"""No date and no version: the same board gives the same bytes."""


def write_board_pdf(
    path: Path,
    title: str,
    size_mm: tuple[float, float],
    rectangles_mm: Float[np.ndarray, "rectangle 4"],
    dark: Bool[np.ndarray, " rectangle"],
    *,
    dark_ground: bool,
    page_mm: tuple[float, float],
    tile_mm: tuple[float, float] | None = None,
) -> int:
    """Write the board in the middle of its page; give the number of pages.

    Args:
        path: Where to.
        title: Stands on the margin, with the advice to check the scale.
        size_mm: Width and height of the board.
        rectangles_mm: What is painted, in order (x, y, width, height), from the board's upper left corner, y down.
        dark: Which of it is dark.
        dark_ground: Whether the page is dark where nothing is painted.
        page_mm: The page that the board is made for.
        tile_mm: Cut that page into tiles of this paper size.
    """
    origin = (np.array(page_mm) - size_mm) / 2
    with PdfPages(path, metadata=METADATA) as pdf:
        windows = [(0.0, 0.0, *page_mm)] if tile_mm is None else _tiles(page_mm, tile_mm)
        for number, (left, top, width, height) in enumerate(windows, 1):
            figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
            FigureCanvasPdf(figure)
            axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.set_xlim(left, left + width)
            axes.set_ylim(top + height, top)
            axes.set_axis_off()
            _paint(axes, rectangles_mm + np.append(origin, [0, 0]), dark, page_mm if dark_ground else None)
            _write_margin(axes, title, origin, size_mm, light=dark_ground)
            if tile_mm is not None:
                _mark_tile(axes, (left, top, width, height), f"{title}: tile {number} of {len(windows)}")
            pdf.savefig(figure)
    return len(windows)


def _paint(axes: Axes, rectangles_mm: np.ndarray, dark: np.ndarray, ground_mm: tuple[float, float] | None) -> None:
    if ground_mm is not None:
        axes.add_patch(Rectangle((0, 0), *ground_mm, facecolor="black", linewidth=0))
    patches = [Rectangle((x, y), wide, high) for x, y, wide, high in rectangles_mm]
    colours = ["black" if is_dark else "white" for is_dark in dark]
    axes.add_collection(PatchCollection(patches, facecolors=colours, edgecolors="none", linewidths=0))


def _write_margin(axes: Axes, title: str, origin: np.ndarray, size_mm: tuple[float, float], *, light: bool) -> None:
    """Draw a ruler of whole centimetres below the board, at most 200 mm, and say above it what to do with it."""
    colour = "white" if light else "black"
    length = _ruler_mm(size_mm[0])
    below = origin[1] + size_mm[1] + min(origin[1] / 3, 8.0)
    _add_ruler(axes, (origin[0], below), length, colour)
    words = f"{title}.  Print at 100 %, not fitted to the page: the ruler below is {length:g} mm long.  Mount it flat."
    axes.text(origin[0], origin[1] - min(origin[1] / 4, 6.0), words, fontsize=5.5, color=colour, family="DejaVu Sans")


def _ruler_mm(room_mm: float) -> float:
    return float(min(200.0, 10 * np.floor(room_mm / 10)))


def _add_ruler(
    axes: Axes, start: Sequence[float], length: float, colour: str, *, upright: bool = False, zorder: int = 1
) -> None:
    """Draw a ruler from ``start`` to the right with its ticks below, or downwards with its ticks to the left."""
    ticks = [(0.0, 0.0, length, 0.2)]
    ticks += [(at - 0.1, 0.0, 0.2, 2.0 if at % 50 == 0 else 1.2) for at in np.arange(0, length + 1, 10)]
    if upright:
        ticks = [(-across - high, along, high, wide) for along, across, wide, high in ticks]
    marks = [Rectangle((start[0] + x, start[1] + y), w, h) for x, y, w, h in ticks]
    axes.add_collection(PatchCollection(marks, facecolors=colour, linewidths=0, zorder=zorder))


def _tiles(page_mm: Sequence[float], tile_mm: Sequence[float]) -> list[tuple[float, float, float, float]]:
    """Cut a page into windows of one paper size, upright or lying as fewer are needed; neighbours overlap."""
    lying, standing = (_windows(page_mm, turned) for turned in (tile_mm[::-1], tile_mm))
    return lying if len(lying) < len(standing) else standing


def _windows(page_mm: Sequence[float], tile_mm: Sequence[float]) -> list[tuple[float, float, float, float]]:
    starts: list[list[float]] = []
    for page, tile in zip(page_mm, tile_mm, strict=True):
        step = tile - 2 * TILE_BORDER_MM - TILE_OVERLAP_MM
        count = max(1, int(np.ceil((page - TILE_OVERLAP_MM) / step)))
        starts.append([index * step - TILE_BORDER_MM for index in range(count)])
    width, height = tile_mm
    return [(left, top, width, height) for top in starts[1] for left in starts[0]]


def _mark_tile(axes: Axes, window: tuple[float, float, float, float], words: str) -> None:
    """Blank the border that no printer prints, draw the lines to cut along, and a ruler for each direction beside them.

    Each tile is a print of its own, and a printer may stretch the length of the page alone.
    """
    left, top, width, height = window
    border = TILE_BORDER_MM
    for x, y, w, h in (
        (left, top, width, border), (left, top + height - border, width, border),
        (left, top, border, height), (left + width - border, top, border, height),
    ):  # fmt: skip
        axes.add_patch(Rectangle((x, y), w, h, facecolor="white", linewidth=0, zorder=3))
    wide, high = width - 2 * border, height - 2 * border
    axes.add_patch(
        Rectangle((left + border, top + border), wide, high, fill=False, edgecolor="#999999", linewidth=0.3, zorder=4)
    )
    across, down = _ruler_mm(wide), _ruler_mm(high)
    _add_ruler(axes, (left + border, top + height - border), across, "black", zorder=5)
    _add_ruler(axes, (left + border, top + border), down, "black", upright=True, zorder=5)
    words += f"; its rulers are {across:g} mm (below) and {down:g} mm (left) long"
    axes.text(left + border, top + border - 1.5, words, fontsize=5.5, zorder=5, family="DejaVu Sans")
