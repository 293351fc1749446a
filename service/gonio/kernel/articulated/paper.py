"""The paper's own way: intersect rays of two pictures that the motion brought into one frame (eq. 1), minimise eq. 2.

Kept as the reference that the default is measured against, and because its diagnostic is easy to grasp: after the right motion
the two rays of a point meet. Eq. 2's "t (s) distance difference" is read as the depth of a point along one ray, which must not
depend on the picture that it is intersected with: of the readings that were tried it is the one that helps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from gonio.errors import InputError
from gonio.kernel.articulated.bundle import Sights
from gonio.kernel.articulated.starts import middle_rays, nearest_to_rays, places
from gonio.records import JointKind

PARALLEL = 1e-9
"""Rays whose directions have ``1 − (d1·d2)²`` below this don't meet anywhere in particular."""

DEPTH_WEIGHT = 0.1
"""w2 of eq. 2, as the share of a pixel that a depth difference counts that would move the point by one pixel."""

UNIT_WEIGHT = 1e3
"""How strictly the quaternions' constraint ``|q| = 1`` is held."""

FAR_PX = 1e3
"""What a pair of rays costs that does not meet before both cameras."""


@dataclass(frozen=True)
class Meeting:
    """Where two rays pass nearest: distances along each, the middle of the shortest bridge, and its length."""

    t: Float[np.ndarray, "*batch"]
    s: Float[np.ndarray, "*batch"]
    middle: Float[np.ndarray, "*batch 3"]
    gap: Float[np.ndarray, "*batch"]


def meet(
    o1: Float[np.ndarray, "*batch 3"],
    d1: Float[np.ndarray, "*batch 3"],
    o2: Float[np.ndarray, "*batch 3"],
    d2: Float[np.ndarray, "*batch 3"],
) -> Meeting:
    """Intersect rays ``o1 + t d1`` and ``o2 + s d2`` in the least-squares sense (eq. 1); parallel rays give NaN.

    The directions need not have unit length: t and s are in multiples of them.
    """
    w = o1 - o2
    a, b, c = ((x * y).sum(axis=-1) for x, y in ((d1, d1), (d1, d2), (d2, d2)))
    p, q = (d1 * w).sum(axis=-1), (d2 * w).sum(axis=-1)
    across = a * c - b * b
    across = np.where(across > PARALLEL * a * c, across, np.nan)
    t, s = (b * q - c * p) / across, (a * q - b * p) / across
    first, second = o1 + t[..., None] * d1, o2 + s[..., None] * d2
    return Meeting(t, s, (first + second) / 2, np.linalg.norm(first - second, axis=-1))


