"""Where the heels, the toes and the pelvis of a body are while it moves."""

import numpy as np

from gonio.kernel.body.forward import body_poses
from gonio.records import FEET, BodyModel, FootPaths, Motion, Timebase

TIP_SHARE = 0.36
"""From the toe joint to the tip of the toes, over the distance from heel to toe joint: 65 mm of 180 mm in a man's foot."""


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
