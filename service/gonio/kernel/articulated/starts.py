"""Where the search for a joint's motion begins: no start is trusted, so there are many.

The part is small and stands somewhere on the mean ray of its marks; its depth comes from where the mean rays of all pictures
pass nearest (a joint that keeps its place), or from the floor under what touches it (the paper's step B). The turns are
anything: none, those that the marks tell if nearness is left out (:mod:`gonio.kernel.articulated.affine`), and random ones
up to half a turn. So large motions are solved without a guess.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.affine import affine_turns
from gonio.kernel.articulated.bundle import Sights
from gonio.kernel.articulated.motion import Motions
from gonio.records import JointKind

AFFINE_SETS = 4
"""So many sets of points tell two turns each to begin with."""

LOOSE: tuple[JointKind, ...] = ("free", "spherical")
"""The joints that may turn about any axis."""

HELD = 1e-2
"""How firmly a centre is held near its place: as by one ray that passes ten times as far off as the others."""


def middle_rays(sights: Sights) -> Float[np.ndarray, "picture 3"]:
    """Give the mean direction of each picture's marks; NaN in a picture that shows none."""
    d = np.where(sights.used[..., None], sights.rays(), 0.0).sum(axis=1)
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    return np.where(length > 0, d / np.where(length > 0, length, 1.0), np.nan)


def nearest_to_rays(o_m: Float[np.ndarray, "ray 3"], d: Float[np.ndarray, "ray 3"]) -> Float[np.ndarray, "3"]:
    """Give the point nearest to all rays; where they are parallel, the one of least norm. Rays of NaN don't count."""
    known = np.isfinite(d).all(axis=1)
    P = np.eye(3) - d[known, :, None] * d[known, None, :]
    return np.linalg.lstsq(P.sum(axis=0), (P @ o_m[known, :, None])[..., 0].sum(axis=0), rcond=None)[0]


def places(sights: Sights, kind: JointKind, depth_m: float | None) -> Float[np.ndarray, "picture 3"]:
    """Guess where the part is in each picture: all the same for a joint that keeps its place.

    For one that does not: the floor under its lowest mark where the picture shows one that touches it (step B), and else a
    place on the mean ray, as far away as in the reference picture; ``depth_m`` is the distance where nothing tells it. Before a
    camera that stands still it is the frame's origin (:func:`~gonio.kernel.articulated.chain.sights_of`).
    """
    d = middle_rays(sights)
    d = np.where(np.isfinite(d), d, d[sights.reference])
    meeting = np.zeros(3) if sights.still else nearest_to_rays(sights.o_m, d)
    if kind in ("spherical", "hinge"):
        ahead = ((meeting - sights.o_m) * d).sum(axis=1) > 0
        if ahead.all() or depth_m is None:
            return np.tile(meeting, (len(d), 1))
    rays = sights.rays()
    on_floor = sights.floor & sights.used
    found = np.full(len(d), np.nan)
    for i in range(len(d)):
        down = rays[i, on_floor[i]] @ sights.normal
        if len(down):
            far = (sights.offset_m - sights.o_m[i] @ sights.normal) / down
            found[i] = np.median(far)
    known = np.isfinite(found) & (found > 0)
    here = found[sights.reference] if known[sights.reference] else np.nan
    if not np.isfinite(here):
        guess = float((meeting - sights.o_m[sights.reference]) @ d[sights.reference])
        here = np.median(found[known]) if known.any() else guess if guess > 0 else (depth_m or 1.0)
    return sights.o_m + np.where(known, found, here)[:, None] * d