def rotation_of(quat_wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Give the matrix of a quaternion that need not have unit length; it then is no rotation."""
    w, x, y, z = np.moveaxis(quat_wxyz, -1, 0)
    rows = [
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    ]  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*w.shape, 3, 3)


def residuals(
    sights: Sights, R: Float[np.ndarray, "picture 3 3"], t_m: Float[np.ndarray, "picture 3"]
) -> Float[np.ndarray, " residual"]:
    """Give eq. 2's terms: both reprojections of each pair's meeting point, and each ray's depth against its mean depth."""
    Rt = R.swapaxes(-1, -2)
    o = (Rt @ (sights.o_m - t_m)[..., None])[..., 0]
    d = sights.rays() @ R
    pictures, points = sights.used.shape
    pairs = list(combinations(range(pictures), 2))
    i, j = np.array(pairs).T
    both = sights.used[i] & sights.used[j]
    m = meet(o[i, None], d[i], o[j, None], d[j])
    bad = ~(np.isfinite(m.t) & (m.t > 0) & (m.s > 0))
    out = []
    for end in (i, j):
        Y = (R[end, None] @ m.middle[..., None])[..., 0] + t_m[end, None]
        Z = (sights.R_cam[end, None] @ (Y - sights.o_m[end, None])[..., None])[..., 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            off = Z[..., :2] / Z[..., 2:] * sights.f_px[end, None] - sights.uv_px[end]
        off = np.where((bad | ~(Z[..., 2] > 0))[..., None], FAR_PX, np.clip(off, -FAR_PX, FAR_PX))
        out.append(np.where(both[..., None], off, 0.0).ravel())
    depth = np.full((pictures, pictures, points), np.nan)
    depth[i, j] = np.where(both & ~bad, m.t, np.nan)
    depth[j, i] = np.where(both & ~bad, m.s, np.nan)
    known = np.isfinite(depth)
    mean = np.where(known, depth, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    scale = DEPTH_WEIGHT * sights.f_px.mean() / max(float(np.median(mean[mean > 0])) if (mean > 0).any() else 1.0, 1e-3)
    out.append(np.where(known, scale * (depth - mean[:, None]), 0.0).ravel())
    return np.concatenate(out)


def solve_paper(
    kind: JointKind, sights: Sights
) -> tuple[Float[np.ndarray, "picture 3 3"], Float[np.ndarray, "picture 3"]]:
    """Find a joint's motion as the paper does, from one start: no turn, the place by step B or the mean rays.

    Variables are a quaternion for each picture but the reference, and a translation each (free) or one centre (spherical
    and hinge, which the paper does not tell apart). Gives rotations and translations.

    Raises:
        InputError: ``method-unknown-kind``: the paper knows no planar or prismatic joint.
    """
    if kind in ("planar", "prismatic"):
        raise InputError(
            f"The paper's method knows no {kind} joint.", hint="Use the method bundle.", code="method-unknown-kind"
        )
    at_m = places(sights, kind, None)
    moving = [i for i in range(len(at_m)) if i != sights.reference]
    quaternions = np.tile([1.0, 0, 0, 0], (len(moving), 1))
    start = (
        (at_m - at_m[sights.reference])[moving] if kind == "free" else nearest_to_rays(sights.o_m, middle_rays(sights))
    )
    motion = _unpacker(kind, sights.reference, len(at_m))

    def terms(x: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " residual"]:
        R, t = motion(x)
        q = x[: 4 * len(moving)].reshape(-1, 4)
        floor = (_floor_points(sights, R, t) - sights.offset_m) / sights.floor_sd_m if kind == "free" else np.zeros(0)
        return np.concatenate([residuals(sights, R, t), floor, UNIT_WEIGHT * ((q * q).sum(axis=1) - 1)])

    found = least_squares(terms, np.concatenate([quaternions.ravel(), start.ravel()]), max_nfev=100)
    R, t = motion(found.x)
    scale = np.cbrt(np.linalg.det(R))
    return R / scale[:, None, None], t


def _floor_points(
    sights: Sights, R: Float[np.ndarray, "picture 3 3"], t_m: Float[np.ndarray, "picture 3"]
) -> Float[np.ndarray, " mark"]:
    """Give the height of each point on the floor where its reference ray and its ray in another picture meet."""
    Rt = R.swapaxes(-1, -2)
    o, d, r = (Rt @ (sights.o_m - t_m)[..., None])[..., 0], sights.rays() @ R, sights.reference
    heights = []
    for i in range(len(R)):
        both = sights.floor[i] & sights.used[i] & sights.used[r]
        if i != r and both.any():
            m = meet(o[r], d[r, both], o[i], d[i, both])
            height = np.nan_to_num(m.middle @ sights.normal, nan=1.0)
            heights.append(np.clip(height, -1.0 + sights.offset_m, 1.0 + sights.offset_m))
    return np.concatenate(heights) if heights else np.zeros(0)


def _unpacker(
    kind: JointKind, reference: int, pictures: int
) -> Callable[[Float[np.ndarray, " unknown"]], tuple[Float[np.ndarray, "picture 3 3"], Float[np.ndarray, "picture 3"]]]:
    moving = [i for i in range(pictures) if i != reference]

    def motion(
        x: Float[np.ndarray, " unknown"],
    ) -> tuple[Float[np.ndarray, "picture 3 3"], Float[np.ndarray, "picture 3"]]:
        R, t = np.tile(np.eye(3), (pictures, 1, 1)), np.zeros((pictures, 3))
        R[moving] = rotation_of(x[: 4 * len(moving)].reshape(-1, 4))
        rest = x[4 * len(moving) :]
        if kind == "free":
            t[moving] = rest.reshape(-1, 3)
        else:
            t = rest - R @ rest
        return R, t

    return motion
