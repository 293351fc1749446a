# pyright: standard
"""Write C3D: points, joint angles as model outputs, and events, for the programs of marker laboratories.

The axes are turned so that Z is up, as those programs expect; lengths are millimetres. Angles stand in the first component
of points of their own (``POINT:ANGLES``), as Plug-in Gait has them. ezc3d has no types, as in ``c3d.py``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import ezc3d
import numpy as np
from jaxtyping import Float

from gonio.formats.c3d import Event
from gonio.formats.trc import Trajectories

_LABELS = {"right": "Right", "left": "Left", "": "General"}


def write_c3d(
    path: Path,
    markers: Trajectories,
    angles_deg: Mapping[str, Float[np.ndarray, " frame"]] | None = None,
    events: Sequence[Event] = (),
) -> None:
    """Write a trial that begins with its first frame; unknown points and angles are missing ones.

    Args:
        path: Where to.
        markers: Points in the lab, Y up.
        angles_deg: Angles by name, over the same frames.
        events: With times by the markers' clock.
    """
    angles_deg = angles_deg or {}
    points = np.full((4, len(markers.names) + len(angles_deg), len(markers.times_s)), np.nan)
    x, y, z = 1000.0 * np.moveaxis(markers.xyz_m, -1, 0)
    points[:3, : len(markers.names)] = np.stack([x, -z, y]).swapaxes(1, 2)
    for row, values in enumerate(angles_deg.values(), len(markers.names)):
        points[:3, row] = np.stack([values, 0.0 * values, 0.0 * values])
    points[3] = 1.0
    content = ezc3d.c3d()
    content["data"]["points"] = points
    parameters = content["parameters"]
    parameters["POINT"]["RATE"]["value"] = [markers.rate_hz]
    parameters["POINT"]["LABELS"]["value"] = [*markers.names, *angles_deg]
    parameters["POINT"]["UNITS"]["value"] = ["mm"]
    content.add_parameter("POINT", "X_SCREEN", ["+X"])
    content.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    if angles_deg:
        content.add_parameter("POINT", "ANGLES", list(angles_deg))
        content.add_parameter("POINT", "ANGLE_UNITS", ["deg"])
    if events:
        seconds = np.array([event.time_s for event in events]) - markers.times_s[0]
        content.add_parameter("EVENT", "USED", [len(events)])
        content.add_parameter("EVENT", "LABELS", [event.label for event in events])
        content.add_parameter("EVENT", "CONTEXTS", [_LABELS[event.side] for event in events])
        content.add_parameter("EVENT", "TIMES", np.stack([0.0 * seconds, seconds]))
    content.write(str(path))
