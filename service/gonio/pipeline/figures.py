"""The figures of the report, as SVG text that stands in the page itself."""
# matplotlib's types are partly unknown.
# pyright: standard

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from gonio.pipeline.report_base import Side
from gonio.pipeline.report_gait import CycleCurve, GaitReportSection
from gonio.pipeline.report_schema import Angle
from gonio.pipeline.rounding import array_of

COLOURS: dict[Side, str] = {"right": "#D55E00", "left": "#0072B2"}
"""Vermillion and blue of the palette of Okabe & Ito: told apart by all common kinds of colour vision."""

DASHES: dict[Side, Any] = {"right": "solid", "left": (0, (5, 2))}
NORM = "#9a9a9a"
INK, SOFT = "#1c2430", "#5b6675"
SIDES: tuple[Side, Side] = ("right", "left")

PERCENT = np.linspace(0.0, 100.0, 101)
PANEL_IN = {"wide": 2.35, "narrow": 1.75, "phases": 0.62, "legend": 0.35}

PHASES = ("loading", "mid-stance", "push-off", "swing")
PHASE_SHADES = ("#c9d3de", "#e3e8ee", "#c9d3de", "#ffffff")


def cycle_figure(gait: GaitReportSection) -> str:
    """Draw the curves over the gait cycle: the knee large, hip and ankle below it; moments beside or below, if there are any.

    Both sides with the band of their error, single cycles thin, the healthy band grey, toe-off as a line, and on top how
    the phases of both sides lie. Empty without a cycle.
    """
    drawn = [c for c in gait.curves if any(v is not None for v in c.mean)]
    if not drawn:
        return ""
    by_quantity = {q: [c for c in drawn if c.quantity == q] for q in dict.fromkeys(c.quantity for c in drawn)}
    rows = _layout(by_quantity)
    heights = [PANEL_IN["phases"], *(PANEL_IN["wide" if i == 0 else "narrow"] for i in range(len(rows)))]
    figure = Figure(figsize=(8.0, PANEL_IN["legend"] + sum(heights)), layout="constrained")
    FigureCanvasSVG(figure)
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    _draw_phases(figure.add_subplot(grid[0, :]), gait)
    for i, row in enumerate(rows, 1):
        for j, quantity in enumerate(row):
            axes = figure.add_subplot(grid[i, :] if len(row) == 1 else grid[i, j])
            _draw_quantity(axes, by_quantity[quantity], gait, last=i == len(rows))
    handles = _legend(drawn)
    figure.legend(
        handles=list(handles.values()),
        labels=list(handles),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)},
        loc="outside upper center",
        ncols=6,
        frameon=False,
        fontsize=8.5,
    )
    return svg_text(figure, "Knee, hip and ankle over the gait cycle, both sides, with the band of healthy people")


def angle_figure(time_s: Sequence[float], angles: Sequence[Angle]) -> str:
    """Draw the joint angles over time, a row a joint, right and left together, with 95 % bands; gaps stay gaps."""
    names = list(dict.fromkeys(angle.name for angle in angles))
    figure = Figure(figsize=(8.0, 0.45 + 1.1 * len(names)), layout="constrained")
    FigureCanvasSVG(figure)
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        for angle in (a for a in angles if a.name == name):
            values, sd = array_of(angle.values_deg), array_of(angle.sd_deg)
            _draw_band(axes, time_s, values, 1.96 * sd, angle.side)
            axes.plot(time_s, values, color=COLOURS[angle.side], linestyle=DASHES[angle.side], linewidth=1.5)
        _dress(axes, name, "degrees")
    rows[-1].set_xlabel("time (s)", fontsize=8.5)
    sides = [Line2D([], [], color=COLOURS[s], linestyle=DASHES[s], linewidth=1.8, label=s) for s in SIDES]
    figure.legend(handles=sides, loc="outside upper center", ncols=2, frameon=False, fontsize=8.5)
    return svg_text(figure, "Hip, knee and ankle angles of both legs over time")


def _layout(quantities: dict[str, list[CycleCurve]]) -> list[list[str]]:
    """Give the rows of panels: the knee's first; hip beside ankle."""
    wanted = [
        ["knee_flexion", "knee_extension_moment"],
        ["hip_flexion", "ankle_dorsiflexion"],
        ["hip_extension_moment", "ankle_plantarflexion_moment"],
    ]
    rows = [[q for q in row if q in quantities] for row in wanted]
    return [row for row in rows if row]


