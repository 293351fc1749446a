"""From what all cameras saw of a board to where they stand, how late they run, and how well all of it is known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components

from gonio.errors import CaptureError
from gonio.kernel.calibration.board_motion import corner_velocities, distinct_frames
from gonio.kernel.calibration.board_terms import ASPECT, CX, CY, DELAY, FOCAL, K1, K2, K3, P1, P2
from gonio.kernel.calibration.boards import SIGMA_PX, Adjusted, Observations, Prior, Scene, adjust, pose_boards
from gonio.kernel.calibration.intrinsics import FREE, camera_of
from gonio.kernel.calibration.pairwise import MIN_COMMON_VIEWS, Method, Pair, arrange, pose_in_rig, unconnected
from gonio.kernel.calibration.planar_pose import MIN_CORNERS
from gonio.kernel.geometry.transforms import inverse
from gonio.records import BoardViews, Camera, Intrinsics, record

FLOORS = {
    "recording": {FOCAL: 0.003, ASPECT: 1e-3, CX: 3.0, CY: 3.0, K1: 0.03, K2: 0.05, P1: 1e-3, P2: 1e-3, K3: 0.05},
    "file": {FOCAL: 0.01, ASPECT: 2e-3, CX: 5.0, CY: 5.0, K1: 0.05, K2: 0.10, P1: 2e-3, P2: 2e-3, K3: 0.10},
    "session": {FOCAL: 0.015, ASPECT: 2e-3, CX: 7.0, CY: 7.0, K1: 0.10, K2: 0.15, P1: 2e-3, P2: 2e-3, K3: 0.15},
}
"""The least standard deviation that intrinsics are believed to have, by where they come from: focal length as a share,
centre in pixels of a picture 1280 wide. A lens that was calibrated well still differs a little on another day (focus,
temperature); what a file says without error bars is taken as good to 1 %."""

DELAY_SD_S = 0.5
TIMING_SD_S = 0.010
"""How far single pictures are off a camera's steady delay (rolling shutter, exposure, jitter), before the residuals of fast
and slow corners have told. A corner that moves fast is worth that much less."""

SMALLEST_TIMING_SD_S = 0.005
"""The instant of a corner is known no better: an exposure, and the time that a rolling shutter takes for a board's height."""

MOTION_ROUNDS = 2
MIN_MOVING_FRAMES = 5
MOVING_PX = 2.0
"""Delays are solved for only if corners move by more than this between two pictures, in this many frames."""


@record
class RigSolution:
    """Where the cameras stand: the outcome of the bundle adjustment over the ``frames`` of the views that were used.

    ``cameras`` are the places, in the views, of the cameras that could be connected, the first of them the frame ``ref``;
    all arrays of ``adjusted``, the ``pairs`` and the number of ``views`` are of these cameras only. ``timing_sd_s`` is how
    far single pictures are off their camera's delay.
    """

    cameras: tuple[int, ...]
    frames: Int[np.ndarray, " frame"]
    adjusted: Adjusted
    prior: Prior
    pairs: tuple[Pair, ...]
    views: tuple[int, ...]
    delays_solved: bool
    timing_sd_s: float

    @property
    def scene(self) -> Scene:
        """The cameras and boards."""
        return self.adjusted.scene

    def lenses(self, views: BoardViews) -> tuple[Camera, ...]:
        """Give the cameras, standing where they were found; ``ref`` is the lab."""
        return tuple(
            replace(camera_of(theta, views.image_sizes_px[c], views.camera_names[c]), T_lab_cam=inverse(T_cam_ref))
            for c, theta, T_cam_ref in zip(self.cameras, self.scene.theta, self.scene.Ts_cam_ref, strict=True)
        )


