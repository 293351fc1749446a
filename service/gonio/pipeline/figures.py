"""The figures of the report, as SVG text that stands in the page itself."""
# matplotlib's types are partly unknown.
# pyright: standard

import io
import re
from collections.abc import Sequence

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from gonio.pipeline.report_schema import Angle

COLOURS = {"right": "#D55E00", "left": "#0072B2"}
"""Vermillion and blue of the palette of Okabe & Ito: told apart by all common kinds of colour vision."""

DASHES = {"right": "solid", "left": (0, (5, 2))}


def angle_figure(time_s: Sequence[float], angles: Sequence[Angle]) -> str:
    """Draw the joint angles over time, a row a joint, right and left together, with 95 % bands; gaps stay gaps."""
    names = list(dict.fromkeys(angle.name for angle in angles))
    figure = Figure(figsize=(8.0, 0.4 + 2.0 * len(names)), layout="constrained")
    FigureCanvasSVG(figure)
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        for angle in (a for a in angles if a.name == name):
            values = [float("nan") if v is None else v for v in angle.values_deg]
            sd = [float("nan") if v is None else v for v in angle.sd_deg]
            axes.fill_between(
                time_s,
                [v - 1.96 * s for v, s in zip(values, sd, strict=True)],
                [v + 1.96 * s for v, s in zip(values, sd, strict=True)],
                color=COLOURS[angle.side],
                alpha=0.18,
                linewidth=0,
            )
            axes.plot(
                time_s, values, color=COLOURS[angle.side], linestyle=DASHES[angle.side], linewidth=1.8, label=angle.side
            )
        axes.axhline(0.0, color="#888888", linewidth=0.6)
        axes.set_title(name, loc="left", fontsize=10, fontweight="bold")
        axes.set_ylabel("degrees")
        axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0)
    rows[-1].set_xlabel("time (s)")
    rows[0].legend(loc="upper right", ncols=2, frameon=False)
    return svg_text(figure, "Hip, knee and ankle angles of both legs over time")


def svg_text(figure: Figure, description: str) -> str:
    """Turn a figure into an SVG element that screen readers announce by its description."""
    file = io.StringIO()
    # No date and fixed ids: the same report gives the same bytes.
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    element = text[text.index("<svg") :]
    element = re.sub(r' (width|height)="[^"]*pt"', "", element, count=2)
    return element.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
