"""Two pictures of one still background: which marks fit each other, and how the cameras stood if their zooms are known.

The fundamental matrix by the normalised eight-point method inside RANSAC, scored by Sampson's distance with a clipped loss
[Hartley & Zisserman 2004, §11]; what a homography or a mere turn of the camera explains as well has no parallax in it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

SAMPLES = 400
CLIP = 3.0
"""A mark that is off by more than so many pixels says only that it is wrong."""

Homogeneous = Float[np.ndarray, "point 3"]


@dataclass(frozen=True)
class Epipolar:
    """A pair's fundamental matrix, ``x2ᵀ F x1 = 0`` in pixels from the principal point, and the marks that fit it."""

    F: Float[np.ndarray, "3 3"]
    fits: Bool[np.ndarray, " point"]


def homogeneous(uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    """Append the 1."""
    return np.concatenate([uv, np.ones_like(uv[..., :1])], axis=-1)


def _normalising(uv: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "3 3"]:
    middle = uv.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.sqrt(((uv - middle) ** 2).sum(axis=1)).mean()), 1e-9)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])


def _eight_points(
    x1: Float[np.ndarray, "*batch point 3"], x2: Float[np.ndarray, "*batch point 3"]
) -> Float[np.ndarray, "*batch 3 3"]:
    rows = (x2[..., :, None] * x1[..., None, :]).reshape(*x1.shape[:-1], 9)
    F = np.linalg.svd(rows.swapaxes(-1, -2) @ rows)[2][..., -1, :].reshape(*x1.shape[:-2], 3, 3)
    U, s, V = np.linalg.svd(F)
    s[..., 2] = 0
    return (U * s[..., None, :]) @ V


def sampson_px(
    F: Float[np.ndarray, "*batch 3 3"], x1: Homogeneous, x2: Homogeneous
) -> Float[np.ndarray, "*batch point"]:
    """Give each match's distance from the epipolar geometry, to first order, pixels of both pictures together."""
    to2, to1 = x1 @ F.swapaxes(-1, -2), x2 @ F
    across = (to2[..., :2] ** 2).sum(axis=-1) + (to1[..., :2] ** 2).sum(axis=-1)
    return np.abs((x2 * to2).sum(axis=-1)) / np.sqrt(np.maximum(across, 1e-18))


def fit_epipolar(uv1: Float[np.ndarray, "point 2"], uv2: Float[np.ndarray, "point 2"], seed: int) -> Epipolar:
    """Find the epipolar geometry of eight matches or more, some of which may be wrong."""
    x1, x2 = homogeneous(uv1), homogeneous(uv2)
    n1, n2 = _normalising(uv1), _normalising(uv2)
    y1, y2 = x1 @ n1.T, x2 @ n2.T
    rng = np.random.default_rng(seed)
    chosen = np.argsort(rng.random((SAMPLES, len(uv1))), axis=1)[:, :8]
    candidates = n2.T @ _eight_points(y1[chosen], y2[chosen]) @ n1
    best = candidates[np.argmin(np.minimum(sampson_px(candidates, x1, x2), CLIP).sum(axis=1))]
    for _ in range(5):
        fits = sampson_px(best, x1, x2) < CLIP
        if fits.sum() < 8:
            break
        again = n2.T @ _eight_points(y1[fits], y2[fits]) @ n1
        if np.minimum(sampson_px(again, x1, x2), CLIP).sum() >= np.minimum(sampson_px(best, x1, x2), CLIP).sum():
            break
        best = again
    return Epipolar(best, sampson_px(best, x1, x2) < CLIP)


def homography_rms_px(uv1: Float[np.ndarray, "point 2"], uv2: Float[np.ndarray, "point 2"]) -> float:
    """Give how well one plane, or a camera that only turned, explains good matches: rms of the transfer, pixels."""
    off = transfer_px(_homography(uv1, uv2), homogeneous(uv1), uv2)
    return float(np.sqrt((off**2).mean()))


