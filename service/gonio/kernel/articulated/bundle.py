"""Bundle adjustment of one joint: the part's points and its motion together, from many starts at once.

Unknown are the points X_k in the part's frame and the joint's own unknowns (:mod:`gonio.kernel.articulated.motion`);
minimised is the Huber loss of the distance between marks and projections, plus the distance from the floor of what stands
on it. Levenberg and Marquardt's method, with the points eliminated by the Schur complement: 3 × 3 a point, then one
small system in the twists of the pictures, projected on the unknowns of the joint's kind. All starts go side by side, each with
its own damping; what is done for each mark is compiled (:mod:`gonio.kernel.articulated.normal_equations`).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.articulated.motion import Motions, cross, step, twists_of
from gonio.kernel.articulated.normal_equations import Marks, reduce_points, steps_of_points, sum_losses
from gonio.records import UNKNOWNS, JointKind, stands_still

HUBER = 3.0
"""Residuals beyond this many standard deviations count linearly."""

NEAREST_M = 1e-3
"""A point nearer to the camera than this is as good as behind it."""


@dataclass(frozen=True)
class Sights:
    """One part in all pictures, with the parent's motion taken away: the pinhole cameras, and the undistorted marks.

    ``R_cam`` and ``o_m`` are the rotation ``R_cam_world`` and the centre of each picture's camera in the frame that the solver
    works in, ``f_px`` (fx, fy). ``uv_px`` are marks relative to the principal point. ``used`` masks them; ``floor`` masks
    what stands on the plane ``normal · x = offset_m``, ``floor_sd_m`` how well.
    """

    R_cam: Float[np.ndarray, "picture 3 3"]
    o_m: Float[np.ndarray, "picture 3"]
    f_px: Float[np.ndarray, "picture 2"]
    uv_px: Float[np.ndarray, "picture point 2"]
    used: Bool[np.ndarray, "picture point"]
    floor: Bool[np.ndarray, "picture point"]
    normal: Float[np.ndarray, "3"]
    offset_m: float
    floor_sd_m: float
    sigma_px: float
    reference: int

    def rays(self) -> Float[np.ndarray, "picture point 3"]:
        """Give the unit direction of each mark's ray; NaN where there is no mark."""
        xy = self.uv_px / self.f_px[:, None]
        d = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ self.R_cam
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    @property
    def still(self) -> bool:
        """Whether all pictures are from one place."""
        return stands_still(self.o_m)

    def of_points(self, which: Bool[np.ndarray, " point"]) -> "Sights":
        """Keep some points."""
        return replace(self, uv_px=self.uv_px[:, which], used=self.used[:, which], floor=self.floor[:, which])

    def of_pictures(self, which: Int[np.ndarray, " picture"]) -> "Sights":
        """Keep some pictures, the first of them as the reference."""
        return replace(
            self, R_cam=self.R_cam[which], o_m=self.o_m[which], f_px=self.f_px[which], uv_px=self.uv_px[which],
            used=self.used[which], floor=self.floor[which], reference=0,
        )  # fmt: skip

    def with_noise(self, sigma_px: float) -> "Sights":
        """Expect another noise."""
        return replace(self, sigma_px=sigma_px)


