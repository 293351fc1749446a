"""The pose of a flat board in one camera: both solutions, for many pictures at once.

A flat board that is small or far looks nearly the same under two poses, mirror images about the line of sight. A single
picture can't tell which is true; the other cameras can. So both are kept until all cameras are put together.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import distort, normalize
from gonio.records import Camera, record

MIN_CORNERS = 6
"""A pose has six unknowns and a corner tells two; three more corners are there to contradict a false one."""

ITERATIONS = 12
STEP_TOLERANCE = 1e-9


@record
class BoardPoses:
    """Up to two poses of the board in each picture of a camera, the better one first.

    ``rms_px`` is each pose's reprojection error per corner, in pixels of the distorted image. NaN where a picture has
    too few corners, or there is no second solution.
    """

    T_cam_board: Float[np.ndarray, "frame 2 4 4"]
    rms_px: Float[np.ndarray, "frame 2"]

    @property
    def known(self) -> Bool[np.ndarray, " frame"]:
        """The pictures in which the board has a pose."""
        return np.asarray(np.isfinite(self.rms_px[:, 0]))


def locate_board(
    camera: Camera, corners_board_m: Float[np.ndarray, "corner 3"], uv_px: Float[np.ndarray, "frame corner 2"]
) -> BoardPoses:
    """Find the board's poses in the pictures of a camera whose intrinsics are known (its own pose plays no part).

    The closed form of infinitesimal plane-based pose estimation [Collins & Bartoli 2014] from the homography, then
    Gauss-Newton on the reprojection error of each solution. Corners that were not found are NaN.
    """
    xy = normalize(camera, uv_px)
    seen = np.isfinite(xy[..., 0]) & spans_the_plane(corners_board_m, xy)[:, None]
    usable = np.flatnonzero(seen.any(axis=1))
    poses, rms = np.full((len(uv_px), 2, 4, 4), np.nan), np.full((len(uv_px), 2), np.nan)
    if not len(usable):
        return BoardPoses(T_cam_board=poses, rms_px=rms)
    xy, seen = xy[usable], seen[usable]
    centre = _masked_mean(np.broadcast_to(corners_board_m[:, :2], xy.shape), seen)
    H_image_plane = homographies(corners_board_m[:, :2] - centre[:, None], xy, seen)
    both = _poses_of(H_image_plane)
    both[..., :3, 3] = _translations(both[..., :3, :3], corners_board_m[None, :, :2] - centre[:, None], xy, seen)
    # The closed form has its origin at the corners' centre; the board's is its first corner.
    both[..., :3, 3] -= np.einsum("fsij,fj->fsi", both[..., :3, :2], centre)
    for solution in range(2):
        T, error = _refine(camera, corners_board_m, uv_px[usable], seen, both[:, solution])
        poses[usable, solution], rms[usable, solution] = T, error
    order = np.argsort(np.where(np.isfinite(rms), rms, np.inf), axis=1)
    return BoardPoses(
        T_cam_board=np.take_along_axis(poses, order[..., None, None], axis=1),
        rms_px=np.take_along_axis(rms, order, axis=1),
    )


def spans_the_plane(
    corners_board_m: Float[np.ndarray, "corner 3"], uv: Float[np.ndarray, "frame corner 2"]
) -> Bool[np.ndarray, " frame"]:
    """Say in which pictures the found corners are enough for a pose: six, not all in a line."""
    seen = np.isfinite(uv[..., 0])
    places = np.broadcast_to(corners_board_m[:, :2], uv.shape)
    spread = np.where(seen[..., None], places - _masked_mean(places, seen)[:, None], 0.0)
    smallest = np.linalg.eigvalsh(spread.swapaxes(1, 2) @ spread)[:, 0]
    square = np.linalg.norm(corners_board_m[1] - corners_board_m[0])
    return (seen.sum(axis=1) >= MIN_CORNERS) & (smallest > 0.5 * square**2)


def homographies(
    xy_plane: Float[np.ndarray, "frame corner 2"],
    xy_image: Float[np.ndarray, "frame corner 2"],
    seen: Bool[np.ndarray, "frame corner"],
) -> Float[np.ndarray, "frame 3 3"]:
    """Fit a homography from the plane to the image in each frame, by the normalized direct linear transform.

    [Hartley & Zisserman 2004, algorithm 4.2]. Corners outside ``seen`` play no part and may be NaN.
    """
    T_plane, T_image = _conditioning(xy_plane, seen), _conditioning(xy_image, seen)
    a = _conditioned(T_plane, xy_plane, seen)
    b = _conditioned(T_image, xy_image, seen)
    weight = seen.astype(float)
    one = np.stack([a[..., 0], a[..., 1], np.ones_like(weight)], axis=-1) * weight[..., None]
    zero = np.zeros_like(one)
    rows = np.concatenate(
        [
            np.concatenate([one, zero, -b[..., :1] * one], axis=-1),
            np.concatenate([zero, one, -b[..., 1:] * one], axis=-1),
        ],
        axis=1,
    )
    _, vectors = np.linalg.eigh(rows.swapaxes(1, 2) @ rows)
    H = np.linalg.inv(T_image) @ vectors[..., 0].reshape(-1, 3, 3) @ T_plane
    return H / H[:, 2:, 2:]


def _conditioning(xy: np.ndarray, seen: np.ndarray) -> Float[np.ndarray, "frame 3 3"]:
    """Give the similarity that moves the points to the origin and to a mean distance of √2."""
    mean = _masked_mean(xy, seen)
    distance = np.where(seen, np.linalg.norm(xy - mean[:, None], axis=-1), 0.0).sum(axis=1) / seen.sum(axis=1)
    T = np.zeros((len(xy), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = np.sqrt(2) / distance
    T[:, :2, 2] = -mean * T[:, :1, 0]
    T[:, 2, 2] = 1.0
    return T


def _conditioned(T: np.ndarray, xy: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.where(seen[..., None], xy * T[:, None, :1, 0] + T[:, None, :2, 2], 0.0)


def _masked_mean(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    total = np.where(seen[..., None], values, 0.0).sum(axis=1)
    return total / np.maximum(seen.sum(axis=1), 1)[:, None]


def _poses_of(H_image_plane: Float[np.ndarray, "frame 3 3"]) -> Float[np.ndarray, "frame 2 4 4"]:
    """Give the two rotations that agree with each homography's derivative at the plane's origin; translations are 0."""
    v = H_image_plane[:, :2, 2]
    J = H_image_plane[:, :2, :2] - v[:, :, None] * H_image_plane[:, 2:, :2]
    # The rotation that takes the optical axis to the ray through v.
    length = np.linalg.norm(v, axis=1)
    axis = np.stack([-v[:, 1], v[:, 0], np.zeros_like(length)], axis=-1) / np.maximum(length, 1e-12)[:, None]
    R_v = Rotation.from_rotvec(axis * np.arctan(length)[:, None]).as_matrix()
    stretched = np.linalg.solve(R_v[:, :2, :2] - v[:, :, None] * R_v[:, 2:, :2], J)
    S = stretched.swapaxes(1, 2) @ stretched
    mean, half = (S[:, 0, 0] + S[:, 1, 1]) / 2, (S[:, 0, 0] - S[:, 1, 1]) / 2
    # Without its scale, this is the upper left of a rotation; its third row makes the columns orthonormal, up to a sign.
    A = stretched / np.sqrt(mean + np.hypot(half, S[:, 0, 1]))[:, None, None]
    third = np.sqrt(np.maximum(1 - (A**2).sum(axis=1), 0.0))
    third[:, 1] *= np.where((A[:, :, 0] * A[:, :, 1]).sum(axis=1) > 0, -1.0, 1.0)
    poses = np.zeros((len(v), 2, 4, 4))
    poses[..., 3, 3] = 1.0
    for solution, sign in enumerate((1.0, -1.0)):
        first, second = (np.concatenate([A[:, :, k], sign * third[:, k, None]], axis=1) for k in (0, 1))
        local = np.stack([first, second, np.cross(first, second)], axis=-1)
        U, _, Vt = np.linalg.svd(local)  # noise leaves the columns not quite orthonormal
        poses[:, solution, :3, :3] = R_v @ U @ Vt
    return poses


def _translations(
    R: Float[np.ndarray, "frame 2 3 3"], xy_plane: np.ndarray, xy: np.ndarray, seen: np.ndarray
) -> Float[np.ndarray, "frame 2 3"]:
    """Solve for the translation under each rotation: ``x (r₃·p + t₃) = r₁·p + t₁``, linear in t."""
    turned = np.einsum("fsij,fkj->fski", R[..., :2], xy_plane)
    weight = seen[:, None].astype(float)
    x, y = (np.where(seen, xy[..., k], 0.0)[:, None] for k in (0, 1))
    normal = np.zeros((*R.shape[:2], 3, 3))
    normal[..., 0, 0] = normal[..., 1, 1] = weight.sum(axis=-1)
    normal[..., 0, 2] = normal[..., 2, 0] = -x.sum(axis=-1)
    normal[..., 1, 2] = normal[..., 2, 1] = -y.sum(axis=-1)
    normal[..., 2, 2] = (x**2 + y**2).sum(axis=-1)
    a, b = x * turned[..., 2] - turned[..., 0] * weight, y * turned[..., 2] - turned[..., 1] * weight
    right = np.stack([a.sum(axis=-1), b.sum(axis=-1), -(x * a + y * b).sum(axis=-1)], axis=-1)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def _refine(
    camera: Camera, corners_board_m: np.ndarray, uv_px: np.ndarray, seen: np.ndarray, T_cam_board: np.ndarray
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, " frame"]]:
    """Run Gauss-Newton on all frames at once; a step that does not lower a frame's error is halved. NaN: no pose."""
    R, t = T_cam_board[:, :3, :3].copy(), T_cam_board[:, :3, 3].copy()
    error, residual, jacobian = _linearise(camera, corners_board_m, uv_px, seen, R, t)
    scale = np.ones(len(R))
    for _ in range(ITERATIONS):
        step = _gauss_newton(jacobian, residual) * scale[:, None]
        trial_R = Rotation.from_rotvec(step[:, :3]).as_matrix() @ R
        trial_t = t + step[:, 3:]
        trial_error, trial_residual, trial_jacobian = _linearise(camera, corners_board_m, uv_px, seen, trial_R, trial_t)
        better = trial_error <= error
        R[better], t[better], error[better] = trial_R[better], trial_t[better], trial_error[better]
        residual[better], jacobian[better] = trial_residual[better], trial_jacobian[better]
        scale = np.where(better, 1.0, scale / 4)
        if not np.any(np.abs(step).max(axis=1) > STEP_TOLERANCE):
            break
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    rms = np.sqrt(error / seen.sum(axis=1))
    T[~np.isfinite(rms)] = np.nan
    return T, np.where(np.isfinite(rms), rms, np.nan)