def fit_homography(
    uv1: Float[np.ndarray, "point 2"], uv2: Float[np.ndarray, "point 2"], seed: int
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " point"]]:
    """Find the homography ``x2 ~ H x1`` that explains most of four matches or more, and the matches that fit it."""
    x1, n1, n2 = homogeneous(uv1), _normalising(uv1), _normalising(uv2)
    y1, y2 = x1 @ n1.T, homogeneous(uv2) @ n2.T
    chosen = np.argsort(np.random.default_rng(seed).random((SAMPLES, len(uv1))), axis=1)[:, :4]
    candidates = np.linalg.inv(n2) @ _linear_maps(y1[chosen], y2[chosen]) @ n1
    best = candidates[np.argmin(np.minimum(transfer_px(candidates, x1, uv2), 2 * CLIP).sum(axis=1))]
    for _ in range(3):
        fits = transfer_px(best, x1, uv2) < 2 * CLIP
        if fits.sum() < 6:
            break
        best = _homography(uv1[fits], uv2[fits])
    return best, transfer_px(best, x1, uv2) < 2 * CLIP


def _homography(uv1: Float[np.ndarray, "point 2"], uv2: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "3 3"]:
    n1, n2 = _normalising(uv1), _normalising(uv2)
    x1, x2 = homogeneous(uv1) @ n1.T, homogeneous(uv2) @ n2.T
    weight, plane = np.ones(len(x1)), np.eye(3)
    for _ in range(4):  # dividing by the depth makes the algebraic error one of the picture
        plane = _linear_maps(x1 * weight[:, None], x2)
        depth = np.abs(x1 @ plane[2])
        weight = 1 / np.maximum(depth, 1e-3 * depth.max())
    return np.linalg.inv(n2) @ plane @ n1


def turn_rms_px(
    uv1: Float[np.ndarray, "point 2"], uv2: Float[np.ndarray, "point 2"],
    focal_px: Float[np.ndarray, "2"], held: Bool[np.ndarray, "2"],
) -> float:  # fmt: skip
    """Give how well a camera that only turned and zoomed explains good matches: rms of the transfer, pixels.

    The focal lengths are sought, but for those that are held.
    """
    x1 = homogeneous(uv1)

    def off(x: Float[np.ndarray, "5"]) -> Float[np.ndarray, " residual"]:
        f1, f2 = np.where(held, focal_px, np.exp(np.clip(x[3:], -20, 20)))
        ray = Rotation.from_rotvec(x[:3]).apply(x1 / [f1, f1, 1.0])
        return (ray[:, :2] / np.maximum(ray[:, 2:], 1e-6) * f2 - uv2).ravel()

    rolls = np.radians([0.0, 90.0, -90.0])
    best = min(
        least_squares(off, [0, 0, roll, *np.log(focal_px)], x_scale=[0.1, 0.1, 0.1, 0.3, 0.3], max_nfev=60).cost
        for roll in rolls
    )
    return float(np.sqrt(2 * best / len(uv1)))


def relative_poses(E: Float[np.ndarray, "3 3"]) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """Give the four ``(R, t)`` of ``x2 = R x1 + t`` that an essential matrix stands for; t has unit length."""
    u, _, v = np.linalg.svd(E)
    U, V = u * np.sign(np.linalg.det(u)), v * np.sign(np.linalg.det(v))
    W = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    return [(U @ way @ V, sign * U[:, 2]) for way in (W, W.T) for sign in (1.0, -1.0)]


def evenness(F: Float[np.ndarray, "3 3"], f1: float, f2: Float[np.ndarray, " focal"]) -> Float[np.ndarray, " focal"]:
    """Give how far from an essential matrix each focal length of the second picture makes F: 0 is perfect, 1 hopeless."""
    K2 = np.tile(np.eye(3), (len(f2), 1, 1))
    K2[:, [0, 1], [0, 1]] = f2[:, None]
    s = np.linalg.svd(K2 @ F @ np.diag([f1, f1, 1.0]), compute_uv=False)
    return (s[:, 0] - s[:, 1]) / s[:, 0]