def whitened(
    sights: Sights, Y: Float[np.ndarray, "start picture point 3"]
) -> tuple[Float[np.ndarray, "start picture point 3"], Float[np.ndarray, "start picture point 3 3"]]:
    """Give each mark's residuals (u, v, height over the floor) by their standard deviations, and their slopes by Y.

    What is not used is 0. A point behind its camera has infinite residuals.
    """
    Z = ((Y - sights.o_m[:, None])[..., None, :] @ sights.R_cam[:, None].swapaxes(-1, -2))[..., 0, :]
    behind = Z[..., 2] < NEAREST_M
    depth = np.where(behind, 1.0, Z[..., 2])
    scale = (sights.f_px / sights.sigma_px)[:, None] / depth[..., None]
    r = np.zeros_like(Y)
    r[..., :2] = Z[..., :2] * scale - np.nan_to_num(sights.uv_px) / sights.sigma_px
    r[behind, :2] = np.inf
    slope = np.zeros((*Y.shape, 3))
    R = sights.R_cam[:, None]
    for row in range(2):
        slope[..., row, :] = scale[..., row, None] * (R[..., row, :] - (Z[..., row] / depth)[..., None] * R[..., 2, :])
    r[..., :2] = np.where(sights.used[..., None], r[..., :2], 0.0)
    slope[..., :2, :] *= sights.used[..., None, None]
    r[..., 2] = sights.floor * ((Y @ sights.normal - sights.offset_m) / sights.floor_sd_m)
    slope[..., 2, :] = sights.floor[..., None] * sights.normal / sights.floor_sd_m
    return r, slope


def losses(
    marks: Marks, motions: Motions, x_m: Float[np.ndarray, "start point 3"], huber: float
) -> Float[np.ndarray, " start"]:
    """Sum Huber's loss of each mark's distance, and the floor's squares; infinite with a point behind a camera."""
    return sum_losses(marks, motions.R, motions.t, x_m, huber, NEAREST_M)


def adjust(
    kind: JointKind,
    sights: Sights,
    motions: Motions,
    x_m: Float[np.ndarray, "start point 3"],
    *,
    iterations: int,
    huber: float = HUBER,
    settled: float = 1e-12,
) -> tuple[Motions, Float[np.ndarray, "start point 3"], Float[np.ndarray, " start"]]:
    """Improve each start by at most so many steps; gives motions, points and losses (infinite: a start that can't be).

    A start stops when its loss twice falls by less than ``settled`` of itself; points that no two pictures show stay where
    they are.
    """
    marks, x_m = marks_of(sights), np.ascontiguousarray(x_m)
    cost = losses(marks, motions, x_m, huber)
    damping, calm = np.full(len(cost), 1e-3), np.zeros(len(cost), dtype=int)
    for _ in range(iterations):
        going = np.flatnonzero((calm < 2) & np.isfinite(cost) & (damping < 1e8))
        if not len(going):
            break
        here, at_m = motions.pick(going), x_m[going]
        change, dx = _solve(kind, marks, here, at_m, damping[going], huber, sights.reference)
        tried, moved = step(kind, here, change, sights.reference), at_m + dx
        new = losses(marks, tried, moved, huber)
        better = new < cost[going]
        calm[going] = np.where(np.abs(cost[going] - new) <= settled * cost[going] + 1e-20, calm[going] + 1, 0)
        damping[going] *= np.where(better, 0.2, 6.0)
        took = going[better]
        cost[took], x_m = new[better], _put(x_m, took, moved[better])
        motions = Motions(
            *(
                _put(old, took, fresh[better])
                for old, fresh in zip(vars(motions).values(), vars(tried).values(), strict=True)
            )
        )
    return motions, x_m, cost


