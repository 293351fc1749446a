"""Add a picture to a solved body: points, centre and axis are known, so only the joint's own few unknowns of it are sought.

This is the paper's Fig. 8 case. The other pictures are not solved again, and the result's covariance takes what they told as
exact.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.kernel.articulated.bundle import HUBER, Sights, losses, marks_of, whitened
from gonio.kernel.articulated.chain import sights_of
from gonio.kernel.articulated.motion import OWN, Motions, cross, step, twists_of
from gonio.kernel.articulated.observability import refuse
from gonio.kernel.geometry.transforms import transform
from gonio.records import Camera, Floor, JointKind, JointMotion, Part

STARTS, STEPS = 40, 40

MIN_MARKS = 4
"""Three known points in one picture have up to four exact poses."""


def add_picture(
    motion: JointMotion,
    camera: Camera,
    uv_px: Float[np.ndarray, "point 2"],
    *,
    T_world_parent: Float[np.ndarray, "4 4"],
    floor: Floor | None = None,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Find where a part of a solved body is in one more picture.

    Args:
        motion: The part's joint as it was solved.
        camera: The new picture's.
        uv_px: The part's points in it, in the order of ``motion.xyz_m``; NaN where not seen.
        T_world_parent: Its parent's motion from the reference picture to this one; the identity for the root.
        floor: The floor that a planar joint turns on.

    Returns:
        ``T_parent_part``, and the covariance of the twist ``(turn_rad, shift_m)`` about ``motion.pivot_m``.

    Raises:
        InputError: ``floor-missing``: a planar joint without a floor.
        CaptureError: ``too-few-points``: fewer than four known points are marked.
    """
    known = np.isfinite(motion.xyz_m[:, 0]) & np.isfinite(uv_px[:, 0])
    if known.sum() < MIN_MARKS:
        raise refuse("too-few-points", motion.part)
    if motion.kind == "planar" and floor is None:
        raise InputError(
            f"Part {motion.part} moves on the floor, but there is no floor.",
            hint="Give the floor that it was solved with.",
            code="floor-missing",
        )
    uv = np.where(known[:, None], uv_px, np.nan)
    part = Part(
        name=motion.part, parent=None, kind=motion.kind, uv_px=np.stack([np.full_like(uv, np.nan), uv]),
        on_floor=np.zeros((2, len(uv)), dtype=bool),
    )  # fmt: skip
    Gs = np.stack([np.eye(4), T_world_parent])
    sights, shift = sights_of(part, (camera, camera), Gs, floor, 0, motion.sigma_px)
    # The solver works about the joint's own pivot.
    sights = replace(sights, o_m=sights.o_m + shift - motion.pivot_m)
    x_m = np.nan_to_num(motion.xyz_m - motion.pivot_m)
    motions, J = _search(motion, sights, x_m, known, floor)
    own = twists_of(motion.kind, motions, 0)[0, 1, :, : OWN[motion.kind]]
    R, t = motions.R[0, 1], motions.t[0, 1]
    covariance = own @ np.linalg.inv(J.T @ J) @ own.T
    return transform(R, t + motion.pivot_m - R @ motion.pivot_m), covariance


