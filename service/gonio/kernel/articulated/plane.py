"""Cameras before one plane, a floor or a wall: their poses and focal lengths from homographies alone.

With the plane's orientation before one picture and that picture's focal length, the plane's metric is known, and each other
picture's homography from it, ``P = [a b c]``, must have ``K⁻¹ a`` and ``K⁻¹ b`` orthogonal and of equal length: two equations
with one focal length of its own [Zhang 2000; Triggs 1998]. So orientations and focal lengths of the one picture are tried on a
grid, its minima refined, and all of them given: which is right is for the bundle adjustment to say.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.two_views import fit_homography, homogeneous

TILTS, STEEPEST, AZIMUTHS = 15, 1.45, 24
"""So many tilts of the plane against the line of sight, up to the steepest (radians), to so many sides."""

GRAZING = 0.03
"""A point's line of sight meets the plane at no smaller sine."""

DESCENTS = 6
"""So many minima of the grid are refined."""

NEARLY_FLAT = 0.2
"""Points whose third principal extent is below this share of the second are resected as a plane, too."""

SAME = 0.01
"""Answers whose normals and logarithms of focal lengths differ by less are one."""


@dataclass(frozen=True)
class Plane:
    """Homographies ``x ~ H x_first`` of a plane from the first picture to all, pixels from the principal point.

    ``uv`` are the first picture's marks of the plane, ``spread_px`` how far the plane's marks scatter in each picture,
    ``focal_px`` NaN where it is not known, ``tried_px`` the focal lengths that are tried, from the shortest to the longest.
    """

    H: Float[np.ndarray, "picture 3 3"]
    uv: Float[np.ndarray, "point 2"]
    spread_px: Float[np.ndarray, " picture"]
    focal_px: Float[np.ndarray, " picture"]
    tried_px: Float[np.ndarray, " focal"]


@dataclass(frozen=True)
class Cameras:
    """Cameras ``x_cam = R X + t`` before the plane Z = 0, and how far they are from fitting the homographies, pixels."""

    R: Float[np.ndarray, "picture 3 3"]
    t: Float[np.ndarray, "picture 3"]
    f: Float[np.ndarray, " picture"]
    off_px: float

    def on_plane(self, uv: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
        """Give where the first picture's marks lie in the plane."""
        P = np.diag([self.f[0], self.f[0], 1.0]) @ np.column_stack([self.R[0, :, :2], self.t[0]])
        X = homogeneous(uv) @ np.linalg.inv(P).T
        return np.column_stack([X[:, :2] / X[:, 2:], np.zeros(len(uv))])


def _tilted(
    plane: Plane, tilt: Float[np.ndarray, "start 2"], f: Float[np.ndarray, " start"]
) -> tuple[np.ndarray, np.ndarray]:
    """Give the plane's axes in the first camera, by columns, the normal last, and its point on the line of sight."""
    v = np.column_stack([plane.uv.mean(axis=0) / f[:, None], np.ones(len(f))])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    e1 = np.cross([0.0, 1.0, 0.0], v)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(v, e1)
    axes = np.stack([e1, e2, v], axis=-1)
    return Rotation.from_rotvec(tilt[:, :1] * e1 + tilt[:, 1:] * e2).as_matrix() @ axes, v


def _maps(
    plane: Plane, tilt: Float[np.ndarray, "start 2"], f: Float[np.ndarray, " start"]
) -> tuple[
    Float[np.ndarray, "start picture 3 3"], Float[np.ndarray, "start picture"], Complex[np.ndarray, "start picture"]
]:
    """Give the homographies from the plane, ``1/f²`` of each picture, and the complex residual, in pixels."""
    axes, v = _tilted(plane, tilt, f)
    G = np.stack([axes[..., 0], axes[..., 1], v], axis=-1)
    G[:, :2] *= f[:, None, None]
    turned = plane.H @ G[:, None]
    P = turned * np.sign(turned[..., 2:, 2:])
    square = (P[..., 0] + 1j * P[..., 1]) ** 2
    size = np.abs(P[..., 0]) ** 2 + np.abs(P[..., 1]) ** 2
    flat, deep = square[..., :2].sum(axis=-1), square[..., 2]
    w = -(flat.conj() * deep).real / np.maximum(np.abs(flat) ** 2, 1e-30)
    w = np.clip(w, plane.tried_px[-1] ** -2, plane.tried_px[0] ** -2)
    w = np.where(np.isfinite(plane.focal_px), plane.focal_px**-2.0, w)
    w[:, 0] = f**-2.0
    off = (w * flat + deep) / (w * size[..., :2].sum(axis=-1) + size[..., 2])
    return P, w, off * plane.spread_px


def plane_cameras(plane: Plane) -> list[Cameras]:
    """Find all cameras that a plane's homographies allow: those next to each minimum of the grid, the best first."""
    known = bool(np.isfinite(plane.focal_px[0]))
    focals = plane.focal_px[:1] if known else plane.tried_px
    tilts, azimuths = np.linspace(0, STEEPEST, TILTS), np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
    f, along, to = (each.ravel() for each in np.meshgrid(focals, tilts, azimuths, indexing="ij"))
    tilt = along[:, None] * np.column_stack([np.cos(to), np.sin(to)])
    axes, _ = _tilted(plane, tilt, f)
    ray = homogeneous(plane.uv[None] / f[:, None, None])
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    seen = ((ray @ axes[..., 2:])[..., 0] > GRAZING).all(axis=1)
    cost = np.where(seen, (np.abs(_maps(plane, tilt, f)[2]) ** 2).sum(axis=1), np.inf)
    cost = cost.reshape(len(focals), TILTS, AZIMUTHS)
    found = [_refined(plane, tilt[k], float(f[k]), held=known) for k in _lowest(cost)[:DESCENTS]]
    if not known:  # what the homographies hardly tell, the bundle adjustment must be asked from all sides
        best = [k * TILTS * AZIMUTHS + int(np.argmin(each)) for k, each in enumerate(cost) if np.isfinite(each).any()]
        found += [_refined(plane, tilt[k], float(f[k]), held=True) for k in best]
    distinct: list[Cameras] = []
    for each in sorted(found, key=lambda each: each.off_px):
        seen = homogeneous(plane.uv / each.f[0]) @ each.R[0, :, 2] > 0
        if seen.all() and not any(_same(each, other) for other in distinct):
            distinct.append(each)
    return distinct


def _lowest(cost: Float[np.ndarray, "focal tilt azimuth"]) -> Int[np.ndarray, " minimum"]:
    """Give the places of the local minima in the flattened grid, the lowest first."""
    padded = np.pad(cost, ((1, 1), (1, 1), (0, 0)), constant_values=np.inf)
    padded = np.pad(padded, ((0, 0), (0, 0), (1, 1)), mode="wrap")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3, 3))
    lowest = np.flatnonzero((cost == windows.min(axis=(3, 4, 5))) & np.isfinite(cost))
    return lowest[np.argsort(cost.ravel()[lowest])]


