"""How each kind of joint may move: its unknowns, what a small change of them does to the part, and how to make the change.

All kinds share one language. A part's motion in picture i is ``Y = R_i x_m + t_i``; a small change of it is a twist ``(w, v)``
applied afterwards, ``dY = w × Y + v``. A kind says only which twists its unknowns can make (:func:`twists_of`), and how to
take a finite step (:func:`step`). The solver, the covariance and the test of what can be observed then know no kinds.

Everything is batched over starts, the leading axis. docs/derivations/articulated.md derives the formulas.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.records import JointKind


@dataclass(frozen=True)
class Motions:
    """A part's motion in all pictures, once a start: rotations, translations, and what the pictures share.

    ``centre`` is a spherical joint's centre or a point of a hinge's axis; ``axis`` that of a hinge, the line of a prismatic
    joint or, for a planar one, the fixed normal. The kinds that have none carry them along unused.
    """

    R: Float[np.ndarray, "start picture 3 3"]
    t: Float[np.ndarray, "start picture 3"]
    centre: Float[np.ndarray, "start 3"]
    axis: Float[np.ndarray, "start 3"]

    def pick(self, starts: np.ndarray) -> "Motions":
        """Keep some starts."""
        return Motions(self.R[starts], self.t[starts], self.centre[starts], self.axis[starts])

    def moved(self, x_m: Float[np.ndarray, "start point 3"]) -> Float[np.ndarray, "start picture point 3"]:
        """Give where the part's points are in each picture."""
        return x_m[:, None] @ self.R.swapaxes(-1, -2) + self.t[:, :, None]


OWN: dict[JointKind, int] = {"free": 6, "spherical": 3, "hinge": 1, "planar": 3, "prismatic": 1}
"""How many unknowns each picture has of its own."""

SHARED: dict[JointKind, int] = {"free": 0, "spherical": 3, "hinge": 4, "planar": 0, "prismatic": 2}
"""How many unknowns all pictures share: centre, or axis and point."""


def unknowns(kind: JointKind, pictures: int) -> int:
    """Count the unknowns of a joint: those of each picture but the reference, then the shared ones."""
    return OWN[kind] * (pictures - 1) + SHARED[kind]


def cross(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Give the matrix of ``v ×``."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape, 3)


def turn(w: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Give the rotation by the vector ``w``, radians."""
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape, 3)


def across(axis: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 2"]:
    """Give two unit vectors perpendicular to the axis and to each other, as columns."""
    # By hand, because numpy's cross product takes half of a descent's time on arrays this small.
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    o = np.zeros_like(x)
    upright = np.abs(x) >= 0.9
    # axis × e_y where the axis is near X, and axis × e_x elsewhere
    first = np.stack([np.where(upright, -z, o), np.where(upright, o, z), np.where(upright, x, -y)], axis=-1)
    first /= np.sqrt((first * first).sum(axis=-1, keepdims=True))
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    second = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)
    return np.stack([first, second], axis=-1)


def twists_of(kind: JointKind, motions: Motions, reference: int) -> Float[np.ndarray, "start picture 6 unknown"]:
    """Give the twist of each picture by each unknown; the reference's is zero.

    A shared centre moves the part by ``(I − R_i) dc``, a tilt ``phi`` of an axis by the turn ``(I − R_i) phi``.
    """
    starts, pictures = motions.t.shape[:2]
    moving = [i for i in range(pictures) if i != reference]
    B = np.zeros((starts, pictures, 6, unknowns(kind, pictures)))
    shared = B.shape[-1] - SHARED[kind]
    lever = cross(motions.centre)
    plane = across(motions.axis)
    for at, i in enumerate(moving):
        loose = np.eye(3) - motions.R[:, i]
        if kind == "free":
            B[:, i, :, 6 * at : 6 * at + 6] = np.eye(6)
        elif kind == "spherical":
            B[:, i, :3, 3 * at : 3 * at + 3] = np.eye(3)
            B[:, i, 3:, shared:] = loose
        elif kind == "hinge":
            B[:, i, :3, at] = motions.axis
            B[:, i, :3, shared : shared + 2] = loose @ plane
            B[:, i, 3:, shared + 2 :] = loose @ plane
        elif kind == "planar":
            B[:, i, :3, 3 * at] = motions.axis
            B[:, i, 3:, 3 * at + 1 : 3 * at + 3] = plane
        else:
            B[:, i, 3:, at] = motions.axis
            slid = (motions.t[:, i] * motions.axis).sum(axis=-1)
            B[:, i, 3:, shared:] = slid[:, None, None] * plane
    if kind in ("spherical", "hinge"):  # a turn about the centre is a turn about the origin and a shift
        B[:, :, 3:] += lever[:, None] @ B[:, :, :3]
    return B


def step(kind: JointKind, motions: Motions, change: Float[np.ndarray, "start unknown"], reference: int) -> Motions:
    """Change the unknowns by a finite step, along the twists of :func:`twists_of`."""
    starts, pictures = motions.t.shape[:2]
    moving = [i for i in range(pictures) if i != reference]
    each = OWN[kind]
    own = np.zeros((starts, pictures, each))
    own[:, moving] = change[:, : each * len(moving)].reshape(starts, -1, each)
    shared = change[:, each * len(moving) :]
    rotation, t, centre, axis = motions.R, motions.t, motions.centre, motions.axis
    plane = across(axis)
    if kind == "spherical":
        rotation, centre = turn(own) @ rotation, centre + shared
        t = centre[:, None] - (rotation @ centre[:, None, :, None])[..., 0]
    elif kind == "hinge":
        tilt = turn((plane @ shared[:, :2, None])[..., 0])
        rotation = tilt[:, None] @ turn(own * axis[:, None]) @ rotation @ tilt[:, None].swapaxes(-1, -2)
        centre, axis = centre + (plane @ shared[:, 2:, None])[..., 0], (tilt @ axis[..., None])[..., 0]
        t = centre[:, None] - (rotation @ centre[:, None, :, None])[..., 0]
    elif kind == "prismatic":
        slid = (t * axis[:, None]).sum(axis=-1) + own[..., 0]
        # The tangent (plane @ shared) is the axis's change itself: it turns about axis × change.
        axis = axis + (plane @ shared[..., None])[..., 0]
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        t = slid[..., None] * axis[:, None]
    else:
        w = own[..., :3] if kind == "free" else own[..., :1] * axis[:, None]
        v = own[..., 3:] if kind == "free" else (plane[:, None] @ own[..., 1:, None])[..., 0]
        dR = turn(w)
        rotation, t = dR @ rotation, (dR @ t[..., None])[..., 0] + v
    return Motions(rotation, t, centre, axis)
