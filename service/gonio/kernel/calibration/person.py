"""Refine the cameras' poses on the person who walks between them, and prove that it helped.

A tripod that was knocked after the calibration shows as a constant offset of everything that camera sees. The person's own
keypoints, hundreds of points all over the capture volume, tell where the camera really stands. The refinement is kept only if
it lowers the reprojection error of stretches of the trial that it was not computed from.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.calibration.bundle import Bundle, adjust_poses
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import align
from gonio.kernel.triangulation.points import triangulate
from gonio.records import ImagePoints, Rig, record

BLOCK_S = 0.17
"""Length of the alternating blocks of training and test frames: detector errors are correlated over less than this."""

SAMPLE_HZ = 10.0
"""Frames closer than 0.1 s repeat the same detector errors: more of them cost time and tell nothing."""

MOST_FRAMES = 300
SIGMA_PX = 8.0
SCALE_M = 0.06
"""Cauchy's scale while the calibration is still off: twice that of the triangulation, or the bias itself is an outlier."""

SMALLEST_GAIN = 0.03
"""The held-out error must fall by this share: less is within what chance and the loss's scale give."""


TYPICAL = 3.0
"""Points that the refinement moves by more than this many medians are outliers, and don't tell where the lab is."""


@record
class PersonRefinement:
    """What the refinement found; ``rig`` is the refined one where ``kept``, else the calibration as it came.

    The errors are the mean reprojection errors of the held-out blocks, in pixels, before and after. ``turned_rad`` and
    ``moved_m`` say by how much each camera changed.
    """

    rig: Rig
    kept: bool
    error_before_px: float
    error_after_px: float
    turned_rad: Float[np.ndarray, " camera"]
    moved_m: Float[np.ndarray, " camera"]


def refine_on_person(rig: Rig, keypoints: ImagePoints, min_confidence: float) -> PersonRefinement:
    """Refine all poses on a trial's keypoints; the calibration is the prior.

    With fewer than three cameras, or too few frames for two blocks of each kind, there is nothing to hold out or nothing
    to agree on, and the calibration stays as it is (errors NaN).
    """
    keypoints = keypoints.sampled
    frames = keypoints.uv_px.shape[1]
    block = max(1, round(BLOCK_S * keypoints.timebase.rate_hz))
    held_out = (np.arange(frames) // block) % 2 == 1
    if len(rig.cameras) < 3 or frames < 4 * block:
        return unrefined(rig)
    uv_px = undistort_rig(rig, keypoints.uv_px)
    weight = np.where(keypoints.confidence >= min_confidence, keypoints.confidence, 0.0)
    trial = _adjust(rig, uv_px, weight, ~held_out, keypoints.timebase.rate_hz)
    before = held_out_error_px(rig, uv_px[:, held_out], weight[:, held_out])
    after = held_out_error_px(trial.rig, uv_px[:, held_out], weight[:, held_out])
    kept = bool(trial.converged and after < (1 - SMALLEST_GAIN) * before)
    refined = trial.rig
    if kept:
        final = _adjust(rig, uv_px, weight, np.ones(frames, dtype=bool), keypoints.timebase.rate_hz)
        refined = _keep_lab(rig, final.rig, uv_px, weight)
    change = np.stack(
        [np.linalg.inv(a.T_lab_cam) @ b.T_lab_cam for a, b in zip(rig.cameras, refined.cameras, strict=True)]
    )
    return PersonRefinement(
        rig=refined if kept else rig,
        kept=kept,
        error_before_px=before,
        error_after_px=after,
        turned_rad=np.asarray(Rotation.from_matrix(change[:, :3, :3]).magnitude()),
        moved_m=np.linalg.norm(change[:, :3, 3], axis=1),
    )


def unrefined(rig: Rig) -> PersonRefinement:
    """Give the calibration as it came."""
    nothing = np.zeros(len(rig.cameras))
    return PersonRefinement(
        rig=rig, kept=False, error_before_px=np.nan, error_after_px=np.nan, turned_rad=nothing, moved_m=nothing
    )


def held_out_error_px(
    rig: Rig, uv_px: Float[np.ndarray, "camera frame keypoint 2"], weight: Float[np.ndarray, "camera frame keypoint"]
) -> float:
    """Give the mean reprojection error of points triangulated by least squares: a bias has nowhere to hide in it."""
    cameras = len(rig.cameras)
    solved = triangulate(
        projection_matrices(rig),
        focal_lengths_px(rig),
        uv_px.reshape(cameras, -1, 2),
        weight.reshape(cameras, -1),
        method="reprojection",
    )
    error = np.linalg.norm(solved.residual_px, axis=-1)
    return float(np.nanmean(error)) if np.isfinite(error).any() else np.nan


def _keep_lab(
    rig: Rig,
    refined: Rig,
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    weight: Float[np.ndarray, "camera frame keypoint"],
) -> Rig:
    """Move a refined rig as a whole so that the person stands where the calibration saw her.

    The person tells how the cameras stand to each other, not where the floor is: left to the priors of single cameras, the
    lab drifts by centimetres.
    """
    cameras, frames = weight.shape[:2]
    chosen = slice(None, None, max(1, frames // MOST_FRAMES))
    there, here = (
        triangulate(
            projection_matrices(one),
            focal_lengths_px(one),
            uv_px[:, chosen].reshape(cameras, -1, 2),
            weight[:, chosen].reshape(cameras, -1),
            method="robust",  # or a camera that was knocked would draw the lab along
        ).xyz_lab_m
        for one in (rig, refined)
    )
    miss_m = np.linalg.norm(there - here, axis=1)
    known = miss_m <= np.nanmedian(miss_m) * TYPICAL  # false for NaN
    T = align(here[known], there[known])
    return replace(refined, cameras=tuple(replace(c, T_lab_cam=T @ c.T_lab_cam) for c in refined.cameras))


def _adjust(
    rig: Rig,
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    weight: Float[np.ndarray, "camera frame keypoint"],
    use: Bool[np.ndarray, " frame"],
    rate_hz: float,
) -> Bundle:
    """Adjust the poses on a sample of the frames that may be used."""
    stride = max(1, round(rate_hz / SAMPLE_HZ), int(np.ceil(use.sum() / MOST_FRAMES)))
    chosen = np.flatnonzero(use)[::stride]
    cameras = len(rig.cameras)
    return adjust_poses(
        rig,
        uv_px[:, chosen].reshape(cameras, -1, 2),
        weight[:, chosen].reshape(cameras, -1),
        sigma_px=SIGMA_PX,
        scale_m=SCALE_M,
    )
