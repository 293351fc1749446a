"""Was a camera knocked while the board was filmed? Each camera is split in two, early and late, and the halves compared."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import SolverError
from gonio.kernel.calibration.board_terms import CAMERA_UNKNOWNS
from gonio.kernel.calibration.boards import Adjusted, Scene, adjust
from gonio.kernel.calibration.rig import RigSolution, observe
from gonio.kernel.geometry.transforms import inverse
from gonio.records import BoardViews, record

MIN_VIEWS = 3
"""So many pictures a camera needs in each part of the recording."""

CUTS = (1 / 3, 1 / 2, 2 / 3)
"""Where a camera's pictures are cut in two: a knock near the end hardly shows in the later half."""


@record
class Bump:
    """The largest change of pose that a camera's pictures allow: its angle, its shift, and how unlikely chance makes it.

    ``z`` is its length in standard deviations, per degree of freedom; NaN where a camera has too few pictures.
    """

    angle_rad: float
    shift_m: float
    z: float


def find_bumps(views: BoardViews, solution: RigSolution) -> tuple[Bump, ...]:
    """Compare each camera's early pose with its late one, everything else being shared; optics and delays are held."""
    return tuple(_largest(views, solution, camera) for camera in range(len(solution.cameras)))


def _largest(views: BoardViews, solution: RigSolution, camera: int) -> Bump:
    uv_px = views.uv_px[list(solution.cameras)][:, solution.frames]
    pictures = np.flatnonzero(np.isfinite(uv_px[camera, :, :, 0]).any(axis=1))
    bumps = [Bump(angle_rad=np.nan, shift_m=np.nan, z=np.nan)]
    for cut in CUTS:
        before = round(cut * len(pictures))
        if min(before, len(pictures) - before) >= MIN_VIEWS:
            try:
                bumps.append(_compare(views, solution, uv_px, camera, int(pictures[before])))
            except SolverError:
                continue
    return max(bumps, key=lambda bump: np.nan_to_num(bump.z, nan=-1.0))


def _compare(
    views: BoardViews, solution: RigSolution, uv_px: Float[np.ndarray, "camera frame corner 2"], camera: int, cut: int
) -> Bump:
    early, late = uv_px.copy(), uv_px[camera : camera + 1].copy()
    early[camera, cut:], late[:, :cut] = np.nan, np.nan
    twice = [*range(len(uv_px)), camera]
    scene, prior = solution.scene, solution.prior
    doubled = replace(scene, theta=scene.theta[twice], Ts_cam_ref=scene.Ts_cam_ref[twice])
    free = prior.free[twice]
    free[-1, :6] = True  # also where the camera is the first one, whose early pose stays the frame
    free[:, 6:] = False
    observations = observe(
        doubled,
        views.board.corners_board_m,
        np.concatenate([early, late]),
        views.times_s[solution.frames],
        solution.timing_sd_s,
    )
    held = replace(prior, mean=prior.mean[twice], information=0 * prior.information[twice], free=free)
    return _difference(adjust(observations, doubled, held, sigma_px=solution.adjusted.sigma_px), camera)


def _difference(adjusted: Adjusted, camera: int) -> Bump:
    scene: Scene = adjusted.scene
    moved = scene.Ts_cam_ref[-1] @ inverse(scene.Ts_cam_ref[camera])
    turn = Rotation.from_matrix(moved[:3, :3]).as_rotvec()
    change = np.concatenate([turn, moved[:3, 3]])
    early, late = (slice(c * CAMERA_UNKNOWNS, c * CAMERA_UNKNOWNS + 6) for c in (camera, len(scene.theta) - 1))
    C = adjusted.covariance
    covariance = C[early, early] + C[late, late] - C[early, late] - C[late, early]
    return Bump(
        angle_rad=float(np.linalg.norm(turn)),
        shift_m=float(np.linalg.norm(moved[:3, 3])),
        z=float(np.sqrt(max(change @ np.linalg.solve(covariance, change), 0.0) / 6)),
    )