def _gauss_newton(jacobian: np.ndarray, residual: np.ndarray) -> Float[np.ndarray, "frame 6"]:
    normal = np.einsum("fkai,fkaj->fij", jacobian, jacobian)
    diagonal = np.einsum("fii->fi", normal)
    normal += np.where(diagonal > 0, 1e-9 * diagonal, 1.0)[:, :, None] * np.eye(6)
    return np.linalg.solve(normal, np.einsum("fkai,fka->fi", jacobian, residual)[..., None])[..., 0]


def _linearise(
    camera: Camera, corners_board_m: np.ndarray, uv_px: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray
) -> tuple[Float[np.ndarray, " frame"], Float[np.ndarray, "frame corner 2"], Float[np.ndarray, "frame corner 2 6"]]:
    """Give the squared error (infinite for a board behind the camera), observed minus projected, and the Jacobian."""
    turned = np.einsum("fij,kj->fki", R, corners_board_m)
    xyz = turned + t[:, None]
    x, y, z = np.moveaxis(xyz, -1, 0)
    behind = np.any(seen & (z <= 0), axis=1)
    z = np.where(z > 0, z, 1.0)
    distorted, to_distorted = distort(np.stack([x / z, y / z], axis=-1), camera.distortion)
    K = camera.intrinsic_px
    residual = np.where(seen[..., None], uv_px - distorted @ K[:2, :2].T - K[:2, 2], 0.0)
    zero = np.zeros_like(z)
    pinhole = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2)
    to_xyz = np.where(seen[..., None, None], K[:2, :2] @ to_distorted @ pinhole, 0.0)
    a, b, c = np.moveaxis(turned, -1, 0)
    cross = np.stack([np.stack([zero, c, -b], -1), np.stack([-c, zero, a], -1), np.stack([b, -a, zero], -1)], -2)
    error = np.where(behind, np.inf, (residual**2).sum(axis=(1, 2)))
    return error, residual, np.concatenate([to_xyz @ cross, to_xyz], axis=-1)
