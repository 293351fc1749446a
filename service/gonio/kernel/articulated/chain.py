"""Solve a whole body, joint by joint from the root: a child is seen by cameras that its parent's motion has been taken from.

If the parent moved by G_i from the reference picture to picture i, a camera C_i that sees the child moving with it is the
same as a camera ``G_i⁻¹ C_i`` that sees the child move by its own joint alone. That is also the paper's corrected camera
(eq. 20): for the part itself, with its whole motion, it sees a part that stands still.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.kernel.articulated.bundle import Sights, camera_jacobian, dense_jacobian, whitened
from gonio.kernel.articulated.joint import Solution, solve
from gonio.kernel.articulated.motion import Motions, across, cross, twists_of
from gonio.kernel.articulated.observability import check_observed, refuse, twist_covariance
from gonio.kernel.articulated.starts import middle_rays, nearest_to_rays
from gonio.kernel.geometry.cameras import undistort
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import UNKNOWNS, Camera, Floor, JointKind, JointMotion, KnownLength, Part, check_pictures

FLOOR_SD_M = 1e-3
"""How well a point that stands on the floor lies in its plane."""


def corrected_cameras(
    Ts_world_cam: Float[np.ndarray, "picture 4 4"], Ts_world_part: Float[np.ndarray, "picture 4 4"]
) -> Float[np.ndarray, "picture 4 4"]:
    """Give each picture's camera as it would stand if the part had not moved: eq. 20, ``T_w_c' = T_w_part⁻¹ T_w_c``."""
    return inverse(Ts_world_part) @ Ts_world_cam


def in_tree_order(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """Put parents before their children.

    Raises:
        InputError: ``joint-tree-broken``: two parts of one name, an unknown parent, or a cycle.
    """
    names = [part.name for part in parts]
    hint = "Give each part a name of its own and the name of its parent; a part that moves against the world has none."
    for part in parts:
        if names.count(part.name) > 1:
            raise InputError(f"Two parts are called {part.name}.", hint=hint, code="joint-tree-broken")
        if part.parent is not None and part.parent not in names:
            raise InputError(
                f"Part {part.name}: its parent {part.parent} is no part.", hint=hint, code="joint-tree-broken"
            )
    ordered: list[Part] = []
    left = list(parts)
    while left:
        done = {part.name for part in ordered}
        ready = [part for part in left if part.parent is None or part.parent in done]
        if not ready:
            circle = ", ".join(part.name for part in left)
            raise InputError(f"The joint tree has a cycle: {circle}.", hint=hint, code="joint-tree-broken")
        ordered += ready
        left = [part for part in left if part not in ready]
    return tuple(ordered)


def solve_body(
    cameras: tuple[Camera, ...],
    parts: tuple[Part, ...],
    floor: Floor | None,
    *,
    reference: int = 0,
    expected_noise_px: float = 1.0,
    seed: int = 0,
    camera_covariance: Float[np.ndarray, "camera_unknown camera_unknown"] | None = None,
) -> tuple[JointMotion, ...]:
    """Find the motion of all joints from the marks in the pictures.

    Args:
        cameras: One a picture, in the world's frame.
        parts: The body, in any order; results are in tree order.
        floor: The plane that the points ``on_floor`` stand on; needed by a planar joint too, which turns about its normal.
        reference: The picture in which every part's frame is the world's.
        expected_noise_px: A first idea of the marks' noise; the result tells its own.
        seed: Of the random starts.
        camera_covariance: That of all cameras' :data:`~gonio.records.UNKNOWNS`, in the order camera, unknown: the result's
            error bars hold what it does. Without it the cameras are taken as exact.

    Raises:
        InputError: The body is not what the pictures show (see :func:`gonio.records.check_pictures`).
        CaptureError: A joint's motion can't be told from these pictures; the code says why.
    """
    check_pictures(cameras, parts)
    solved: dict[str, JointMotion] = {}
    errors: dict[str, _Errors] = {}
    of_cameras = np.zeros((len(UNKNOWNS) * len(cameras),) * 2) if camera_covariance is None else camera_covariance
    for part in in_tree_order(parts):
        if floor is None and (part.on_floor.any() or part.kind == "planar"):
            raise InputError(
                f"Part {part.name} stands on the floor, but there is no floor.",
                hint="Give the floor's normal and offset.",
                code="floor-missing",
            )
        parent = solved[part.parent] if part.parent else None
        if parent is not None and (part.on_floor.any() or part.kind == "planar"):
            raise InputError(
                f"Part {part.name} has a parent: only a part that moves against the world can stand on the floor.",
                hint="Leave its points on the floor out, or make it the root.",
                code="floor-under-child",
            )
        Gs = parent.Ts_world_part if parent else np.tile(np.eye(4), (len(cameras), 1, 1))
        sights, pivot = sights_of(part, cameras, Gs, floor, reference, expected_noise_px)
        solution = solve(part.kind, sights, part.name, scale_known=part.length is not None, seed=seed)
        if part.length is not None:
            solution = _scaled(solution, part)
            check_observed(
                solution.kind,
                solution.sights,
                solution.motions,
                solution.x_m,
                solution.found,
                part.name,
                scale_known=True,
            )
        errors[part.name] = _errors(solution, pivot, errors[part.parent] if part.parent else None, Gs)
        solved[part.name] = _packed(part, solution, pivot, errors[part.name], of_cameras, Gs)
    return tuple(solved.values())


def sights_of(
    part: Part,
    cameras: tuple[Camera, ...],
    Gs: Float[np.ndarray, "picture 4 4"],
    floor: Floor | None,
    reference: int,
    noise_px: float,
) -> tuple[Sights, Float[np.ndarray, "3"]]:
    """Take lens distortion and the parent's motion away, and shift the origin into the part; gives that pivot too.

    Before a camera that stands still the origin is as far away on the reference picture's mean ray as a known length looks, or
    1 m: no distance is nearer to the truth than another.
    """
    Ts = inverse(Gs) @ np.stack([camera.T_lab_cam for camera in cameras])
    uv = np.stack([undistort(camera, marks) for camera, marks in zip(cameras, part.uv_px, strict=True)])
    K = np.stack([camera.intrinsic_px for camera in cameras])
    used = np.isfinite(uv[..., 0] + uv[..., 1])
    normal = floor.normal if floor else np.array([0.0, 1.0, 0.0])
    sights = Sights(
        R_cam=Ts[:, :3, :3].swapaxes(-1, -2), o_m=Ts[:, :3, 3], f_px=K[:, [0, 1], [0, 1]],
        uv_px=uv - K[:, None, :2, 2], used=used, floor=part.on_floor & used, normal=normal,
        offset_m=floor.offset_m if floor else 0.0, floor_sd_m=FLOOR_SD_M, sigma_px=noise_px, reference=reference,
    )  # fmt: skip
    rays = middle_rays(sights)
    pivot = nearest_to_rays(sights.o_m, rays)
    if sights.still:
        here = reference if np.isfinite(rays[reference, 0]) else int(np.flatnonzero(np.isfinite(rays[:, 0]))[0])
        pivot = sights.o_m[here] + _distance(sights, part.length) * rays[here]
    return replace(sights, o_m=sights.o_m - pivot, offset_m=sights.offset_m - float(normal @ pivot)), pivot


def _distance(sights: Sights, length: KnownLength | None) -> float:
    """Give how far away a length is that looks as long as in the picture where it looks longest."""
    if length is None:
        return 1.0
    first, second = np.moveaxis(sights.rays()[:, [length.first, length.second]], 1, 0)
    apart = np.linalg.norm(first - second, axis=-1)
    return length.length_m / max(float(np.nanmax(apart)), 1e-3) if np.isfinite(apart).any() else 1.0


def _scaled(solution: Solution, part: Part) -> Solution:
    """Give a part its size by a known length: all projections stay, all distances from the cameras scale.

    That is for a part that moves freely, or any that a camera sees from one place: the centre scales with the points.

    Raises:
        CaptureError: ``length-unseen``.
    """
    length = part.length
    assert length is not None
    if not solution.sights.used[:, [length.first, length.second]].any(axis=0).all():
        raise refuse("length-unseen", part.name)
    s, m = solution.sights, solution.motions
    factor = length.length_m / float(np.linalg.norm(solution.x_m[0, length.first] - solution.x_m[0, length.second]))
    o0 = s.o_m[s.reference]
    turned = m.R @ o0
    x_m = o0 + factor * (solution.x_m - o0)
    t = s.o_m - turned + factor * (m.t - s.o_m + turned)
    motions = replace(m, t=t, centre=o0 + factor * (m.centre - o0))
    J, Jx, Jt = dense_jacobian(solution.kind, s, motions, x_m)
    along = x_m[0, length.first] - x_m[0, length.second]
    row = np.zeros((1, J.shape[1] + Jx.shape[1]))
    sd = max(length.sd_m, 1e-4 * length.length_m)
    for point, sign in ((length.first, 1.0), (length.second, -1.0)):
        at = J.shape[1] + 3 * point
        row[0, at : at + 3] = sign * along / np.linalg.norm(along) / sd
    both = np.concatenate([np.concatenate([J, Jx], axis=1), row])
    unused = ~s.used.any(axis=0)
    H = both.T @ both + np.diag(np.concatenate([np.zeros(J.shape[1]), np.repeat(unused * 1.0, 3)]))
    H_inverse = np.linalg.inv(H)
    m_count = J.shape[1]
    gain = -(H_inverse @ both[:-1].T)[:m_count]
    found = replace(
        solution.found, covariance=H_inverse[:m_count, :m_count], by_twist=gain @ Jt,
        by_camera=gain @ camera_jacobian(s, motions, x_m),
    )  # fmt: skip
    return replace(solution, motions=motions, x_m=x_m, found=found)


def _world_to_local(G: Float[np.ndarray, "4 4"], pivot: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """Map a twist about the world's origin to the same motion in the parent's frame, about the pivot."""
    R, at = G[:3, :3], G[:3, :3] @ pivot + G[:3, 3]
    M = np.zeros((6, 6))
    M[:3, :3] = R.T
    M[3:, :3] = -R.T @ cross(at)
    M[3:, 3:] = R.T
    return M


@dataclass(frozen=True)
class _Errors:
    """What makes a part's motion uncertain: the marks' noise, as covariances, and the cameras, as slopes.

    The cameras are the same for all parts, so that their errors add up along a chain with their signs.
    """

    own: Float[np.ndarray, "unknown unknown"]
    own_by_camera: Float[np.ndarray, "unknown camera_unknown"]
    world: Float[np.ndarray, "twist twist"]
    world_by_camera: Float[np.ndarray, "twist camera_unknown"]


def _errors(
    solution: Solution, pivot: Float[np.ndarray, "3"], parent: _Errors | None, Gs: Float[np.ndarray, "picture 4 4"]
) -> _Errors:
    """Carry the parent's errors on to the joint's unknowns and to the part's twists in the world."""
    kind, motions, r = solution.kind, solution.motions, solution.sights.reference
    pictures = len(Gs)
    M = np.zeros((6 * pictures, 6 * pictures))
    for i in range(pictures):
        M[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = _world_to_local(Gs[i], pivot)
    back = np.linalg.inv(M)
    own, world = (
        solution.found.covariance,
        back @ twist_covariance(kind, motions, r, solution.found.covariance) @ back.T,
    )
    outward = back @ _twists(kind, motions, r)
    if parent is None:
        return _Errors(own, solution.found.by_camera, world, outward @ solution.found.by_camera)
    follow = solution.found.by_twist @ M
    whole = np.eye(6 * pictures) + outward @ follow
    own_by_camera = solution.found.by_camera + follow @ parent.world_by_camera
    return _Errors(
        own + follow @ parent.world @ follow.T,
        own_by_camera,
        world + whole @ parent.world @ whole.T,
        parent.world_by_camera + outward @ own_by_camera,
    )


def _twists(kind: JointKind, motions: Motions, reference: int) -> Float[np.ndarray, "twist unknown"]:
    return twists_of(kind, motions, reference)[0].reshape(6 * motions.t.shape[1], -1)


def _unshifted(motions: Motions, pivot: Float[np.ndarray, "3"]) -> Float[np.ndarray, "picture 4 4"]:
    return np.stack([transform(R, t + pivot - R @ pivot) for R, t in zip(motions.R[0], motions.t[0], strict=True)])


def _packed(
    part: Part,
    solution: Solution,
    pivot: Float[np.ndarray, "3"],
    errors: _Errors,
    of_cameras: Float[np.ndarray, "camera_unknown camera_unknown"],
    Gs: Float[np.ndarray, "picture 4 4"],
) -> JointMotion:
    covariance = errors.own + errors.own_by_camera @ of_cameras @ errors.own_by_camera.T
    world = errors.world + errors.world_by_camera @ of_cameras @ errors.world_by_camera.T
    kind, motions = solution.kind, solution.motions
    Ts = _unshifted(motions, pivot)
    missing, unknown = np.full(3, np.nan), np.full((3, 3), np.nan)
    centre, centre_cov, axis, axis_cov, point, point_cov = missing, unknown, missing, unknown, missing, unknown
    if kind == "spherical":
        centre, centre_cov = motions.centre[0] + pivot, covariance[-3:, -3:]
    if kind in ("hinge", "prismatic"):
        axis = motions.axis[0]
        plane = across(axis)
        tilt = slice(-4, -2) if kind == "hinge" else slice(-2, None)
        # A hinge's tilt is a turn phi of the axis, its change phi × axis; a prismatic joint's is the change itself.
        move = -cross(axis) @ plane if kind == "hinge" else plane
        axis_cov = move @ covariance[tilt, tilt] @ move.T
        if kind == "hinge":
            seen = solution.sights.used.any(axis=0)
            middle = solution.x_m[0, seen].mean(axis=0)
            foot = motions.centre[0] + axis * ((middle - motions.centre[0]) @ axis)
            point, slide = foot + pivot, float((foot - motions.centre[0]) @ axis)
            # The foot lies `slide` along the axis from the point that the unknowns move: a tilt shifts it sideways.
            both = np.concatenate([slide * move, plane], axis=1)
            point_cov = both @ covariance[-4:, -4:] @ both.T
    r, _ = whitened(replace(solution.sights, sigma_px=1.0), motions.moved(solution.x_m))
    used = solution.sights.used
    return JointMotion(
        part=part.name, kind=kind, Ts_parent_part=Ts, Ts_world_part=Gs @ Ts, pivot_m=pivot,
        twist_covariance=twist_covariance(kind, motions, solution.sights.reference, covariance),
        world_twist_covariance=world, centre_m=centre, centre_covariance_m2=centre_cov, axis=axis,
        axis_covariance=axis_cov, axis_point_m=point, axis_point_covariance_m2=point_cov,
        xyz_m=np.where(np.asarray(used.any(axis=0))[:, None], solution.x_m[0] + pivot, np.nan), used=used,
        residual_px=np.where(used[..., None], r[0, ..., :2], np.nan), sigma_px=solution.sigma_px,
        found_hinge=solution.found_hinge,
        other=None if solution.other is None else _unshifted(solution.other, pivot),
    )  # fmt: skip