def _draw_quantity(axes: Axes, curves: Sequence[CycleCurve], gait: GaitReportSection, *, last: bool) -> None:
    norm = next((c.norm for c in curves if c.norm is not None), None)
    if norm is not None:
        mean, sd = array_of(norm.mean), array_of(norm.sd)
        axes.fill_between(PERCENT, mean - sd, mean + sd, color=NORM, alpha=0.3, linewidth=0)
    for curve in curves:
        counts = [c.left_out == "" for c in gait.cycles if c.side == curve.side]
        kept = [cycle for cycle, counted in zip(curve.cycles, counts, strict=True) if counted]
        if len(kept) > 1:
            for cycle in kept:
                axes.plot(PERCENT, array_of(cycle), color=COLOURS[curve.side], linewidth=0.5, alpha=0.55)
        mean = array_of(curve.mean)
        _draw_band(axes, PERCENT, mean, 1.96 * array_of(curve.error_sd), curve.side)
        axes.plot(PERCENT, mean, color=COLOURS[curve.side], linestyle=DASHES[curve.side], linewidth=2.0)
        toe_off = _phase_marks(gait, curve.side)[2]
        axes.axvline(toe_off, color=COLOURS[curve.side], linestyle=DASHES[curve.side], linewidth=0.9, alpha=0.8)
    _dress(axes, curves[0].name, {"deg": "degrees"}.get(curves[0].unit, curves[0].unit))
    axes.set_xticks(range(0, 101, 20))
    if last:
        axes.set_xlabel("gait cycle (%), from one initial contact to the next", fontsize=8.5)


def _draw_phases(axes: Axes, gait: GaitReportSection) -> None:
    """Draw a bar a side with the phases of its mean cycle, named where there is room."""
    for y, side in enumerate(SIDES):
        marks = _phase_marks(gait, side)
        edges = np.array([0.0, *marks, 100.0])
        if np.isnan(edges).all():
            continue
        for phase, shade, start, end in zip(PHASES, PHASE_SHADES, edges[:-1], edges[1:], strict=True):
            if np.isfinite(start + end):
                axes.barh(y, end - start, left=start, height=0.8, color=shade, edgecolor=COLOURS[side], linewidth=0.8)
                axes.text((start + end) / 2, y, phase, ha="center", va="center", fontsize=7.5, color=INK)
    axes.set_yticks([0, 1], SIDES, fontsize=8.5)
    axes.set_ylim(1.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xticks([])
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)


def _phase_marks(gait: GaitReportSection, side: Side) -> list[float]:
    """Give the mean per cent of the opposite toe-off, the heel-off and the toe-off of a side; NaN where never seen."""
    kept = [c for c in gait.cycles if c.side == side and not c.left_out]
    marks: list[float] = []
    for values in zip(
        *((c.opposite_toe_off_percent, c.heel_off_percent, c.toe_off_percent) for c in kept), strict=True
    ):
        known = [v for v in values if v is not None]
        marks.append(float(np.mean(known)) if known else np.nan)
    return marks or [np.nan] * 3


def _legend(curves: Sequence[CycleCurve]) -> dict[str, Any]:
    """Give what the lines and bands mean; it stands above the panels, where no curve is."""
    handles: dict[str, Any] = {
        f"{side} (mean)": Line2D([], [], color=COLOURS[side], linestyle=DASHES[side], linewidth=2.0)
        for side in SIDES
        if any(c.side == side for c in curves)
    }
    if any(v is not None for c in curves for v in c.error_sd):
        handles["95 % band of the error"] = tuple(Patch(facecolor=COLOURS[s], alpha=0.25) for s in SIDES)
    handles["toe-off"] = tuple(
        Line2D([0], [0], color=COLOURS[s], linestyle="none", marker="|", markersize=10) for s in SIDES
    )
    if any(c.norm for c in curves):
        handles["healthy people, ± 1 SD"] = Patch(facecolor=NORM, alpha=0.4)
    return handles


def _draw_band(axes: Axes, x: Any, mean: np.ndarray, half: np.ndarray, side: Side) -> None:  # noqa: ANN401 - array-like
    axes.fill_between(x, mean - half, mean + half, color=COLOURS[side], alpha=0.18, linewidth=0)


def _dress(axes: Axes, title: str, unit: str) -> None:
    axes.axhline(0.0, color="#888888", linewidth=0.6)
    axes.set_title(title, loc="left", fontsize=9.5, fontweight="bold", color=INK)
    axes.set_ylabel(unit, fontsize=8.5)
    axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
    axes.tick_params(labelsize=8.5, colors=SOFT, labelcolor=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0)


def svg_text(figure: Figure, description: str) -> str:
    """Turn a figure into an SVG element that screen readers announce by its description."""
    file = io.StringIO()
    # No date and fixed ids: the same report gives the same bytes.
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    element = text[text.index("<svg") :]
    element = re.sub(r' (width|height)="[^"]*pt"', "", element, count=2)
    return element.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
