"""Bundle adjustment of camera poses over points that are seen by several cameras, with a prior on the calibration.

The points are eliminated (Schur's complement), so the cost is linear in their number [Triggs et al. 2000, §6.1]. The poses
are updated in the camera's own frame: ``x_cam ← x_cam + ω × x_cam + v``.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Rig, record

PRIOR_ROTATION_RAD = np.deg2rad(1.0)
PRIOR_TRANSLATION_M = 0.05
"""How far a calibration is expected to be off: a tripod that was knocked. The prior also fixes the frame, which the points
alone leave open; it is weak against a few hundred points and strong against a handful."""

STEP_TOLERANCE = 1e-5  # rad and m: moves a point at 5 m by 0.05 mm
MAX_ITERATIONS = 100


@record
class Bundle:
    """The outcome of a bundle adjustment: the rig, and each camera's change in its own frame (rotation, then translation)."""

    rig: Rig
    rotation_rad: Float[np.ndarray, "camera 3"]
    translation_m: Float[np.ndarray, "camera 3"]
    converged: bool
    iterations: int


def adjust_poses(
    rig: Rig,
    uv_px: Float[np.ndarray, "camera point 2"],
    confidence: Float[np.ndarray, "camera point"],
    *,
    sigma_px: float,
    scale_m: float,
) -> Bundle:
    """Find the camera poses (and points) that explain the observations best, near the calibration.

    Args:
        rig: The calibrated cameras: start and centre of the prior.
        uv_px: Undistorted observations, NaN missing. A point that fewer than two cameras see is left out.
        confidence: Weight of each observation's squared residual.
        sigma_px: Standard deviation of an observation of confidence 1: it weighs the observations against the prior.
        scale_m: Scale of Cauchy's loss, at the point's depth.
    """
    projections, focal_px = projection_matrices(rig), focal_lengths_px(rig)
    start = triangulate(projections, focal_px, uv_px, confidence, method="robust", scale_m=scale_m)
    known = np.isfinite(start.xyz_lab_m[:, 0])
    observed = np.where(np.isfinite(uv_px) & (confidence > 0)[..., None], uv_px, np.nan)[:, known]
    weight = np.where(np.isfinite(observed[..., 0]), confidence[:, known], 0.0) / sigma_px**2
    points = start.xyz_lab_m[known]
    Ts_cam_lab = np.stack([camera.T_cam_lab for camera in rig.cameras])
    Ks = np.stack([camera.intrinsic_px for camera in rig.cameras])
    change = np.zeros((len(rig.cameras), 6))
    scale_px = _scale_px(Ts_cam_lab, points, focal_px, scale_m)
    cost = _cost(_residual(Ts_cam_lab, Ks, points, observed), weight, scale_px, change)
    damping, converged, iterations = 1e-3, False, 0
    while not converged and iterations < MAX_ITERATIONS:
        iterations += 1
        pose_step, point_step = _step(Ts_cam_lab, Ks, points, observed, weight, scale_px, change, damping)
        trial_T, trial_points, trial_change = _moved(Ts_cam_lab, pose_step), points + point_step, change + pose_step
        trial_cost = _cost(_residual(trial_T, Ks, trial_points, observed), weight, scale_px, trial_change)
        if trial_cost <= cost:
            Ts_cam_lab, points, change, cost = trial_T, trial_points, trial_change, trial_cost
            damping = max(damping / 10, 1e-9)
        else:
            damping *= 10
        converged = bool(np.abs(pose_step).max() < STEP_TOLERANCE)
    return Bundle(
        rig=replace(
            rig,
            cameras=tuple(
                replace(camera, T_lab_cam=_inverse(T)) for camera, T in zip(rig.cameras, Ts_cam_lab, strict=True)
            ),
        ),
        rotation_rad=change[:, :3],
        translation_m=change[:, 3:],
        converged=converged,
        iterations=iterations,
    )