def random_starts(
    sights: Sights, kind: JointKind, at_m: Float[np.ndarray, "picture 3"], count: int, seed: int
) -> tuple[Motions, Float[np.ndarray, "start point 3"]]:
    """Give so many starts, the first without any turn; the points lie on their rays, all at the part's depth.

    The next few of a joint that turns about more than one axis have the turns that the marks tell by themselves.
    """
    rng = np.random.default_rng(seed)
    pictures, r = len(at_m), sights.reference
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    if kind == "planar":
        axis[:] = sights.normal
    angle = rng.uniform(-np.pi, np.pi, (count, pictures))
    own = rng.normal(size=(count, pictures, 3))
    own /= np.linalg.norm(own, axis=-1, keepdims=True)
    vector = angle[..., None] * (axis[:, None] if kind in ("hinge", "planar") else own)
    vector[::3] *= 0.3  # small turns are the commonest
    vector[0] = 1e-3 * vector[0]
    vector[:, r] = 0
    if kind == "prismatic":
        vector[:] = 0
    R = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(count, pictures, 3, 3)
    told, of_set = affine_turns(sights, AFFINE_SETS if kind in LOOSE else 0, rng)
    R[1 : 1 + len(told)] = told
    t = at_m - (R @ at_m[r])
    if kind == "planar":
        t = t - (t @ sights.normal)[..., None] * sights.normal
    if kind == "prismatic":
        line = t[0] - t[0, r]
        axis[: count // 2] = np.linalg.svd(line)[2][0]
        t = (t * axis[:, None]).sum(axis=-1, keepdims=True) * axis[:, None]
    motions = Motions(R, t, np.tile(at_m[r], (count, 1)), axis)
    x_m = _on_rays(sights, motions, at_m)
    if len(told):
        so = slice(1, 1 + len(told))
        better, x_m[so] = started_with(sights, kind, at_m, told, of_set)
        motions.centre[so], motions.t[so] = better.centre, better.t
    return motions, x_m


def started_with(
    sights: Sights,
    kind: JointKind,
    at_m: Float[np.ndarray, "picture 3"],
    R: Float[np.ndarray, "start picture 3 3"],
    of_set: Bool[np.ndarray, "start point"] | None = None,
) -> tuple[Motions, Float[np.ndarray, "start point 3"]]:
    """Give the starts that have these turns: a joint with a centre turns about the one that its points' rays tell.

    ``of_set`` says which points these are; all without it.
    """
    here_m = at_m[sights.reference]
    motions = Motions(R, at_m - R @ here_m, np.tile(here_m, (len(R), 1)), np.tile([0.0, 1.0, 0.0], (len(R), 1)))
    if kind != "spherical":
        return motions, _on_rays(sights, motions, at_m)
    whole = np.ones((len(R), sights.used.shape[1]), dtype=bool)
    centre, x_m = _about_centres(sights, R, whole if of_set is None else of_set, here_m)
    t = centre[:, None] - (R @ centre[:, None, :, None])[..., 0]
    return replace(motions, t=t, centre=centre), x_m


def _about_centres(
    sights: Sights, R: Float[np.ndarray, "start picture 3 3"], of_set: Bool[np.ndarray, "start point"],
    at_m: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "start 3"], Float[np.ndarray, "start point 3"]]:  # fmt: skip
    """Give the centre about which known turns bring a set of points onto their rays, and all points: linear least squares.

    Minimised is the sum of squares of the distances of ``R_i X_k + (I - R_i) c`` from the rays; the centre is held near
    ``at_m`` where nothing tells it.
    """
    d = np.nan_to_num(sights.rays())
    P = (np.eye(3) - d[..., :, None] * d[..., None, :]) * sights.used[..., None, None]
    loose = np.eye(3) - R
    o = (P @ sights.o_m[:, None, :, None])[..., 0]
    xx = np.einsum("siba,ikbc,sicd->skad", R, P, R, optimize=True) + 1e-4 * np.eye(3)
    xc = np.einsum("siba,ikbc,sicd->skad", R, P, loose, optimize=True)
    gx = np.einsum("siba,ikb->ska", R, o, optimize=True) + 1e-4 * at_m
    chosen = P[None] * of_set[:, None, :, None, None]
    cc = np.einsum("siba,sikbc,sicd->sad", loose, chosen, loose, optimize=True)
    gc = np.einsum("siba,ikb,sk->sa", loose, o, of_set * 1.0, optimize=True)
    inner = np.linalg.inv(xx)
    back = xc.swapaxes(-1, -2) @ inner * of_set[..., None, None]
    S = cc - (back @ xc).sum(axis=1) + HELD * np.eye(3)
    right = gc - (back @ gx[..., None])[..., 0].sum(axis=1) + HELD * at_m
    centre = np.linalg.solve(S, right[..., None])[..., 0]
    return centre, (inner @ (gx - (xc @ centre[:, None, :, None])[..., 0])[..., None])[..., 0]


def _on_rays(
    sights: Sights, motions: Motions, at_m: Float[np.ndarray, "picture 3"]
) -> Float[np.ndarray, "start point 3"]:
    """Put each point at its part's depth on its ray in the reference picture, or else in the first that shows it."""
    rays, r = sights.rays(), sights.reference
    x_m = np.empty((len(motions.t), sights.used.shape[1], 3))
    for k in range(x_m.shape[1]):
        seen = np.flatnonzero(sights.used[:, k])
        i = r if sights.used[r, k] or not len(seen) else seen[0]
        ahead = sights.R_cam[i, 2]
        depth = (at_m[i] - sights.o_m[i]) @ ahead
        y = sights.o_m[i] + rays[i, k] * depth / (rays[i, k] @ ahead) if len(seen) else at_m[i]
        x_m[:, k] = (motions.R[:, i].swapaxes(-1, -2) @ (y - motions.t[:, i])[..., None])[..., 0]
    return x_m
