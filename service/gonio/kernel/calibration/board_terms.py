"""One corner of a board in one camera, compiled: its residual, its derivatives, and their sums over frames.

A camera has :data:`CAMERA_UNKNOWNS` unknowns and a board pose six::

    rotation, translation   T_cam_ref ← [exp(ω), v] T_cam_ref    (in the camera's own frame, about its centre)
    focal_px, aspect, cx_px, cy_px, k1, k2, p1, p2, k3, delay_s
    rotation, translation   R_ref_board ← exp(ω) R_ref_board,  t_ref_board ← t_ref_board + v

A camera that runs late by its delay shows a corner where it was that much earlier:
``u = K distort(T_cam_ref T_ref_board X) − delay · du/dt``.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

CAMERA_UNKNOWNS = 16
BOARD_UNKNOWNS = 6
FOCAL, ASPECT, CX, CY, K1, K2, P1, P2, K3, DELAY = range(10)
"""Where each parameter stands in a camera's row of ``theta``."""

_ALL = CAMERA_UNKNOWNS + BOARD_UNKNOWNS


@njit(cache=True, nogil=True)
def image(theta: Array, x: float, y: float, velocity: Array, out: Array, slopes: Array) -> tuple[float, float, float]:
    """Put a point (x/z, y/z) into the picture: its pixel goes to ``out``, the slopes by ``theta`` to columns 6 to 15.

    Gives the derivatives of the distorted point: by x (of x), by y (of y), and the cross derivative, which is symmetric.
    """
    f, fy = theta[FOCAL], theta[FOCAL] * theta[ASPECT]
    k1, k2, p1, p2, k3 = theta[K1], theta[K2], theta[P1], theta[P2], theta[K3]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
    yd = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
    out[0] = f * xd + theta[CX] - theta[DELAY] * velocity[0]
    out[1] = fy * yd + theta[CY] - theta[DELAY] * velocity[1]
    slopes[0, 6 + FOCAL], slopes[1, 6 + FOCAL], slopes[1, 6 + ASPECT] = xd, theta[ASPECT] * yd, f * yd
    slopes[0, 6 + CX], slopes[1, 6 + CY] = 1.0, 1.0
    slopes[0, 6 + K1], slopes[1, 6 + K1] = f * x * r2, fy * y * r2
    slopes[0, 6 + K2], slopes[1, 6 + K2] = f * x * r2 * r2, fy * y * r2 * r2
    slopes[0, 6 + K3], slopes[1, 6 + K3] = f * x * r2 * r2 * r2, fy * y * r2 * r2 * r2
    slopes[0, 6 + P1], slopes[1, 6 + P1] = f * 2.0 * xy, fy * (r2 + 2.0 * yy)
    slopes[0, 6 + P2], slopes[1, 6 + P2] = f * (r2 + 2.0 * xx), fy * 2.0 * xy
    slopes[0, 6 + DELAY], slopes[1, 6 + DELAY] = -velocity[0], -velocity[1]
    bend = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    by_x = radial + bend * xx + 2.0 * p1 * y + 6.0 * p2 * x
    by_y = radial + bend * yy + 6.0 * p1 * y + 2.0 * p2 * x
    return by_x, by_y, bend * xy + 2.0 * p1 * x + 2.0 * p2 * y


