"""Project lab points into cameras and remove lens distortion.

The distortion is OpenCV's five-parameter Brown-Conrady model, ``(k1, k2, p1, p2, k3)``, applied to normalized image
coordinates [Brown 1971; OpenCV, "Camera Calibration and 3D Reconstruction"].
"""

import numpy as np
from jaxtyping import Float

from gonio.records import Camera, Rig


def distort(
    xy: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5"]
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2 2"]]:
    """Distort normalized image coordinates; gives the distorted ones and the 2 × 2 Jacobian. NaN stays NaN."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d(radial)/d(r2) times 2, so that d(radial)/dx = slope * x
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    jacobian = np.stack(
        [
            np.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, cross], axis=-1),
            np.stack([cross, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], axis=-1),
        ],
        axis=-2,
    )
    return distorted, jacobian


def normalize(camera: Camera, uv_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Turn pixels of the distorted image into undistorted normalized coordinates (x/z, y/z).

    Newton's method on :func:`distort`, started at the distorted point; at most 20 steps, to 1e-12. NaN stays NaN. Where
    the lens model folds over (its Jacobian is singular, far outside the image) the result is NaN, never a wrong point.
    """
    inverse = np.linalg.inv(camera.intrinsic_px)
    target = uv_px @ inverse[:2, :2].T + inverse[:2, 2]
    xy = target.copy()
    error = np.full(xy.shape[:-1], np.inf)
    for _ in range(20):
        distorted, jacobian = distort(xy, camera.distortion)
        difference = distorted - target
        error = np.abs(difference).max(axis=-1)
        if not np.any(error > 1e-12):
            break
        determinant = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            step_x = (jacobian[..., 1, 1] * difference[..., 0] - jacobian[..., 0, 1] * difference[..., 1]) / determinant
            step_y = (jacobian[..., 0, 0] * difference[..., 1] - jacobian[..., 1, 0] * difference[..., 0]) / determinant
        step = np.stack([step_x, step_y], axis=-1)
        # A step longer than the image is wide leaves the region where the model means anything.
        xy = np.where(np.abs(step).max(axis=-1, keepdims=True) < 2.0, xy - step, np.nan)
    return np.where((error < 1e-9)[..., None], xy, np.nan)


def undistort(camera: Camera, uv_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Turn pixels of the distorted image into pixels of the ideal pinhole image with the same camera matrix."""
    return normalize(camera, uv_px) @ camera.intrinsic_px[:2, :2].T + camera.intrinsic_px[:2, 2]


def undistort_rig(rig: Rig, uv_px: Float[np.ndarray, "camera *batch 2"]) -> Float[np.ndarray, "camera *batch 2"]:
    """Undistort the points of all cameras of a rig."""
    return np.stack([undistort(camera, uv) for camera, uv in zip(rig.cameras, uv_px, strict=True)])


def project(camera: Camera, xyz_lab_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
    """Project lab points into the distorted image, pixels; points behind the camera and NaN give NaN."""
    T_cam_lab = camera.T_cam_lab
    xyz_cam = xyz_lab_m @ T_cam_lab[:3, :3].T + T_cam_lab[:3, 3]
    depth = np.where(xyz_cam[..., 2:] > 0, xyz_cam[..., 2:], np.nan)
    distorted, _ = distort(xyz_cam[..., :2] / depth, camera.distortion)
    return distorted @ camera.intrinsic_px[:2, :2].T + camera.intrinsic_px[:2, 2]


def projection_matrices(rig: Rig) -> Float[np.ndarray, "camera 3 4"]:
    """Give each camera's ideal projection ``K [R|t]`` from the lab, metres, to undistorted pixels."""
    return np.stack([camera.intrinsic_px @ camera.T_cam_lab[:3] for camera in rig.cameras])


def focal_lengths_px(rig: Rig) -> Float[np.ndarray, " camera"]:
    """Give each camera's mean focal length in pixels."""
    return np.array([(camera.intrinsic_px[0, 0] + camera.intrinsic_px[1, 1]) / 2 for camera in rig.cameras])


def nearest_point_to_axes(rig: Rig) -> Float[np.ndarray, "3"]:
    """Give the lab point nearest to all optical axes (least squares): the middle of the capture volume.

    For parallel axes, where every point along them is equally near, the solution of least norm is taken.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera in rig.cameras:
        axis = camera.T_lab_cam[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        normal += across
        right += across @ camera.centre_lab_m
    return np.linalg.lstsq(normal, right, rcond=None)[0]
