"""The figures of a calibration's report: where the cameras stand, and what of their pictures the board reached."""
# matplotlib's types are partly unknown.
# pyright: standard

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from gonio.kernel.calibration.intrinsics import coverage
from gonio.pipeline.figures import svg_text
from gonio.records import BoardViews, Intrinsics, Rig

BLUE, VERMILLION, GREY, SHADE = "#0072B2", "#D55E00", "#888888", "#FBE3CF"
MOST_POINTS = 1500


def plan_figure(rig: Rig, seen_lab_m: Float[np.ndarray, "point 3"], what: str = "board") -> str:
    """Draw the room from above and from the side: cameras, where they look, and what they saw; X forward, Y up."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    FigureCanvasSVG(figure)
    shown = seen_lab_m[:: max(1, len(seen_lab_m) // MOST_POINTS)]
    extent = max(float(np.ptp(np.array([c.centre_lab_m for c in rig.cameras]), axis=0).max()), 1.0)
    views = (("From above", 0, 2, "Z, to the right (m)"), ("From the side", 0, 1, "Y, up (m)"))
    for axes, (title, across, along, label) in zip(figure.subplots(1, 2), views, strict=True):
        axes.scatter(shown[:, across], shown[:, along], s=2, color=GREY, linewidths=0, rasterized=False)
        for camera in rig.cameras:
            centre, ahead = camera.centre_lab_m, camera.T_lab_cam[:3, 2] * extent / 5
            axes.plot(
                [centre[across], centre[across] + ahead[across]],
                [centre[along], centre[along] + ahead[along]],
                color=BLUE,
            )
            axes.plot(centre[across], centre[along], "o", color=BLUE, markersize=5)
            axes.annotate(
                camera.name, (centre[across], centre[along]), textcoords="offset points", xytext=(4, 4), fontsize=8
            )
        axes.annotate(
            "", xy=(extent / 4, 0), xytext=(0, 0), arrowprops={"arrowstyle": "->", "color": VERMILLION, "lw": 2}
        )
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("X, forward (m)")
        axes.set_ylabel(label)
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
        axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
    if figure.axes:
        figure.axes[0].invert_yaxis()  # seen from above, the right hand of one who walks along X is below
    return svg_text(figure, f"Cameras and {what} in the lab, from above and from the side; the arrow shows forward")


def coverage_figure(views: BoardViews, lenses: Sequence[Intrinsics]) -> str:
    """Draw where in the picture of each lens's camera corners were seen; shaded: where none told of the lens."""
    names = [lens.camera_name for lens in lenses]
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    sizes = [views.image_sizes_px[views.camera_names.index(name)] for name in names]
    tallest_in = 7.6 / columns * max(height / width for width, height in sizes)
    figure = Figure(figsize=(8.0, rows * (tallest_in + 0.35)), layout="constrained")
    FigureCanvasSVG(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    for axes, lens in zip(panels, lenses, strict=False):
        camera = views.camera_names.index(lens.camera_name)
        width, height = views.image_sizes_px[camera]
        if lens.origin != "file":  # what a file's lens saw is not known
            blank = ~(coverage(views.uv_px[camera], (width, height)) | lens.covered)
            edges_px = (-0.5, width - 0.5, height - 0.5, -0.5)
            axes.imshow(blank, cmap=ListedColormap(["white", SHADE]), vmin=0, vmax=1, extent=edges_px, aspect="equal")
        uv = views.uv_px[camera].reshape(-1, 2)
        uv = uv[np.isfinite(uv[:, 0])]
        uv = uv[:: max(1, len(uv) // MOST_POINTS)]
        axes.scatter(uv[:, 0], uv[:, 1], s=2, color=BLUE, linewidths=0)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(lens.camera_name, fontsize=9)
    return svg_text(figure, "Where in each camera's picture the board's corners were seen; shaded where none was")
