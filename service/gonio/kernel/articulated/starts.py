"""Where the search for a joint's motion begins: no start is trusted, so there are many.

The part is small and stands somewhere on the mean ray of its marks; its depth comes from where the mean rays of all pictures
pass nearest (a joint that keeps its place), or from the floor under what touches it (the paper's step B). The turns are
anything: none, and random ones up to half a turn, which is what makes large motions solvable without a guess.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.bundle import Sights
from gonio.kernel.articulated.motion import Motions
from gonio.records import JointKind


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
    place on the mean ray, as far away as in the reference picture; ``depth_m`` is the distance where nothing tells it.
    """
    d = middle_rays(sights)
    d = np.where(np.isfinite(d), d, d[sights.reference])
    meeting = nearest_to_rays(sights.o_m, d)
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
    """Give so many starts, the first without any turn; the points lie on their rays, all at the part's depth."""
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
    t = at_m - (R @ at_m[r])
    if kind == "planar":
        t = t - (t @ sights.normal)[..., None] * sights.normal
    if kind == "prismatic":
        line = t[0] - t[0, r]
        axis[: count // 2] = np.linalg.svd(line)[2][0]
        t = (t * axis[:, None]).sum(axis=-1, keepdims=True) * axis[:, None]
    motions = Motions(R, t, np.tile(at_m[r], (count, 1)), axis)
    return motions, _on_rays(sights, motions, at_m)


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
