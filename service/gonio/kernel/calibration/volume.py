"""What the uncertainty of a calibration means for a point in the capture volume."""

import numpy as np
from jaxtyping import Float

from gonio.kernel.calibration.board_terms import CAMERA_UNKNOWNS, predict
from gonio.kernel.calibration.rig import RigSolution
from gonio.kernel.geometry.transforms import apply, inverse, transform
from gonio.records import BoardViews, Volume

COVERED_PERCENTILES = (2.5, 97.5)


def judge_volume(views: BoardViews, solution: RigSolution, T_lab_ref: Float[np.ndarray, "4 4"]) -> Volume:
    """Find the covered volume and propagate the covariance of the cameras to a grid of points in it."""
    uv_px = views.uv_px[list(solution.cameras)][:, solution.frames]
    seen = np.isfinite(uv_px[..., 0]).sum(axis=0) >= 2
    placed = np.stack([apply(T_lab_ref @ T, views.board.corners_board_m) for T in solution.scene.Ts_ref_board])
    corners = placed[seen] if seen.any() else placed.reshape(-1, 3)
    lower, upper = np.percentile(corners, COVERED_PERCENTILES, axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 3).T, indexing="ij"), axis=-1).reshape(-1, 3)
    sizes = np.array([views.image_sizes_px[c] for c in solution.cameras])
    return Volume(
        lower_lab_m=lower,
        upper_lab_m=upper,
        error_m=expected_error_m(solution, apply(inverse(T_lab_ref), grid), sizes),
    )


def expected_error_m(
    solution: RigSolution, xyz_ref_m: Float[np.ndarray, "point 3"], image_sizes_px: np.ndarray
) -> float:
    """Give the expected rms error of points under the solution's covariance, without a common rigid motion."""
    shifts, kept = [], []
    for point in xyz_ref_m:
        shift = _shift(solution, point, image_sizes_px)
        if shift is not None:
            shifts.append(shift)
            kept.append(point)
    if len(kept) < 4:
        return np.nan
    to_points = np.concatenate(shifts)
    centred = np.array(kept) - np.mean(kept, axis=0)
    rigid = np.concatenate([np.concatenate([np.eye(3), _cross(p)], axis=1) for p in centred])
    basis, _ = np.linalg.qr(rigid)
    rest = to_points - basis @ (basis.T @ to_points)
    return float(np.sqrt(np.einsum("ij,jk,ik->", rest, solution.adjusted.covariance, rest) / len(kept)))


def _shift(
    solution: RigSolution, point: Float[np.ndarray, "3"], image_sizes_px: np.ndarray
) -> Float[np.ndarray, "3 unknown"] | None:
    """Give the derivative of a triangulated point by all cameras' unknowns; None where fewer than two cameras see it."""
    scene, origin, still = solution.scene, np.zeros(3), np.zeros(2)
    out, slopes = np.empty(2), np.zeros((2, CAMERA_UNKNOWNS + 6))
    normal, right = np.zeros((3, 3)), np.zeros((3, len(scene.theta) * CAMERA_UNKNOWNS))
    views = 0
    for camera, (theta, T_cam_ref) in enumerate(zip(scene.theta, scene.Ts_cam_ref, strict=True)):
        T_ref_point = transform(np.eye(3), point)
        if predict(theta, T_cam_ref, T_ref_point, origin, still, out, slopes) and _inside(out, image_sizes_px[camera]):
            views += 1
            by_point = slopes[:, -3:]
            normal += by_point.T @ by_point
            right[:, camera * CAMERA_UNKNOWNS : (camera + 1) * CAMERA_UNKNOWNS] = (
                by_point.T @ slopes[:, :CAMERA_UNKNOWNS]
            )
    return -np.linalg.solve(normal, right) if views >= 2 else None


def _inside(uv_px: np.ndarray, size_px: np.ndarray) -> bool:
    return bool(np.all((uv_px > -0.5) & (uv_px < size_px - 0.5)))


def _cross(v: np.ndarray) -> Float[np.ndarray, "3 3"]:
    return np.array([[0.0, v[2], -v[1]], [-v[2], 0.0, v[0]], [v[1], -v[0], 0.0]])
