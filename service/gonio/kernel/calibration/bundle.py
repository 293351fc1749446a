"""Bundle adjustment of camera poses over points that are seen by several cameras, with a prior on the calibration.

The points are eliminated (Schur's complement), so the cost is linear in their number [Triggs et al. 2000, §6.1]. The poses
are updated in the camera's own frame: ``x_cam ← x_cam + ω × x_cam + v``. A camera that runs late by τ shows a point where it
was τ earlier, ``u(t) ≈ π(X(t)) − τ du/dt``: with the points' image velocities its delay is one more unknown.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.parallel import one_blas_thread
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Rig, record

PRIOR_ROTATION_RAD = np.deg2rad(1.0)
PRIOR_TRANSLATION_M = 0.05
"""How far a calibration is expected to be off: a tripod that was knocked. The prior also fixes the frame, which the points
alone leave open; it is weak against a few hundred points and strong against a handful."""

LOWEST_INFORMATION = 1e-3  # 1/m²: a pixel at 5 m gives 1e4
SMALLEST_SHARE = 1e-10
STEP_TOLERANCE = 1e-5  # rad, m and s: moves a point at 5 m by 0.05 mm
MAX_ITERATIONS = 100
UNKNOWNS = 7  # of a camera: rotation, translation, delay


@record
class Bundle:
    """The outcome of a bundle adjustment.

    Each camera's change is in its own frame. ``delay_s`` is by how much a camera runs late against the first one (0 where
    delays were not asked for), ``delay_sd_s`` its standard deviation by the Hessian and the residuals' own level, for
    independent observations. ``cost`` is the sum of the robust squared residuals in units of ``sigma_px``.
    """

    rig: Rig
    rotation_rad: Float[np.ndarray, "camera 3"]
    translation_m: Float[np.ndarray, "camera 3"]
    delay_s: Float[np.ndarray, " camera"]
    delay_sd_s: Float[np.ndarray, " camera"]
    cost: float
    converged: bool
    iterations: int


@dataclass(frozen=True)
class _Problem:
    Ks: Float[np.ndarray, "camera 3 3"]
    observed: Float[np.ndarray, "camera point 2"]
    velocity: Float[np.ndarray, "camera point 2"]
    weight: Float[np.ndarray, "camera point"]
    scale_px: Float[np.ndarray, "camera point"]
    prior: Float[np.ndarray, "camera 7"]  # information: 1/sd²


@dataclass(frozen=True)
class _Estimate:
    Ts_cam_lab: Float[np.ndarray, "camera 4 4"]
    points: Float[np.ndarray, "point 3"]
    change: Float[np.ndarray, "camera 7"]

    def moved(self, camera_step: np.ndarray, point_step: np.ndarray) -> "_Estimate":
        turns = Rotation.from_rotvec(camera_step[:, :3]).as_matrix()
        Ts = [transform(R, v) @ T for R, v, T in zip(turns, camera_step[:, 3:6], self.Ts_cam_lab, strict=True)]
        return _Estimate(np.stack(Ts), self.points + point_step, self.change + camera_step)


def adjust_poses(
    rig: Rig,
    uv_px: Float[np.ndarray, "camera point 2"],
    confidence: Float[np.ndarray, "camera point"],
    *,
    sigma_px: float,
    scale_m: float,
    velocity_px_s: Float[np.ndarray, "camera point 2"] | None = None,
    delay_prior_s: float = 0.0,
    max_iterations: int = MAX_ITERATIONS,
) -> Bundle:
    """Find the camera poses (and points) that explain the observations best, near the calibration.

    Args:
        rig: The calibrated cameras: start and centre of the prior.
        uv_px: Undistorted observations, NaN missing. A point that fewer than two cameras see is left out.
        confidence: Weight of each observation's squared residual.
        sigma_px: Standard deviation of an observation of confidence 1: it weighs the observations against the prior.
        scale_m: Scale of Cauchy's loss, at the point's depth.
        velocity_px_s: How fast each observation moves in the image; with it the cameras' delays are estimated too. An
            observation whose velocity is NaN is left out then.
        delay_prior_s: Standard deviation of a delay about 0.
        max_iterations: Where to stop if it has not converged.
    """
    projections, focal_px = projection_matrices(rig), focal_lengths_px(rig)
    seen = np.isfinite(uv_px).all(axis=-1) & (confidence > 0)
    if velocity_px_s is not None:
        seen &= np.isfinite(velocity_px_s).all(axis=-1)
    usable = np.where(seen, confidence, 0.0)
    start = triangulate(projections, focal_px, uv_px, usable, method="robust", scale_m=scale_m)
    known = np.isfinite(start.xyz_lab_m[:, 0])
    estimate = _Estimate(
        np.stack([camera.T_cam_lab for camera in rig.cameras]),
        start.xyz_lab_m[known],
        np.zeros((len(rig.cameras), UNKNOWNS)),
    )
    velocity = np.zeros_like(uv_px) if velocity_px_s is None else velocity_px_s
    problem = _Problem(
        Ks=np.stack([camera.intrinsic_px for camera in rig.cameras]),
        observed=np.where(seen[:, known, None], uv_px[:, known], np.nan),
        velocity=np.where(seen[:, known, None], velocity[:, known], 0.0),
        weight=usable[:, known] / sigma_px**2,
        scale_px=_scale_px(estimate, focal_px, scale_m),
        prior=_prior(len(rig.cameras), delay_prior_s if velocity_px_s is not None else 0.0),
    )
    with one_blas_thread():
        return _minimise(rig, problem, estimate, max_iterations)


def _prior(cameras: int, delay_s: float) -> Float[np.ndarray, "camera 7"]:
    """Give the prior's information; a delay that is not asked for, and the first camera's, is held at 0."""
    held = 1e-9
    sd = [PRIOR_ROTATION_RAD] * 3 + [PRIOR_TRANSLATION_M] * 3 + [delay_s or held]
    prior = np.tile(np.array(sd) ** -2.0, (cameras, 1))
    prior[0, 6] = held**-2.0
    return prior


def _minimise(rig: Rig, problem: _Problem, estimate: _Estimate, max_iterations: int) -> Bundle:
    """Levenberg-Marquardt."""
    cost = _cost(problem, estimate)
    damping, converged, iterations = 1e-3, False, 0
    while not converged and iterations < max_iterations:
        iterations += 1
        camera_step, point_step, _ = _step(problem, estimate, damping)
        trial = estimate.moved(camera_step, point_step)
        trial_cost = _cost(problem, trial)
        if trial_cost <= cost:
            estimate, cost = trial, trial_cost
            damping = max(damping / 10, 1e-9)
        else:
            damping *= 10
        converged = bool(np.abs(camera_step).max() < STEP_TOLERANCE)
    information = _step(problem, estimate, 0.0)[2]
    freedom = max(2 * int((problem.weight > 0).sum()) - 3 * len(estimate.points), 1)
    variance = np.diag(np.linalg.inv(information)).reshape(-1, UNKNOWNS) * (cost / freedom)
    cameras = tuple(
        replace(camera, T_lab_cam=_inverse(T)) for camera, T in zip(rig.cameras, estimate.Ts_cam_lab, strict=True)
    )
    return Bundle(
        rig=replace(rig, cameras=cameras),
        rotation_rad=estimate.change[:, :3],
        translation_m=estimate.change[:, 3:6],
        delay_s=estimate.change[:, 6],
        delay_sd_s=np.sqrt(variance[:, 6]),
        cost=cost,
        converged=converged,
        iterations=iterations,
    )


def _residual(problem: _Problem, estimate: _Estimate) -> Float[np.ndarray, "camera point 2"]:
    """Give observed minus predicted, pixels; NaN where nothing was observed, infinite behind the camera."""
    T, points = estimate.Ts_cam_lab, estimate.points
    xyz = np.einsum("cij,pj->cpi", T[:, :3, :3], points) + T[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        homogeneous = np.einsum("cij,cpj->cpi", problem.Ks, xyz)
        projected = np.where(xyz[..., 2:] > 0, homogeneous[..., :2] / homogeneous[..., 2:], np.inf)
    return problem.observed - projected + estimate.change[:, 6, None, None] * problem.velocity


def _scale_px(estimate: _Estimate, focal_px: np.ndarray, scale_m: float) -> Float[np.ndarray, "camera point"]:
    T = estimate.Ts_cam_lab
    depth_m = np.einsum("cj,pj->cp", T[:, 2, :3], estimate.points) + T[:, 2, 3, None]
    return focal_px[:, None] * scale_m / depth_m


def _cost(problem: _Problem, estimate: _Estimate) -> float:
    squared = np.where(problem.weight > 0, (_residual(problem, estimate) ** 2).sum(axis=-1), 0.0)
    robust = problem.weight * problem.scale_px**2 * np.log1p(squared / problem.scale_px**2)
    return float(robust.sum() + (problem.prior * estimate.change**2).sum())


def _step(
    problem: _Problem, estimate: _Estimate, damping: float
) -> tuple[Float[np.ndarray, "camera 7"], Float[np.ndarray, "point 3"], Float[np.ndarray, "unknown unknown"]]:
    """Solve the damped normal equations: first for the cameras, then back for the points; also give the cameras' matrix."""
    to_pose, to_point = pose_jacobians(estimate.Ts_cam_lab, problem.Ks, estimate.points)
    to_camera = np.concatenate([to_pose, -problem.velocity[..., None]], axis=-1)
    residual = np.where(problem.weight[..., None] > 0, _residual(problem, estimate), 0.0)
    robust = problem.weight / (1.0 + (residual**2).sum(axis=-1) / problem.scale_px**2)
    cameras, points = residual.shape[:2]
    weighted_camera, weighted_point = robust[..., None, None] * to_camera, robust[..., None, None] * to_point
    stacked = weighted_camera.reshape(cameras, 2 * points, UNKNOWNS).transpose(0, 2, 1)
    H_cc = stacked @ to_camera.reshape(cameras, 2 * points, UNKNOWNS) + problem.prior[:, :, None] * np.eye(UNKNOWNS)
    H_pp = (weighted_point.swapaxes(2, 3) @ to_point).sum(axis=0)
    H_cp = weighted_camera.swapaxes(2, 3) @ to_point
    g_c = (stacked @ residual.reshape(cameras, 2 * points, 1))[..., 0] - problem.prior * estimate.change
    g_p = (weighted_point.swapaxes(2, 3) @ residual[..., None]).sum(axis=0)[..., 0]
    H_cc += damping * H_cc * np.eye(UNKNOWNS)
    # A point that the loss has let go of altogether, or that but one camera still tells of, lacks information: there it stays.
    lowest = LOWEST_INFORMATION + SMALLEST_SHARE * np.trace(H_pp, axis1=1, axis2=2)
    H_pp += (damping * H_pp + lowest[:, None, None]) * np.eye(3)
    inverse_pp = np.linalg.inv(H_pp)
    by_unknown = H_cp.swapaxes(1, 2).reshape(cameras * UNKNOWNS, points * 3)
    carried = (H_cp @ inverse_pp).swapaxes(1, 2).reshape(cameras * UNKNOWNS, points * 3)
    matrix = -carried @ by_unknown.T
    matrix.reshape(cameras, UNKNOWNS, cameras, UNKNOWNS)[np.arange(cameras), :, np.arange(cameras), :] += H_cc
    camera_step = np.linalg.solve(matrix, g_c.ravel() - carried @ g_p.ravel())
    rest = g_p - (camera_step @ by_unknown).reshape(points, 3)
    return camera_step.reshape(cameras, UNKNOWNS), (inverse_pp @ rest[..., None])[..., 0], matrix


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


def _inverse(T_a_b: np.ndarray) -> np.ndarray:
    return transform(T_a_b[:3, :3].T, -T_a_b[:3, :3].T @ T_a_b[:3, 3])
