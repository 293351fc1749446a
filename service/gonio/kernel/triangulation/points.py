"""Triangulate all keypoints of all frames, by a method chosen by name.

The ladder, from the first step of the paper that gonio follows to ours:

``stereo``, ``linear3``, ``linear4``
    Linear least squares over the first two (eqs. 3 and 4), three or four cameras; all that see a point count alike.
``linear``
    The same over all cameras, weighted by confidence.
``reprojection``
    That as a start, then confidence-weighted Levenberg-Marquardt on the reprojection error (the paper's eqs. 8 and 9).
``robust``
    The best camera pair as a start, then Levenberg-Marquardt with Cauchy's loss: right as long as two cameras are. Weights
    are the squares of the confidences, since a detector's scatter grows as the inverse of its confidence.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from gonio.kernel.parallel import over_blocks
from gonio.kernel.triangulation.solve import BEHIND_CAMERA, TOO_FEW_CAMERAS, solve_points
from gonio.records import record

Method = Literal["stereo", "linear3", "linear4", "linear", "reprojection", "robust"]

CAMERAS_USED = {"stereo": 2, "linear3": 3, "linear4": 4}
CONFIDENCE_POWER = {"stereo": 0, "linear3": 0, "linear4": 0, "robust": 2}
"""The weight of a squared residual is the confidence to this power, 1 for the other methods.

Of OpenPose's keypoints in a real recording those of confidence 0.3, 0.48 and 0.65 scatter by 20, 11 and 8 mm: by the inverse
(docs/validation/virtual-lab.md), so that the square is the inverse of the variance.
"""

CAUCHY_SCALE_M = 0.03
"""Where the robust loss turns from square to logarithm: 30 mm at the point's depth.

About twice the scatter of a good keypoint detector on a person (5 px at 4 m and f = 1680 px are 12 mm, per axis), so that
clean observations keep nearly full weight and a limb that was swapped (> 100 mm) nearly none.
"""

BLOCK_POINTS = 1024
"""Points that one thread takes at a time: some 5 ms of work, long against what handing it over costs."""


@record
class Triangulated:
    """The solution of each point of a batch.

    ``covariance_m2`` is the Hessian's inverse times the noise level (variance of one weighted observation, px²) that all
    points together show; where a point's own residuals say more, it is inflated by their ratio. ``camera_weight`` is the
    share (0 to 1) that the robust loss left to each observation: 1 everywhere for ``linear`` and ``reprojection``.
    """

    xyz_lab_m: Float[np.ndarray, "point 3"]
    covariance_m2: Float[np.ndarray, "point 3 3"]
    residual_px: Float[np.ndarray, "camera point 2"]
    camera_weight: Float[np.ndarray, "camera point"]
    status: UInt8[np.ndarray, " point"]


def triangulate(
    projections: Float[np.ndarray, "camera 3 4"],
    focal_px: Float[np.ndarray, " camera"],
    uv_px: Float[np.ndarray, "camera point 2"],
    confidence: Float[np.ndarray, "camera point"],
    *,
    method: Method = "robust",
    scale_m: float = CAUCHY_SCALE_M,
) -> Triangulated:
    """Triangulate a batch of independent points.

    Args:
        projections: ``K [R|t]`` of each camera.
        focal_px: Mean focal length of each camera: it turns ``scale_m`` into pixels.
        uv_px: Undistorted observations; NaN is missing.
        confidence: Of each observation, 0 to 1: the method makes weights of it; 0 is missing.
        method: A step of the ladder above.
        scale_m: Scale of Cauchy's loss in the lab (``robust`` only).

    A point that fewer than two cameras see is NaN, never a number (status ``TOO_FEW_CAMERAS``). A camera that does not see
    the point has a NaN residual.
    """
    usable = np.isfinite(uv_px).all(axis=-1) & (confidence > 0)
    weight = np.where(usable, np.where(usable, confidence, 1.0) ** CONFIDENCE_POWER.get(method, 1), 0.0)
    weight[CAMERAS_USED.get(method, len(weight)) :] = 0.0
    seen = np.where(weight[..., None] > 0, uv_px, 0.0)
    points, cameras = uv_px.shape[1], uv_px.shape[0]
    xyz, inverse = np.empty((points, 3)), np.empty((points, 3, 3))
    residual, status = np.zeros((points, cameras, 2)), np.empty(points, dtype=np.uint8)
    projections, focal_px = projections.astype(float, order="C"), focal_px.astype(float, order="C")
    by_point, weights = np.ascontiguousarray(seen.transpose(1, 0, 2)), np.ascontiguousarray(weight.T)
    robust = method == "robust"
    refined = robust or method == "reprojection"

    def solve(start: int, stop: int) -> None:
        solve_points(
            projections, focal_px, by_point, weights, robust, refined, scale_m if robust else np.inf,
            start, stop, xyz, inverse, residual, status,
        )  # fmt: skip

    over_blocks(solve, points, BLOCK_POINTS)
    residual_px = np.where(weight[..., None] > 0, residual.transpose(1, 0, 2), np.nan)
    unsolved = (status == TOO_FEW_CAMERAS) | (status == BEHIND_CAMERA)
    xyz[unsolved] = np.nan
    residual_px[:, unsolved] = np.nan
    camera_weight = np.ones_like(weight)
    if robust:
        scale_px = focal_px[:, None] * scale_m / _depths_m(projections, xyz)
        camera_weight = 1.0 / (1.0 + (residual_px[..., 0] ** 2 + residual_px[..., 1] ** 2) / scale_px**2)
    return Triangulated(
        xyz_lab_m=xyz,
        covariance_m2=_covariance(inverse, residual_px, weight, camera_weight, unsolved),
        residual_px=residual_px,
        camera_weight=np.nan_to_num(camera_weight),
        status=status,
    )


def _depths_m(
    projections: Float[np.ndarray, "camera 3 4"], xyz_lab_m: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "camera point"]:
    return projections[:, 2, :3] @ xyz_lab_m.T + projections[:, 2, 3:]


def _covariance(
    inverse_hessian: Float[np.ndarray, "point 3 3"],
    residual_px: Float[np.ndarray, "camera point 2"],
    weight: Float[np.ndarray, "camera point"],
    camera_weight: Float[np.ndarray, "camera point"],
    unsolved: np.ndarray,
) -> Float[np.ndarray, "point 3 3"]:
    """Scale the inverse Hessians by the residual level of the whole batch, or of the point where that is higher."""
    solvable = ~unsolved & np.isfinite(inverse_hessian[:, 0, 0])
    used = (weight > 0) & (camera_weight > 0.25)  # what the loss has thrown out tells nothing of the noise of the rest
    squared = np.where(used, weight * (residual_px[..., 0] ** 2 + residual_px[..., 1] ** 2), 0.0).sum(axis=0)
    freedom = 2.0 * used.sum(axis=0) - 3.0
    counted = solvable & (freedom > 0)
    level = squared[counted].sum() / freedom[counted].sum() if counted.any() else np.nan
    own = np.divide(squared, freedom, out=np.full(squared.shape, level), where=freedom > 0)
    return inverse_hessian * np.where(solvable, np.maximum(own, level), np.nan)[:, None, None]