def _residual(
    Ts_cam_lab: np.ndarray, Ks: np.ndarray, points: np.ndarray, observed: np.ndarray
) -> Float[np.ndarray, "camera point 2"]:
    """Give observed minus projected, pixels; NaN where nothing was observed, infinite behind the camera."""
    xyz = np.einsum("cij,pj->cpi", Ts_cam_lab[:, :3, :3], points) + Ts_cam_lab[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        homogeneous = np.einsum("cij,cpj->cpi", Ks, xyz)
        projected = np.where(xyz[..., 2:] > 0, homogeneous[..., :2] / homogeneous[..., 2:], np.inf)
    return observed - projected


def _scale_px(Ts_cam_lab: np.ndarray, points: np.ndarray, focal_px: np.ndarray, scale_m: float) -> np.ndarray:
    depth_m = np.einsum("cj,pj->cp", Ts_cam_lab[:, 2, :3], points) + Ts_cam_lab[:, 2, 3, None]
    return focal_px[:, None] * scale_m / depth_m


def _cost(residual_px: np.ndarray, weight: np.ndarray, scale_px: np.ndarray, change: np.ndarray) -> float:
    squared = np.where(weight > 0, (residual_px**2).sum(axis=-1), 0.0)
    prior = (change[:, :3] / PRIOR_ROTATION_RAD) ** 2 + (change[:, 3:] / PRIOR_TRANSLATION_M) ** 2
    return float((weight * scale_px**2 * np.log1p(squared / scale_px**2)).sum() + prior.sum())


def _step(
    Ts_cam_lab: np.ndarray,
    Ks: np.ndarray,
    points: np.ndarray,
    observed: np.ndarray,
    weight: np.ndarray,
    scale_px: np.ndarray,
    change: np.ndarray,
    damping: float,
) -> tuple[Float[np.ndarray, "camera 6"], Float[np.ndarray, "point 3"]]:
    """Solve the damped normal equations: first for the poses, then back for the points."""
    to_pose, to_point = pose_jacobians(Ts_cam_lab, Ks, points)
    residual = np.where(weight[..., None] > 0, _residual(Ts_cam_lab, Ks, points, observed), 0.0)
    robust = weight / (1.0 + (residual**2).sum(axis=-1) / scale_px**2)
    cameras = len(Ts_cam_lab)
    weighted_pose, weighted_point = robust[..., None, None] * to_pose, robust[..., None, None] * to_point
    prior = np.repeat([PRIOR_ROTATION_RAD**-2, PRIOR_TRANSLATION_M**-2], 3)
    H_cc = np.einsum("cpki,cpkj->cij", weighted_pose, to_pose) + np.diag(prior)
    H_pp = np.einsum("cpki,cpkj->pij", weighted_point, to_point)
    H_cp = np.einsum("cpki,cpkj->cpij", weighted_pose, to_point)
    g_c = np.einsum("cpki,cpk->ci", weighted_pose, residual) - prior * change
    g_p = np.einsum("cpki,cpk->pi", weighted_point, residual)
    H_cc += damping * H_cc * np.eye(6)
    H_pp += damping * H_pp * np.eye(3)
    inverse_pp = np.linalg.inv(H_pp)
    carried = np.einsum("cpij,pjk->cpik", H_cp, inverse_pp)
    schur = -np.einsum("cpik,dpjk->cidj", carried, H_cp)
    schur[np.arange(cameras), :, np.arange(cameras), :] += H_cc
    right = g_c - np.einsum("cpik,pk->ci", carried, g_p)
    pose_step = np.linalg.solve(schur.reshape(6 * cameras, -1), right.ravel()).reshape(cameras, 6)
    point_step = np.einsum("pij,pj->pi", inverse_pp, g_p - np.einsum("cpij,ci->pj", H_cp, pose_step))
    return pose_step, point_step


def pose_jacobians(
    Ts_cam_lab: Float[np.ndarray, "camera 4 4"],
    Ks: Float[np.ndarray, "camera 3 3"],
    points: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "camera point 2 6"], Float[np.ndarray, "camera point 2 3"]]:
    """Give the derivatives of the projections with respect to each pose (ω, v) and to each point."""
    xyz = np.einsum("cij,pj->cpi", Ts_cam_lab[:, :3, :3], points) + Ts_cam_lab[:, None, :3, 3]
    x, y, z = np.moveaxis(xyz, -1, 0)
    zero = np.zeros_like(x)
    pinhole = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2)
    to_xyz = np.einsum("cij,cpjk->cpik", Ks[:, :2, :2], pinhole)
    cross = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    to_pose = np.concatenate([to_xyz @ cross, to_xyz], axis=-1)  # d(ω × x)/dω = −[x]×
    return to_pose, np.einsum("cpki,cij->cpkj", to_xyz, Ts_cam_lab[:, :3, :3])


def _moved(Ts_cam_lab: np.ndarray, step: np.ndarray) -> np.ndarray:
    turns = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return np.stack([transform(R, v) @ T for R, v, T in zip(turns, step[:, 3:], Ts_cam_lab, strict=True)])


def _inverse(T_a_b: np.ndarray) -> np.ndarray:
    return transform(T_a_b[:3, :3].T, -T_a_b[:3, :3].T @ T_a_b[:3, 3])