def solve_rig(
    views: BoardViews,
    intrinsics: Sequence[Intrinsics],
    *,
    method: Method = "tree",
    hold_intrinsics: bool = False,
    ignore_prior: bool = False,
) -> RigSolution:
    """Solve for the poses and delays of all cameras, and improve their intrinsics.

    Args:
        views: Where the cameras saw the board.
        intrinsics: Each camera's optics: start and prior.
        method: How the cameras are put together at first (:func:`gonio.kernel.calibration.pairwise.arrange`).
        hold_intrinsics: Leave the optics as they are.
        ignore_prior: Let the optics go wherever the pictures of the session pull them.

    Raises:
        CaptureError: ``cameras-unconnected``.
        SolverError: ``calibration-diverged``.
    """
    theta = np.stack([np.append(optics.parameters, 0.0) for optics in intrinsics])
    lenses = tuple(
        camera_of(t, size, name) for t, size, name in zip(theta, views.image_sizes_px, views.camera_names, strict=True)
    )
    corners = views.board.corners_board_m
    arrangement = arrange(lenses, corners, views.uv_px, method)
    cameras = [int(c) for c in np.flatnonzero(arrangement.connected)]
    posed = np.flatnonzero(np.isfinite(arrangement.Ts_ref_board[:, 0, 0]))
    frames = posed[distinct_frames(views.uv_px[cameras][:, posed])]
    if not len(frames):
        raise CaptureError(
            "No picture of the board is good enough to place the cameras.",
            hint="Film the board closer, sharper and seen by two cameras at a time.",
            code="cameras-unconnected",
        )
    uv_px, times_s = views.uv_px[cameras][:, frames], views.times_s[frames]
    scene = Scene(
        theta=theta[cameras],
        Ts_cam_ref=arrangement.Ts_cam_ref[cameras],
        Ts_ref_board=arrangement.Ts_ref_board[frames],
    )
    prior = prior_of([intrinsics[c] for c in cameras], ignore=ignore_prior, hold=hold_intrinsics)
    moves = _moves(scene, corners, uv_px, times_s)
    free = prior.free.copy()
    free[1:, 6 + DELAY] = moves
    return refine_rig(
        RigSolution(
            cameras=tuple(cameras),
            frames=frames,
            adjusted=_unadjusted(scene, uv_px),
            prior=replace(prior, free=free),
            pairs=tuple(
                replace(pair, first=cameras.index(pair.first), second=cameras.index(pair.second))
                for pair in arrangement.pairs
            ),
            views=tuple(arrangement.views[c] for c in cameras),
            delays_solved=moves,
            timing_sd_s=TIMING_SD_S,
        ),
        corners,
        uv_px,
        times_s,
    )


def solve_part(views: BoardViews, solution: RigSolution, frames: Int[np.ndarray, " chosen"]) -> RigSolution:
    """Solve some frames of a solution alone; it only tells where to start.

    Where the start is decides which of the wrong solutions a search could fall into, not what the right one is: a part is
    too small to find its way from nothing each time.

    Args:
        views: The recording, of the solution's cameras.
        solution: The solution of the whole.
        frames: Some of its frames.

    Raises:
        CaptureError: ``cameras-unconnected``: these frames alone don't hold the cameras together.
        SolverError: ``calibration-diverged``.
    """
    uv_px = views.uv_px[:, frames]
    seen = np.isfinite(uv_px[..., 0]).sum(axis=-1) >= MIN_CORNERS
    common = seen.astype(int) @ seen.T.astype(int)
    if connected_components(common >= MIN_COMMON_VIEWS, directed=False)[0] > 1:
        raise unconnected("all cameras, in pairs,")
    places = np.searchsorted(solution.frames, frames)
    scene = replace(solution.scene, theta=solution.prior.mean, Ts_ref_board=solution.scene.Ts_ref_board[places])
    part = replace(
        solution,
        frames=frames,
        adjusted=_unadjusted(scene, uv_px),
        views=tuple(int(n) for n in seen.sum(axis=1)),
        timing_sd_s=TIMING_SD_S,
    )
    return refine_rig(part, views.board.corners_board_m, uv_px, views.times_s[frames])


def refine_rig(
    solution: RigSolution,
    corners_board_m: Float[np.ndarray, "corner 3"],
    uv_px: Float[np.ndarray, "camera frame corner 2"],
    times_s: Float[np.ndarray, " frame"],
) -> RigSolution:
    """Adjust everything; the boards' motion, by which delays act, is taken from the last solution's board poses."""
    scene, adjusted, timing_sd_s = solution.scene, solution.adjusted, solution.timing_sd_s
    for _ in range(MOTION_ROUNDS + 1):
        observations = observe(scene, corners_board_m, uv_px, times_s, timing_sd_s)
        adjusted = adjust(observations, scene, solution.prior, sigma_px=adjusted.sigma_px, inflation=adjusted.inflation)
        scene = adjusted.scene
        timing_sd_s = estimate_timing(adjusted.residual_px, observations.velocity_px_s)
    return replace(solution, adjusted=adjusted, timing_sd_s=timing_sd_s)


def estimate_timing(
    residual_px: Float[np.ndarray, "camera frame corner 2"], velocity_px_s: Float[np.ndarray, "camera frame corner 2"]
) -> float:
    """Estimate how far single pictures are off in time, by how much larger the residuals of fast corners are.

    A residual's squared length is expected to be ``2 σ² + v² s²``; the medians of the slower and the faster half give s.
    """
    squared, speed = (residual_px**2).sum(axis=-1), (velocity_px_s**2).sum(axis=-1)
    moving = np.isfinite(squared) & (speed > 0)
    if moving.sum() < 2 * MIN_MOVING_FRAMES:
        return TIMING_SD_S
    squared, speed = squared[moving], speed[moving]
    fast = speed > np.median(speed)
    if not fast.any():
        return TIMING_SD_S
    # The median of σ² times a chi-squared variable of two degrees of freedom is 2 ln 2 σ².
    more = (np.median(squared[fast]) - np.median(squared[~fast])) / (2 * np.log(2))
    return max(float(np.sqrt(max(2 * more / (speed[fast].mean() - speed[~fast].mean()), 0.0))), SMALLEST_TIMING_SD_S)


