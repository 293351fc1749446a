"""Has a camera moved since the rig was calibrated? A new sweep of the board, seen through the old calibration, tells.

The boards are posed by the cameras that agree about them, and a camera that misses those boards no longer stands where it
stood. Optics are held: what changes from one day to the next is the tripod.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.kernel.calibration.board_motion import advance
from gonio.kernel.calibration.board_terms import DELAY
from gonio.kernel.calibration.boards import Observations, Scene, measure_residuals, pose_boards
from gonio.kernel.calibration.held_out import some_cameras
from gonio.kernel.calibration.pairwise import pose_in_rig
from gonio.kernel.calibration.rig import solve_rig
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import BoardViews, Camera, Intrinsics, Rig, RigCheck

MISS_PX = 1.2
"""A camera that misses the others' boards by this in the median has moved; for pictures 1280 wide and narrower, and growing
with them. Good calibrations miss by 0.3 to 0.6 on another day's boards; 0.1° are 1.6 pixels of a lens of 900."""

MOST_FRAMES = 60


def check_rig(views: BoardViews, optics: Sequence[Intrinsics], rig: Rig) -> RigCheck:
    """Compare a new sweep with an earlier calibration.

    Args:
        views: The new sweep.
        optics: The optics of the earlier calibration, a camera of ``rig`` each.
        rig: The earlier calibration.

    Raises:
        CaptureError: ``cameras-differ``: fewer than two cameras are of the earlier calibration;
            ``cameras-unconnected``: the sweep is too poor to compare anything.
        SolverError: ``calibration-diverged``.
    """
    known = [c for c, name in enumerate(views.camera_names) if name in rig.names]
    if len(known) < 2:
        raise CaptureError(
            f"The earlier calibration is of {', '.join(rig.names)}, the sweep of {', '.join(views.camera_names)}: they "
            "have not two cameras in common.",
            hint="Name the videos after the cameras of the earlier calibration.",
            code="cameras-differ",
        )
    places = [rig.names.index(views.camera_names[c]) for c in known]
    solution = solve_rig(some_cameras(views, known), [optics[p] for p in places], hold_intrinsics=True)
    seen, places = [known[c] for c in solution.cameras], [places[c] for c in solution.cameras]
    frames = solution.frames[np.unique(np.linspace(0, len(solution.frames) - 1, MOST_FRAMES).astype(int))]
    advanced = advance(views.uv_px[seen], views.times_s, solution.scene.theta[:, DELAY])[:, frames]
    theta = solution.scene.theta.copy()
    theta[:, DELAY] = 0.0
    Ts_lab_cam = np.stack([rig.cameras[p].T_lab_cam for p in places])
    old = Scene(theta=theta, Ts_cam_ref=inverse(Ts_lab_cam), Ts_ref_board=np.tile(np.eye(4), (len(frames), 1, 1)))
    chosen = replace(some_cameras(views, seen), times_s=views.times_s[frames], uv_px=advanced)
    widths = np.array([size[0] for size in chosen.image_sizes_px])
    miss_px, steady = _find_steady(chosen, old, solution.lenses(chosen), MISS_PX * np.maximum(widths / 1280, 1.0))
    T_lab_ref = _align(Ts_lab_cam, inverse(solution.scene.Ts_cam_ref), steady if steady.any() else ~steady)
    change = inverse(Ts_lab_cam) @ T_lab_ref @ inverse(solution.scene.Ts_cam_ref)
    return RigCheck(
        camera_names=chosen.camera_names,
        miss_px=miss_px,
        moved=~steady,
        turned_rad=np.linalg.norm(Rotation.from_matrix(change[:, :3, :3]).as_rotvec(), axis=1),
        shifted_m=np.linalg.norm(change[:, :3, 3], axis=1),
        T_lab_cam1=T_lab_ref,
    )


def _find_steady(
    views: BoardViews, old: Scene, lenses: tuple[Camera, ...], limits_px: Float[np.ndarray, " camera"]
) -> tuple[Float[np.ndarray, " camera"], Bool[np.ndarray, " camera"]]:
    """Leave out cameras, the worst first, until the rest agree; all have moved if not even two do."""
    agreeing = list(range(len(limits_px)))

    def worst_of(cameras: list[int]) -> float:
        return float(np.nanmax((_miss_px(views, old, lenses, cameras) / limits_px)[cameras]))

    while len(agreeing) > 2 and worst_of(agreeing) > 1:
        agreeing = min(([c for c in agreeing if c != out] for out in agreeing), key=worst_of)
    miss_px = _miss_px(views, old, lenses, agreeing)
    if worst_of(agreeing) > 1:
        return miss_px, np.zeros(len(limits_px), dtype=bool)
    return miss_px, miss_px <= limits_px


def _miss_px(
    views: BoardViews, old: Scene, lenses: tuple[Camera, ...], posing: list[int]
) -> Float[np.ndarray, " camera"]:
    """Give each camera's median miss of the boards that some cameras pose; NaN for one that sees none of them."""
    corners, uv_px = views.board.corners_board_m, views.uv_px
    rough = pose_in_rig(tuple(lenses[c] for c in posing), old.Ts_cam_ref[posing], corners, uv_px[posing])
    known = np.isfinite(rough[:, 0, 0]) & (np.isfinite(uv_px[posing, ..., 0]).any(axis=2).sum(axis=0) >= 2)
    if not known.any():
        return np.full(len(uv_px), np.inf)
    seen = np.isfinite(uv_px[:, known, :, 0])
    everything = Observations(
        corners_board_m=corners,
        uv_px=np.where(seen[..., None], uv_px[:, known], 0.0),
        velocity_px_s=np.zeros((*seen.shape, 2)),
        weight=seen.astype(float),
    )
    theirs = replace(
        everything,
        uv_px=everything.uv_px[posing],
        velocity_px_s=everything.velocity_px_s[posing],
        weight=everything.weight[posing],
    )
    scene = Scene(theta=old.theta[posing], Ts_cam_ref=old.Ts_cam_ref[posing], Ts_ref_board=rough[known])
    posed = replace(old, Ts_ref_board=pose_boards(theirs, scene).Ts_ref_board)
    miss = np.linalg.norm(measure_residuals(everything, posed), axis=-1)
    return np.array([np.median(m[np.isfinite(m)]) if np.isfinite(m).any() else np.nan for m in miss])


def _align(
    Ts_lab_cam: Float[np.ndarray, "camera 4 4"],
    Ts_ref_cam: Float[np.ndarray, "camera 4 4"],
    steady: Bool[np.ndarray, " camera"],
) -> Float[np.ndarray, "4 4"]:
    """Give the mean transform that takes the new solution's steady cameras to their old places."""
    each = (Ts_lab_cam @ inverse(Ts_ref_cam))[steady]
    turn = Rotation.from_matrix(each[:, :3, :3]).mean().as_matrix()
    shift = (Ts_lab_cam[steady, :3, 3] - Ts_ref_cam[steady, :3, 3] @ turn.T).mean(axis=0)
    return transform(turn, shift)