def _starts(
    motion: JointMotion, sights: Sights, x_m: Float[np.ndarray, "point 3"], known: np.ndarray, floor: Floor | None
) -> Motions:
    rng = np.random.default_rng(0)
    kind, middle = motion.kind, x_m[known].mean(axis=0)
    centre = np.zeros(3)
    axis = np.array([0.0, 1.0, 0.0])
    if kind == "spherical":
        centre = motion.centre_m - motion.pivot_m
    elif kind == "hinge":
        centre, axis = motion.axis_point_m - motion.pivot_m, motion.axis
    elif kind == "planar" and floor is not None:
        axis = floor.normal
    elif kind == "prismatic":
        axis = motion.axis
    vector = rng.uniform(-np.pi, np.pi, (STARTS, 1)) * axis
    if kind in ("free", "spherical"):
        vector = Rotation.random(STARTS, random_state=0).as_rotvec()
    vector[0] = 0
    R = Rotation.from_rotvec(vector).as_matrix() if kind != "prismatic" else np.tile(np.eye(3), (STARTS, 1, 1))
    if kind in ("spherical", "hinge"):
        t = centre - R @ centre
    else:
        uv = sights.uv_px[1, known]
        size = np.linalg.norm(x_m[known] - middle) * np.sqrt(2 / 3) / np.linalg.norm(uv - uv.mean(axis=0))
        ray = np.append(uv.mean(axis=0) / sights.f_px[1], 1.0) @ sights.R_cam[1]
        t = sights.o_m[1] + ray * sights.f_px[1].mean() * size - R @ middle
        if kind == "planar":
            t -= (t @ axis)[:, None] * axis
        if kind == "prismatic":
            t = (t @ axis)[:, None] * axis
    still = np.zeros((STARTS, 1, 3))
    return Motions(
        np.concatenate([np.tile(np.eye(3), (STARTS, 1, 1, 1)), R[:, None]], axis=1),
        np.concatenate([still, t[:, None]], axis=1),
        np.tile(centre, (STARTS, 1)),
        np.tile(axis, (STARTS, 1)),
    )


def _search(
    motion: JointMotion, sights: Sights, x_m: Float[np.ndarray, "point 3"], known: np.ndarray, floor: Floor | None
) -> tuple[Motions, Float[np.ndarray, "residual unknown"]]:
    kind, count = motion.kind, OWN[motion.kind]
    here = _starts(motion, sights, x_m, known, floor)
    x = np.tile(x_m, (STARTS, 1, 1))
    marks = marks_of(sights)
    cost, damping = losses(marks, here, x, HUBER), np.full(STARTS, 1e-3)
    for _ in range(STEPS):
        J, r = _slopes(here, sights, x, kind, HUBER)
        H = J.swapaxes(-1, -2) @ J
        H[:, range(count), range(count)] *= 1 + damping[:, None]
        change = np.zeros((STARTS, twists_of(kind, here, 0).shape[-1]))
        solvable = np.isfinite(cost)
        gradient = J[solvable].swapaxes(-1, -2) @ r[solvable, :, None]
        change[solvable, :count] = -np.linalg.solve(H[solvable] + 1e-9 * np.eye(count), gradient)[..., 0]
        tried = step(kind, here, change, 0)
        new = losses(marks, tried, x, HUBER)
        better = new < cost
        cost, damping = np.where(better, new, cost), damping * np.where(better, 0.2, 6.0)
        pick = [
            np.where(better.reshape(-1, *[1] * (old.ndim - 1)), fresh, old)
            for old, fresh in zip(vars(here).values(), vars(tried).values(), strict=True)
        ]
        here = Motions(*pick)
    best = np.array([int(np.argmin(cost))])
    found = here.pick(best)
    return found, _slopes(found, sights, x[best], kind, HUBER)[0][0]


def _slopes(
    motions: Motions, sights: Sights, x_m: Float[np.ndarray, "start point 3"], kind: JointKind, huber: float
) -> tuple[Float[np.ndarray, "start residual unknown"], Float[np.ndarray, "start residual"]]:
    """Give the weighted residuals of the new picture and their slopes by the joint's own unknowns."""
    Y = motions.moved(x_m)
    r, slope = whitened(sights, Y)
    r, slope = np.nan_to_num(r[:, 1], posinf=0.0), slope[:, 1]
    root = np.sqrt(np.minimum(1.0, huber / np.maximum(np.hypot(r[..., 0], r[..., 1]), 1e-12)))[..., None]
    own = twists_of(kind, motions, 0)[:, 1, :, : OWN[kind]]
    by_twist = np.concatenate([-slope @ cross(Y[:, 1]), slope], axis=-1) * root[..., None]
    J = by_twist @ own[:, None]
    return J.reshape(len(J), -1, J.shape[-1]), (r * root).reshape(len(r), -1)
