"""What the pictures can tell of a joint, and how well: covariance, and the names of what they can't.

The covariance is the inverse of the normal equations at the solution. A direction of the unknowns whose standard deviation is
beyond one radian or metre is not observed at all; which situation it is, is then read off the solution.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.kernel.articulated.bundle import Sights, camera_jacobian, dense_jacobian
from gonio.kernel.articulated.motion import Motions, twists_of
from gonio.records import JointKind

UNOBSERVED = 1.0
"""A standard deviation, radians or metres, beyond which a direction counts as not observed."""

STILL_RAD = 0.02
"""A part that turns less than this in all pictures does not move, as far as its centre is concerned."""

LINE = 0.06
"""Points lie on a line if their second principal extent is less than this share of the first."""

STATIC = 0.02
"""Where a joint can't be told, a camera whose centres spread by less than this share of the distance is to blame."""

REFUSALS = {
    "scale-unobservable": (
        "its size, and with it every shift, can't be told from these pictures",
        "Mark points that touch the floor, give the distance of two of its points, or move the camera up and down.",
    ),
    "camera-static": (
        "the camera stood still, so that the joint's distance can't be told",
        "Take the pictures from different places, zooming is not enough; or give the distance of two of its points.",
    ),
    "no-motion": (
        "it does not turn, so that its joint's place can't be told",
        "Add a picture in which the part is turned, or leave the joint out: it is one with its parent here.",
    ),
    "no-parallax": (
        "it turns about the line of sight of a camera that stood still, so that no depth can be told",
        "Take the pictures from different places.",
    ),
    "collinear-points": (
        "its points lie on one line, so that its turn about that line can't be told",
        "Mark points beside the line.",
    ),
    "too-few-points": (
        "too few of its points are seen in two pictures or more",
        "Mark six points or more, better ten, each in as many pictures as show it.",
    ),
    "length-unseen": (
        "a point of its known length is not seen in two pictures, or its marks were not believed",
        "Give the distance of two points that many pictures show.",
    ),
    "not-observable": (
        "its motion can't be told from these pictures",
        "Take pictures from more directions, or mark more points.",
    ),
}
"""Each refusal's code, its reason, and its remedy."""


def refuse(code: str, part: str) -> CaptureError:
    """Make the error by its code; its details name the part."""
    reason, remedy = REFUSALS[code]
    return CaptureError(f"Part {part}: {reason}.", hint=remedy, code=code, part=part)


@dataclass(frozen=True)
class Sensitivity:
    """The covariance of the joint's unknowns by the marks' noise, and how they follow what is given from outside.

    ``by_twist`` is by a twist of each picture that is applied to the part from outside, ``by_camera`` by the cameras' own
    unknowns, in the order camera, :data:`~gonio.records.UNKNOWNS`.
    """

    covariance: Float[np.ndarray, "unknown unknown"]
    points_covariance_m2: Float[np.ndarray, "point 3 3"]
    by_twist: Float[np.ndarray, "unknown twist"]
    by_camera: Float[np.ndarray, "unknown camera_unknown"]


def sensitivity(kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]) -> Sensitivity:
    """Invert the normal equations; a direction that nothing observes has a huge but finite variance."""
    J, Jx, Jt = dense_jacobian(kind, sights, motions, x_m)
    both = np.concatenate([J, Jx], axis=1)
    H = both.T @ both
    values, vectors = np.linalg.eigh(H)
    values = np.maximum(values, 1e-9)
    inverse = (vectors / values) @ vectors.T
    m = J.shape[1]
    points = np.stack([inverse[m + 3 * k : m + 3 * k + 3, m + 3 * k : m + 3 * k + 3] for k in range(x_m.shape[1])])
    gain = -(inverse @ both.T)[:m]
    return Sensitivity(inverse[:m, :m], points, gain @ Jt, gain @ camera_jacobian(sights, motions, x_m))


def check_moving_camera(kind: JointKind, sights: Sights, part: str, *, scale_known: bool) -> None:
    """Refuse a joint that keeps its place before a camera that does too, unless a known length tells its distance.

    If each picture's rays are those of the reference turned as a whole, the part turned about the line of sight, and not
    even its shape can be told.

    Raises:
        CaptureError: ``camera-static`` or ``no-parallax``.
    """
    if kind not in ("spherical", "hinge") or not sights.still:
        return
    rays, r = sights.rays(), sights.reference
    for i in range(len(rays)):
        both = sights.used[i] & sights.used[r]
        turn, miss = Rotation.align_vectors(rays[i, both], rays[r, both]) if both.sum() > 2 else (None, 0.0)
        if turn is not None and miss * sights.f_px.mean() / np.sqrt(2 * both.sum()) > 3 * sights.sigma_px:
            if scale_known:
                return
            raise refuse("camera-static", part)
    raise refuse("no-parallax", part)


def check_observed(
    kind: JointKind,
    sights: Sights,
    motions: Motions,
    x_m: Float[np.ndarray, "1 point 3"],
    found: Sensitivity,
    part: str,
    *,
    scale_known: bool = False,
) -> None:
    """Refuse a solution that has a direction which nothing observes; ``scale_known``: it has its size by a known length.

    Raises:
        CaptureError: One of :data:`REFUSALS`.
    """
    seen = x_m[0, sights.used.any(axis=0)]
    extent = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    if extent[1] < LINE * extent[0]:
        raise refuse("collinear-points", part)
    values = np.linalg.eigvalsh(found.covariance)
    if np.isfinite(values).all() and values.max() < UNOBSERVED**2:
        return
    raise refuse("not-observable" if scale_known else _situation(kind, sights, motions, seen.mean(axis=0)), part)


def _situation(kind: JointKind, sights: Sights, motions: Motions, middle_m: Float[np.ndarray, "3"]) -> str:
    largest = Rotation.from_matrix(motions.R[0]).magnitude().max()
    if kind in ("free", "planar", "prismatic"):
        return "scale-unobservable"
    if largest < STILL_RAD:
        return "no-motion"
    distance = np.linalg.norm(sights.o_m - middle_m, axis=1).min()
    return "camera-static" if np.ptp(sights.o_m, axis=0).max() < STATIC * distance else "not-observable"


def twist_covariance(
    kind: JointKind, motions: Motions, reference: int, covariance: Float[np.ndarray, "unknown unknown"]
) -> Float[np.ndarray, "twist twist"]:
    """Bring the covariance of the unknowns to the twists of all pictures."""
    B = twists_of(kind, motions, reference)[0].reshape(6 * motions.t.shape[1], -1)
    return B @ covariance @ B.T
