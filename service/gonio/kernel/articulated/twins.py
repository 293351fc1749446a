"""The twin of a picture that shows a part's points in one plane: tilted the other way, they look nearly the same.

With v the line of sight and n the plane's normal in the part, ``R' = (I - 2 v vᵀ) R (I - 2 n nᵀ)`` is a turn again, under which
the plane's points lie as deep behind their middle as they lay before it: in parallel rays the picture is the same.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.kernel.articulated.bundle import Sights
from gonio.kernel.articulated.motion import Motions
from gonio.records import JointKind

FLAT = 0.2
"""Points whose third principal extent is below this share of the second are nearly in one plane."""


def twin_starts(
    kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]
) -> tuple[Motions, Float[np.ndarray, "start point 3"]] | None:
    """Give the twin in each picture whose believed points are nearly in one plane; None if there is no such picture."""
    found = [_twin(kind, sights, motions, x_m[0], i) for i in range(len(sights.o_m)) if _flat(sights, x_m[0], i)]
    if not found:
        return None
    fields = [np.concatenate(each) for each in zip(*(vars(twin).values() for twin, _ in found), strict=True)]
    return Motions(*fields), np.stack([x for _, x in found])


def _flat(sights: Sights, x_m: Float[np.ndarray, "point 3"], picture: int) -> bool:
    seen = x_m[sights.used[picture]]
    if len(seen) < 3:
        return False
    extent = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    return bool(extent[2] < FLAT * extent[1])


def _twin(
    kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "point 3"], i: int
) -> tuple[Motions, Float[np.ndarray, "point 3"]]:
    seen = x_m[sights.used[i]]
    middle = seen.mean(axis=0)
    turns, t = motions.R[0], motions.t[0]
    n = np.linalg.svd(seen - middle)[2][2]
    v = turns[i] @ middle + t[i] - sights.o_m[i]
    v /= np.linalg.norm(v)
    other = (np.eye(3) - 2 * np.outer(v, v)) @ turns[i] @ (np.eye(3) - 2 * np.outer(n, n))
    # A joint that keeps its place turns about it; anything else about the points that are seen.
    about, to = (motions.centre[0],) * 2 if kind == "spherical" else (middle, turns[i] @ middle + t[i])
    shift = to - other @ about
    if i != sights.reference:
        turns, t = turns.copy(), t.copy()
        turns[i], t[i] = other, shift
    else:  # the part's frame is this picture's: it is the others that turn against it
        x_m = x_m @ other.T + shift
        turns = turns @ other.T
        t = t - turns @ shift
        turns[i], t[i] = np.eye(3), 0.0
    return replace(motions, R=turns[None], t=t[None]), x_m