def _same(one: Cameras, other: Cameras) -> bool:
    # The plane's axes may have turned, its normal not.
    return bool(one.R[0, :, 2] @ other.R[0, :, 2] > np.cos(SAME) and np.abs(np.log(one.f / other.f)).max() < SAME)


def _refined(plane: Plane, tilt: Float[np.ndarray, "2"], f: float, *, held: bool) -> Cameras:
    def at(
        x: np.ndarray,
    ) -> tuple[Float[np.ndarray, "picture 3 3"], Float[np.ndarray, " picture"], Complex[np.ndarray, " picture"]]:
        P, w, off = _maps(plane, x[None, :2], np.array([f * (1.0 if held else np.exp(np.clip(x[2], -1, 1)))]))
        return P[0], w[0], off[0]

    def split(x: np.ndarray) -> np.ndarray:
        off = at(x)[2][1:]
        return np.concatenate([np.real(off), np.imag(off)])

    x = least_squares(split, tilt if held else np.append(tilt, 0.0), max_nfev=30).x
    P, w, off = at(x)
    R, t = zip(*(_camera(P[i], float(w[i] ** -0.5)) for i in range(len(P))), strict=True)
    return Cameras(np.array(R), np.array(t), w**-0.5, float(np.sqrt((np.abs(off) ** 2).mean())))


def _camera(P: Float[np.ndarray, "3 3"], f: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Take the nearest camera of a homography from the plane Z = 0."""
    M = P / np.array([f, f, 1.0])[:, None]
    U, s, V = np.linalg.svd(M[:, :2], full_matrices=False)
    first = U @ V
    return np.column_stack([first, np.cross(first[:, 0], first[:, 1])]), M[:, 2] / s.mean()


def resect_plane(
    x_m: Float[np.ndarray, "point 3"], uv: Float[np.ndarray, "point 2"], focal_px: float,
    tried_px: tuple[float, float], seed: int,
) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]]:  # fmt: skip
    """Find a picture's two cameras, ``x_cam = R X + t`` and focal length, from known points that lie nearly in one plane.

    The second one is the twin that looks the same in parallel rays, ``R (I - 2 n nᵀ)`` mirrored along the line of sight.
    None if the points are not flat.
    """
    middle = x_m.mean(axis=0)
    _, extent, axes = np.linalg.svd(x_m - middle)
    if extent[2] > NEARLY_FLAT * extent[1]:
        return []
    axes[2] *= np.linalg.det(axes)
    fitted, _ = fit_homography((x_m - middle) @ axes[:2].T, uv, seed)
    H = fitted * np.sign(fitted[2, 2])
    square = (H[:, 0] + 1j * H[:, 1]) ** 2
    flat = square[:2].sum()
    w = np.clip(-(flat.conj() * square[2]).real / max(abs(flat) ** 2, 1e-30), tried_px[1] ** -2, tried_px[0] ** -2)
    f = focal_px if np.isfinite(focal_px) else float(w**-0.5)
    R, t = _camera(H, f)
    v = t / np.linalg.norm(t)
    twin = (np.eye(3) - 2 * np.outer(v, v)) @ R @ np.diag([1.0, 1, -1])
    return [(turn @ axes, t - turn @ axes @ middle, f) for turn in (R, twin)]