def triangulate_rays(
    R: Float[np.ndarray, "picture 3 3"], t: Float[np.ndarray, "picture 3"], xy: Float[np.ndarray, "picture point 2"]
) -> Float[np.ndarray, "point 3"]:
    """Intersect normalized marks (NaN: not seen) of cameras ``x_cam = R X + t`` linearly, homogeneous and hence far ones too.

    A point that fewer than two pictures see is NaN.
    """
    P = np.concatenate([R, t[..., None]], axis=-1)
    seen = np.isfinite(xy[..., 0])
    first = xy[..., 0, None] * P[:, None, 2] - P[:, None, 0]
    second = xy[..., 1, None] * P[:, None, 2] - P[:, None, 1]
    rows = np.where(seen[..., None], np.stack([first, second]), 0.0).reshape(-1, xy.shape[1], 4).swapaxes(0, 1)
    X = np.linalg.svd(rows.swapaxes(-1, -2) @ rows)[2][:, -1]
    weight = np.where(np.abs(X[:, 3:]) > 1e-9, X[:, 3:], np.nan)
    return np.where((seen.sum(axis=0) >= 2)[:, None], X[:, :3] / weight, np.nan)


def resect(
    x_m: Float[np.ndarray, "point 3"], uv: Float[np.ndarray, "point 2"], focal_px: float, seed: int
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float] | None:
    """Find a picture's camera, ``x_cam = R X + t`` and its focal length, from six known points or more, some wrong.

    The direct linear transform of six points each inside RANSAC, then of all that fit; ``focal_px`` is kept if it is
    finite. ``uv`` is relative to the principal point. None: no camera has the points before it.
    """
    middle, size = x_m.mean(axis=0), max(float(np.std(x_m)), 1e-12)
    to_x = np.diag([1 / size, 1 / size, 1 / size, 1.0])
    to_x[:3, 3] = -middle / size
    X = homogeneous((x_m - middle) / size)
    n = _normalising(uv)
    y = homogeneous(uv) @ n.T
    rng = np.random.default_rng(seed)
    chosen = np.argsort(rng.random((100, len(uv))), axis=1)[:, :6]
    P = _linear_maps(X[chosen], y[chosen])
    fits = transfer_px(np.linalg.inv(n) @ P, X, uv) < 2 * CLIP
    best = fits[np.argmax(fits.sum(axis=1))]
    chosen_all = best if best.sum() >= 6 else np.ones(len(uv), dtype=bool)
    M = np.linalg.inv(n) @ _linear_maps(X[chosen_all], y[chosen_all])
    return _as_camera(M @ to_x, x_m[chosen_all], focal_px)


def _linear_maps(
    X: Float[np.ndarray, "*batch point size"], y: Float[np.ndarray, "*batch point 3"]
) -> Float[np.ndarray, "*batch 3 size"]:
    """Solve ``y ~ M X``: points of space (size 4) give a camera, points of a plane (3) a homography."""
    zero = np.zeros_like(X)
    first = np.concatenate([X, zero, -y[..., :1] * X], axis=-1)
    second = np.concatenate([zero, X, -y[..., 1:2] * X], axis=-1)
    rows = np.concatenate([first, second], axis=-2)
    return np.linalg.svd(rows.swapaxes(-1, -2) @ rows)[2][..., -1, :].reshape(*X.shape[:-2], 3, X.shape[-1])


def transfer_px(
    M: Float[np.ndarray, "*batch 3 size"], X: Float[np.ndarray, "point size"], uv: Float[np.ndarray, "point 2"]
) -> Float[np.ndarray, "*batch point"]:
    """Give how far ``M X`` comes from each mark, pixels."""
    Y = X @ M.swapaxes(-1, -2)
    depth = np.where(np.abs(Y[..., 2:]) > 1e-12, Y[..., 2:], 1e-12)
    return np.linalg.norm(Y[..., :2] / depth - uv, axis=-1)


def _as_camera(
    P: Float[np.ndarray, "3 4"], x_m: Float[np.ndarray, "point 3"], focal_px: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float] | None:
    """Take the nearest camera without skew whose principal point is the origin."""
    ahead = np.sign(np.median(x_m @ P[2, :3] + P[2, 3]))
    scaled = P * (ahead / np.linalg.norm(P[2, :3]))
    length = np.linalg.norm(np.cross(scaled[:2, :3], scaled[2, :3]), axis=1).mean()
    f = focal_px if np.isfinite(focal_px) else float(length)
    M = scaled / np.array([f, f, 1.0])[:, None]
    U, s, V = np.linalg.svd(M[:, :3])
    if np.linalg.det(U @ V) < 0 or not np.isfinite(s).all() or s[2] < 1e-9:
        return None
    R = U @ V
    t = M[:, 3] / s.mean()
    return (R, t, f) if np.median(x_m @ R[2] + t[2]) > 0 else None