def observe(
    scene: Scene,
    corners_board_m: Float[np.ndarray, "corner 3"],
    uv_px: Float[np.ndarray, "camera frame corner 2"],
    times_s: Float[np.ndarray, " frame"],
    timing_sd_s: float,
) -> Observations:
    """Weigh the corners: one that moves is known less well in time, and one of unknown motion counts as a typical one."""
    seen = np.isfinite(uv_px[..., 0])
    velocity = corner_velocities(scene, corners_board_m, times_s)
    squared = (velocity**2).sum(axis=-1)
    known = seen & np.isfinite(squared)
    typical = float(np.median(squared[known])) if known.any() else 0.0
    late = np.where(np.isfinite(squared), squared, typical) * (timing_sd_s / SIGMA_PX) ** 2 / 2
    return Observations(
        corners_board_m=corners_board_m,
        uv_px=np.where(seen[..., None], uv_px, 0.0),
        velocity_px_s=np.where(known[..., None], velocity, 0.0),
        weight=np.where(seen, 1.0 / (1.0 + late), 0.0),
    )


def prior_of(intrinsics: Sequence[Intrinsics], *, ignore: bool = False, hold: bool = False) -> Prior:
    """Turn what is known of the cameras' optics into a prior; all poses but the first camera's are free, delays are not."""
    count = len(intrinsics)
    information, free = np.zeros((count, 10, 10)), np.zeros((count, 16), dtype=bool)
    free[1:, :6] = True
    for camera, optics in enumerate(intrinsics):
        places = list(FREE[optics.model])
        floor = FLOORS[optics.origin]
        scale = {
            FOCAL: optics.parameters[FOCAL],
            CX: optics.image_size_px[0] / 1280,
            CY: optics.image_size_px[0] / 1280,
        }
        least = np.array([floor[place] * scale.get(place, 1.0) for place in places])
        covariance = optics.covariance[np.ix_(places, places)] + np.diag(least**2)
        if not ignore:
            information[camera][np.ix_(places, places)] = np.linalg.inv(covariance)
        free[camera, [6 + place for place in places]] = not hold
        information[camera, DELAY, DELAY] = DELAY_SD_S**-2
    mean = np.stack([np.append(optics.parameters, 0.0) for optics in intrinsics])
    return Prior(mean=mean, information=information, free=free)


def place_boards(
    solution: RigSolution,
    lenses: tuple[Camera, ...],
    corners_board_m: Float[np.ndarray, "corner 3"],
    uv_px: Float[np.ndarray, "camera frame corner 2"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Give the board's pose in pictures that a solved rig took of it at rest: ``T_ref_board``, NaN where it can't be told.

    ``lenses`` and ``uv_px`` are of the solution's cameras.
    """
    rough = pose_in_rig(lenses, solution.scene.Ts_cam_ref, corners_board_m, uv_px)
    known = np.isfinite(rough[:, 0, 0])
    placed = np.full_like(rough, np.nan)
    if known.any():
        seen = np.isfinite(uv_px[:, known])[..., 0]
        observations = Observations(
            corners_board_m=corners_board_m,
            uv_px=np.where(seen[..., None], uv_px[:, known], 0.0),
            velocity_px_s=np.zeros_like(uv_px[:, known]),
            weight=seen.astype(float),
        )
        placed[known] = pose_boards(observations, replace(solution.scene, Ts_ref_board=rough[known])).Ts_ref_board
    return placed


def focal_variance_px2(optics: Intrinsics) -> float:
    """Give how well a camera's focal length is believed to be known beforehand, its floor included."""
    least = FLOORS[optics.origin][FOCAL] * optics.parameters[FOCAL]
    return float(optics.covariance[FOCAL, FOCAL] + least**2)


def _moves(scene: Scene, corners_board_m: np.ndarray, uv_px: np.ndarray, times_s: np.ndarray) -> bool:
    """Say whether the board moved often and far enough for delays to show."""
    velocity = corner_velocities(scene, corners_board_m, times_s)
    shift = np.linalg.norm(velocity, axis=-1) * np.median(np.diff(times_s)) if len(times_s) > 1 else np.zeros(1)
    seen = np.isfinite(uv_px[..., 0]) & (np.isfinite(shift)) & (np.nan_to_num(shift) > MOVING_PX)
    return bool(seen.any(axis=(0, 2)).sum() >= MIN_MOVING_FRAMES)


def _unadjusted(scene: Scene, uv_px: np.ndarray) -> Adjusted:
    return Adjusted(
        scene=scene,
        covariance=np.zeros((16 * len(scene.theta),) * 2),
        sigma_px=SIGMA_PX,
        inflation=1.0,
        residual_px=np.full(uv_px.shape, np.nan),
        share=np.zeros(uv_px.shape[:3]),
        converged=False,
        iterations=0,
    )
