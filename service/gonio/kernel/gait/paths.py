"""Where the heels, the toes and the pelvis of a body are while it moves."""

import itertools
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.body.soles import HEEL, TIP, mark_soles
from gonio.records import FEET, BodyModel, FootPaths, Motion, Timebase

LONGEST_BRIDGE_S = 0.1
"""A foot moves along a straight line to some mm for so long in stance, and to 2 cm in swing; events need no more."""


def foot_paths(model: BodyModel, motion: Motion, timebase: Timebase) -> FootPaths | None:
    """Give the paths of a motion's feet, NaN where a leg is not known; None for a body without heels, toes and pelvis."""
    names = model.bodies.names
    if not {"pelvis", *(f"{part}_{side[0]}" for part in ("calcn", "toes") for side in FEET)} <= set(names):
        return None
    places = marker_positions(mark_soles(model), motion.values).reshape(len(motion.values), len(FEET), -1, 3)
    return FootPaths(
        timebase=timebase,
        heel_lab_m=places[:, :, HEEL],
        toe_lab_m=places[:, :, TIP],
        pelvis_lab_m=body_poses(model, motion.values)[:, names.index("pelvis"), :3, 3],
    )


def bridge_gaps(paths: FootPaths) -> FootPaths:
    """Bridge gaps of up to :data:`LONGEST_BRIDGE_S` on straight lines, so that a lost frame does not cut a walk in two.

    For finding events and cycles only: what is reported over the cycle keeps its gaps.
    """
    longest = LONGEST_BRIDGE_S * paths.timebase.rate_hz
    return replace(
        paths,
        heel_lab_m=_bridge(paths.heel_lab_m, longest),
        toe_lab_m=_bridge(paths.toe_lab_m, longest),
        pelvis_lab_m=_bridge(paths.pelvis_lab_m, longest),
    )


def _bridge(values: Float[np.ndarray, " frame *rest"], longest: float) -> Float[np.ndarray, " frame *rest"]:
    columns = values.reshape(len(values), -1).copy()
    for column in columns.T:
        known = np.flatnonzero(np.isfinite(column))
        for before, after in itertools.pairwise(known):
            if 1 < after - before <= longest + 1:
                column[before : after + 1] = np.linspace(column[before], column[after], after - before + 1)
    return columns.reshape(values.shape)