@njit(cache=True, nogil=True)
def turn(T_a_b: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Apply a transform's rotation."""
    return (
        T_a_b[0, 0] * x + T_a_b[0, 1] * y + T_a_b[0, 2] * z,
        T_a_b[1, 0] * x + T_a_b[1, 1] * y + T_a_b[1, 2] * z,
        T_a_b[2, 0] * x + T_a_b[2, 1] * y + T_a_b[2, 2] * z,
    )


@njit(cache=True, nogil=True)
def predict(
    theta: Array, T_cam_ref: Array, T_ref_board: Array, xyz_board: Array, velocity: Array, out: Array, slopes: Array
) -> bool:
    """Project a corner: its pixel goes to ``out``, all derivatives (2 × 22) to ``slopes``. False: behind the camera."""
    qx, qy, qz = turn(T_ref_board, xyz_board[0], xyz_board[1], xyz_board[2])
    cx, cy, cz = turn(T_cam_ref, qx + T_ref_board[0, 3], qy + T_ref_board[1, 3], qz + T_ref_board[2, 3])
    cx, cy, cz = cx + T_cam_ref[0, 3], cy + T_cam_ref[1, 3], cz + T_cam_ref[2, 3]
    if cz <= 1e-9:
        return False
    x, y = cx / cz, cy / cz
    by_x, by_y, cross = image(theta, x, y, velocity, out, slopes)
    for row in range(2):
        scale = theta[FOCAL] / cz * (1.0 if row == 0 else theta[ASPECT])
        to_x = scale * (by_x if row == 0 else cross)
        to_y = scale * (cross if row == 0 else by_y)
        to_z = -(x * to_x + y * to_y)
        # Of ω × P: the slope by ω is P × slope by P.
        slopes[row, 0], slopes[row, 1], slopes[row, 2] = (
            to_z * cy - to_y * cz,
            to_x * cz - to_z * cx,
            to_y * cx - to_x * cy,
        )
        slopes[row, 3], slopes[row, 4], slopes[row, 5] = to_x, to_y, to_z
        rx = to_x * T_cam_ref[0, 0] + to_y * T_cam_ref[1, 0] + to_z * T_cam_ref[2, 0]
        ry = to_x * T_cam_ref[0, 1] + to_y * T_cam_ref[1, 1] + to_z * T_cam_ref[2, 1]
        rz = to_x * T_cam_ref[0, 2] + to_y * T_cam_ref[1, 2] + to_z * T_cam_ref[2, 2]
        slopes[row, 16], slopes[row, 17], slopes[row, 18] = rz * qy - ry * qz, rx * qz - rz * qx, ry * qx - rx * qy
        slopes[row, 19], slopes[row, 20], slopes[row, 21] = rx, ry, rz
    return True


@njit(cache=True, nogil=True)
def measure_frames(  # noqa: PLR0913 - compiled code takes arrays, not records
    theta: Array, Ts_cam_ref: Array, Ts_ref_board: Array, corners_board_m: Array, uv_px: Array, velocity_px_s: Array,
    weight: Array, start: int, stop: int, residual_px: Array,
) -> None:  # fmt: skip
    """Write observed minus predicted of the frames [start, stop) into ``residual_px``; infinite behind the camera."""
    out, slopes = np.empty(2), np.zeros((2, _ALL))
    for camera in range(uv_px.shape[0]):
        for frame in range(start, stop):
            for corner in range(uv_px.shape[2]):
                if weight[camera, frame, corner] <= 0.0:
                    continue
                if predict(
                    theta[camera], Ts_cam_ref[camera], Ts_ref_board[frame], corners_board_m[corner],
                    velocity_px_s[camera, frame, corner], out, slopes,
                ):  # fmt: skip
                    residual_px[camera, frame, corner, 0] = uv_px[camera, frame, corner, 0] - out[0]
                    residual_px[camera, frame, corner, 1] = uv_px[camera, frame, corner, 1] - out[1]
                else:
                    residual_px[camera, frame, corner] = np.inf


@njit(cache=True, nogil=True)
def sum_picture(  # noqa: PLR0913 - compiled code takes arrays, not records
    theta: Array, T_cam_ref: Array, T_ref_board: Array, corners_board_m: Array, uv_px: Array, velocity_px_s: Array,
    weight: Array, bend: Array, full: Array, gradient: Array,
) -> None:  # fmt: skip
    """Sum ``Jᵀ w (1 − bend n nᵀ) J`` (22 × 22) and ``Jᵀ w r`` of one camera's corners of one frame; n is along r."""
    out, slopes, residual, radial = np.empty(2), np.zeros((2, _ALL)), np.empty(2), np.empty(_ALL)
    full[:], gradient[:] = 0.0, 0.0
    for corner in range(len(weight)):
        if weight[corner] <= 0.0 or not predict(
            theta, T_cam_ref, T_ref_board, corners_board_m[corner], velocity_px_s[corner], out, slopes
        ):
            continue
        residual[0], residual[1] = uv_px[corner, 0] - out[0], uv_px[corner, 1] - out[1]
        length = max(np.hypot(residual[0], residual[1]), 1e-12)
        for i in range(_ALL):
            radial[i] = (slopes[0, i] * residual[0] + slopes[1, i] * residual[1]) / length
            gradient[i] += weight[corner] * radial[i] * length
        less = weight[corner] * bend[corner]
        for i in range(_ALL):
            across, down, along = weight[corner] * slopes[0, i], weight[corner] * slopes[1, i], less * radial[i]
            for j in range(i, _ALL):
                full[i, j] += across * slopes[0, j] + down * slopes[1, j] - along * radial[j]
    for i in range(_ALL):
        for j in range(i):
            full[i, j] = full[j, i]


@njit(cache=True, nogil=True)
def sum_frames(  # noqa: PLR0913 - compiled code takes arrays, not records
    theta: Array, Ts_cam_ref: Array, Ts_ref_board: Array, corners_board_m: Array, uv_px: Array, velocity_px_s: Array,
    weight: Array, bend: Array, start: int, stop: int, H_camera: Array, H_cross: Array, H_board: Array,
    g_camera: Array, g_board: Array,
) -> None:  # fmt: skip
    """Sum up the frames [start, stop), each into its own rows of the outputs.

    ``H_camera`` is (frame, camera, 16, 16), ``H_cross`` (frame, camera, 16, 6), ``H_board`` (frame, 6, 6); the gradients
    ``g_`` accordingly. ``weight`` is the whole weight of an observation, robust loss included; ``bend`` is by how much the
    loss's curvature is less along the residual than across it, 0 to 1.
    """
    full, gradient = np.empty((_ALL, _ALL)), np.empty(_ALL)
    for frame in range(start, stop):
        for camera in range(uv_px.shape[0]):
            sum_picture(
                theta[camera], Ts_cam_ref[camera], Ts_ref_board[frame], corners_board_m, uv_px[camera, frame],
                velocity_px_s[camera, frame], weight[camera, frame], bend[camera, frame], full, gradient,
            )  # fmt: skip
            H_camera[frame, camera] = full[:CAMERA_UNKNOWNS, :CAMERA_UNKNOWNS]
            H_cross[frame, camera] = full[:CAMERA_UNKNOWNS, CAMERA_UNKNOWNS:]
            H_board[frame] += full[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:]
            g_camera[frame, camera] = gradient[:CAMERA_UNKNOWNS]
            g_board[frame] += gradient[CAMERA_UNKNOWNS:]


@njit(cache=True, nogil=True)
def move_frames(
    theta: Array, Ts_cam_ref: Array, Ts_ref_board: Array, corners_board_m: Array, speed_ref_m_s: Array,
    velocity_px_s: Array,
) -> None:  # fmt: skip
    """Turn the corners' velocities in the ref frame (camera, frame, corner, 3) into those in the pictures."""
    out, slopes, still = np.empty(2), np.zeros((2, _ALL)), np.zeros(2)
    for camera in range(speed_ref_m_s.shape[0]):
        for frame in range(speed_ref_m_s.shape[1]):
            for corner in range(speed_ref_m_s.shape[2]):
                if not predict(
                    theta[camera], Ts_cam_ref[camera], Ts_ref_board[frame], corners_board_m[corner], still, out, slopes
                ):
                    continue
                speed = speed_ref_m_s[camera, frame, corner]
                for row in range(2):
                    velocity_px_s[camera, frame, corner, row] = (
                        slopes[row, 19] * speed[0] + slopes[row, 20] * speed[1] + slopes[row, 21] * speed[2]
                    )


@njit(cache=True, nogil=True)
def score_boards(
    theta: Array, Ts_cam_board: Array, corners_board_m: Array, uv_px: Array, clipped_px: float, rms_px: Array
) -> None:
    """Write how far boards posed otherwise, (pose, frame, 4, 4), are from their corners (frame, corner, 2) in the picture.

    The root mean square over a frame's corners, each clipped, goes to ``rms_px`` (pose, frame); NaN where the frame has
    none. A corner behind the camera, or of a pose that is NaN, is as far off as can be. The delay plays no part.
    """
    fx, fy, cx, cy = theta[FOCAL], theta[FOCAL] * theta[ASPECT], theta[CX], theta[CY]
    k1, k2, p1, p2, k3 = theta[K1], theta[K2], theta[P1], theta[P2], theta[K3]
    most = clipped_px * clipped_px
    for frame in range(uv_px.shape[0]):
        for pose in range(Ts_cam_board.shape[0]):
            T = Ts_cam_board[pose, frame]
            total, seen = 0.0, 0
            for corner in range(uv_px.shape[1]):
                u, v = uv_px[frame, corner, 0], uv_px[frame, corner, 1]
                if np.isnan(u):
                    continue
                seen += 1
                px, py, pz = turn(T, corners_board_m[corner, 0], corners_board_m[corner, 1], corners_board_m[corner, 2])
                pz += T[2, 3]
                if not pz > 0.0:
                    total += most
                    continue
                x, y = (px + T[0, 3]) / pz, (py + T[1, 3]) / pz
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                across = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx - u
                down = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy - v
                squared = across * across + down * down
                total += squared if squared < most else most
            rms_px[pose, frame] = np.sqrt(total / seen) if seen else np.nan
