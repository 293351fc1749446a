"""Project lab points into cameras and remove lens distortion.

The distortion is OpenCV's five-parameter Brown-Conrady model, ``(k1, k2, p1, p2, k3)``, applied to normalized image
coordinates [Brown 1971; OpenCV, "Camera Calibration and 3D Reconstruction"].
"""

import numpy as np
import numpy.typing as npt
from jaxtyping import Float
from numba import njit

from gonio.records import Camera, Rig

Array = npt.NDArray[np.float64]


def distort(
    xy: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5"]
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2 2"]]:
    """Distort normalized image coordinates; gives the distorted ones and the 2 × 2 Jacobian. NaN stays NaN."""
    distorted, jacobian = np.empty(xy.shape), np.empty((*xy.shape, 2))
    # Copies, which are contiguous and writable whatever was given: numba compiles one signature.
    points, flat = xy.reshape(-1, 2).astype(float), distorted.reshape(-1, 2)
    _distort_all(points, distortion.astype(float), flat, jacobian.reshape(-1, 2, 2))
    return distorted, jacobian


def normalize(camera: Camera, uv_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Turn pixels of the distorted image into undistorted normalized coordinates (x/z, y/z).

    Newton's method on :func:`distort`, started at the distorted point; at most 20 steps, to 1e-12. NaN stays NaN. Where
    the lens model folds over (its Jacobian is singular, far outside the image) the result is NaN, never a wrong point.
    """
    inverse = np.linalg.inv(camera.intrinsic_px)
    xy = uv_px.reshape(-1, 2) @ inverse[:2, :2].T + inverse[:2, 2]
    _straighten_all(xy, camera.distortion.copy())
    return xy.reshape(uv_px.shape)


@njit(cache=True, nogil=True, error_model="numpy")
def _distort_point(x: float, y: float, distortion: Array) -> tuple[float, float, float, float, float]:
    """Distort one point; also give the Jacobian's diagonal and what stands beside it: it is symmetric."""
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d(radial)/d(r2) times 2, so that d(radial)/dx = slope * x
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _distort_all(xy: Array, distortion: Array, distorted: Array, jacobian: Array) -> None:
    """Fill the distorted points (point, 2) and their Jacobians (point, 2, 2)."""
    for i in range(len(xy)):
        u, v, by_x, by_y, cross = _distort_point(xy[i, 0], xy[i, 1], distortion)
        distorted[i, 0], distorted[i, 1] = u, v
        jacobian[i, 0, 0], jacobian[i, 1, 1] = by_x, by_y
        jacobian[i, 0, 1] = jacobian[i, 1, 0] = cross


@njit(cache=True, nogil=True, error_model="numpy")
def _straighten_all(points: Array, distortion: Array) -> None:
    """Replace distorted points (point, 2) by those that the lens distorts so, NaN where there is none."""
    for target in points:
        x, y, error = target[0], target[1], np.inf
        for _ in range(20):
            u, v, by_x, by_y, cross = _distort_point(x, y, distortion)
            u, v = u - target[0], v - target[1]
            error = max(abs(u), abs(v))
            if not error > 1e-12:
                break
            determinant = by_x * by_y - cross * cross
            step_x, step_y = (by_y * u - cross * v) / determinant, (by_x * v - cross * u) / determinant
            # A step longer than the image is wide leaves the region where the model means anything.
            if not max(abs(step_x), abs(step_y)) < 2.0:
                error = np.nan
                break
            x, y = x - step_x, y - step_y
        target[0], target[1] = (x, y) if error < 1e-9 else (np.nan, np.nan)


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
