"""Where the heels, the toes and the pelvis of a body are while it moves."""

import itertools
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.kernel.body.forward import body_poses
from gonio.records import FEET, BodyModel, FootPaths, Motion, Timebase

TIP_SHARE = 0.36
"""From the toe joint to the tip of the toes, over the distance from heel to toe joint: 65 mm of 180 mm in a man's foot."""

LONGEST_BRIDGE_S = 0.1
"""A foot moves along a straight line to some mm for so long in stance, and to 2 cm in swing; events need no more."""


def foot_paths(model: BodyModel, motion: Motion, timebase: Timebase) -> FootPaths | None:
    """Give the paths of a motion's feet, NaN where a leg is not known; None for a body without heels, toes and pelvis.

    The bodies are OpenSim's: ``calcn`` begins at the back of the heel, ``toes`` at the toe joint, X along the foot.
    """
    names = model.bodies.names
    if not {"pelvis", *(f"{part}_{side[0]}" for part in ("calcn", "toes") for side in FEET)} <= set(names):
        return None
    poses = body_poses(model, motion.values)
    heels = [poses[:, names.index(f"calcn_{side[0]}")] for side in FEET]
    toes = [poses[:, names.index(f"toes_{side[0]}")] for side in FEET]
    default = body_poses(model, model.coordinates.default[None])[0, :, :3, 3]
    tips = []
    for side, T_lab_toes in zip(FEET, toes, strict=True):
        ball_m = default[names.index(f"toes_{side[0]}")] - default[names.index(f"calcn_{side[0]}")]
        length_m = float(np.hypot(ball_m[0], ball_m[2]))
        tips.append(T_lab_toes[:, :3, 3] + TIP_SHARE * length_m * T_lab_toes[:, :3, 0])
    return FootPaths(
        timebase=timebase,
        heel_lab_m=np.stack([T[:, :3, 3] for T in heels], axis=1),
        toe_lab_m=np.stack(tips, axis=1),
        pelvis_lab_m=poses[:, names.index("pelvis"), :3, 3],
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