def _put(all_of: np.ndarray, where: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = all_of.copy()
    out[where] = values
    return out


def marks_of(sights: Sights) -> Marks:
    """Give the sights as plain arrays, divided by the standard deviations once, and not in each step."""
    return Marks(
        R_cam=np.ascontiguousarray(sights.R_cam),
        o_m=np.ascontiguousarray(sights.o_m),
        f=np.ascontiguousarray(sights.f_px / sights.sigma_px),
        uv=np.ascontiguousarray(np.nan_to_num(sights.uv_px) / sights.sigma_px),
        used=np.ascontiguousarray(sights.used),
        floor=np.ascontiguousarray(sights.floor),
        plane=np.append(sights.normal, sights.offset_m) / sights.floor_sd_m,
    )


def _solve(
    kind: JointKind,
    marks: Marks,
    motions: Motions,
    x_m: Float[np.ndarray, "start point 3"],
    damping: Float[np.ndarray, " start"],
    huber: float,
    reference: int,
) -> tuple[Float[np.ndarray, "start unknown"], Float[np.ndarray, "start point 3"]]:
    reduced = reduce_points(marks, motions.R, motions.t, x_m, damping, huber)
    starts, pictures = motions.t.shape[:2]
    each = twists_of(kind, motions, reference)
    B = each.reshape(starts, 6 * pictures, -1)
    BT = B.swapaxes(-1, -2)
    S = BT @ reduced.S @ B
    diagonal = range(S.shape[-1])
    S[:, diagonal, diagonal] += damping[:, None] * (each * (reduced.own @ each)).sum(axis=(1, 2)) + 1e-9
    change = np.linalg.solve(S, BT @ reduced.right[..., None])[..., 0]
    twist = (each @ change[:, None, :, None])[..., 0]
    return change, steps_of_points(reduced, twist)


def dense_jacobian(
    kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]
) -> tuple[
    Float[np.ndarray, "residual unknown"], Float[np.ndarray, "residual point3"], Float[np.ndarray, "residual twist"]
]:
    """Give the slopes of all whitened residuals of one solution: by the joint's unknowns, the points, and any twists."""
    Y = motions.moved(x_m)
    _, slope = whitened(sights, Y)
    pictures, points = sights.used.shape
    by_x = np.zeros((pictures, points, 3, points, 3))
    by_t = np.zeros((pictures, points, 3, pictures, 6))
    for k in range(points):
        by_x[:, k, :, k] = slope[0, :, k] @ motions.R[0]
    for i in range(pictures):
        by_t[i, :, :, i] = np.concatenate([-slope[0, i] @ cross(Y[0, i]), slope[0, i]], axis=-1)
    flat = by_t.reshape(pictures * points * 3, -1)
    B = twists_of(kind, motions, sights.reference)[0].reshape(6 * pictures, -1)
    return flat @ B, by_x.reshape(len(flat), -1), flat


def camera_jacobian(
    sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]
) -> Float[np.ndarray, "residual camera_unknown"]:
    """Give the slopes of all whitened residuals of one solution by the cameras' :data:`~gonio.records.UNKNOWNS`.

    Those by the lens hold to first order in the distortion; a delay does nothing to a still picture.
    """
    Y = motions.moved(x_m)
    Z = ((Y - sights.o_m[:, None])[0, ..., None, :] @ sights.R_cam[:, None].swapaxes(-1, -2))[..., 0, :]
    _, slope = whitened(sights, Y)
    by_Z = slope[0] @ sights.R_cam[:, None].swapaxes(-1, -2)
    by_Z[..., 2, :] = 0.0  # the floor is where it is, whatever the cameras are
    pictures, points = sights.used.shape
    out = np.zeros((pictures, points, 3, pictures, len(UNKNOWNS)))
    f = sights.f_px[:, None]
    x, y = np.moveaxis(np.nan_to_num(sights.uv_px) / f, -1, 0)
    r2, zero, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    fx, fy = f[..., 0], f[..., 1]
    # By focal length, aspect, principal point, and the five coefficients.
    along = [x, zero, one, zero, fx * x * r2, fx * x * r2**2, fx * 2 * x * y, fx * (r2 + 2 * x * x), fx * x * r2**3]
    down = [y, fx * y, zero, one, fy * y * r2, fy * y * r2**2, fy * (r2 + 2 * y * y), fy * 2 * x * y, fy * y * r2**3]
    lens = np.stack([np.stack(along, axis=-1), np.stack(down, axis=-1)], axis=-2)
    lens *= (sights.used / sights.sigma_px)[..., None, None]
    for i in range(pictures):
        out[i, :, :, i, :6] = np.concatenate([-by_Z[i] @ cross(Z[i]), by_Z[i]], axis=-1)
        out[i, :, :2, i, 6:15] = lens[i]
    return out.reshape(pictures * points * 3, -1)
