"""Turns of a part from its marks alone: what the pictures of a small thing say if nearness is left out.

A part that is small against its distance is seen in nearly parallel rays. The marks of m points in n pictures, each picture's
mean taken away, are then of rank three, and the factors are the part's shape and the pictures' views of it [Tomasi & Kanade
1992]. Any 3 × 3 matrix between the factors fits; that a picture's two rows are of one length and square to each other leaves
a turn and one reflection: the part, or its mirror image with depth turned inside out (Necker's cube). It takes three
pictures, and four points that are not in one plane.

Such turns are off by what nearness does, ten degrees or so, however far the part turned: good to begin a descent with.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.articulated.bundle import Sights

THREES = 200
"""At most so many threes of pictures are compared for each step of a chain."""

DRAWS = 200
"""So many sets of points are drawn; those that fit parallel rays best are believed, because they hold no wrong mark."""

SET = 6
"""Points a set: four tell the turns, the others whether these are to be believed."""


def affine_turns(
    sights: Sights, sets: int, rng: np.random.Generator, *, size: int = SET
) -> tuple[Float[np.ndarray, "start picture 3 3"], Bool[np.ndarray, "start point"]]:
    """Give the turns against the reference picture by the best few sets of points, each with its mirror image, and the sets.

    The first set is all points that every picture shows. Where these are too few, the turns are those of a chain of threes of
    pictures, and the set is all points; none is given of two pictures.
    """
    pictures, points = sights.used.shape
    common = np.flatnonzero(sights.used.all(axis=0))
    if not sets or pictures < 3:
        return np.empty((0, pictures, 3, 3)), np.empty((0, points), dtype=bool)
    if len(common) < size:
        chained = _chained(sights, rng)
        return chained, np.ones((len(chained), points), dtype=bool)
    turns = _turns(sights, common[None])
    chosen = [common]
    if len(common) > size:
        drawn = common[np.argsort(rng.random((DRAWS, len(common))), axis=1)[:, :size]]
        xy, _ = _in_parallel_rays(sights, drawn)
        s = np.linalg.svd(xy, compute_uv=False)
        misfit = s[:, 3:].sum(axis=1) / np.maximum(s[:, 2], 1e-12)
        chosen += list(drawn[np.argsort(misfit)[: sets - 1]])
        turns = np.concatenate([turns, _turns(sights, np.array(chosen[1:]))])
    of_set = np.zeros((len(chosen), points), dtype=bool)
    for row, these in zip(of_set, chosen, strict=True):
        row[these] = True
    return turns, np.repeat(of_set, 2, axis=0)


def _chained(sights: Sights, rng: np.random.Generator) -> Float[np.ndarray, "start picture 3 3"]:
    """Give the turns of pictures that show different points, from threes that share some: each new one with two known ones.

    A three is worth its third singular value: many points, seen from directions that differ. Of a three's two turns that is
    taken which agrees with what is known; the first three's both begin a chain. None if a picture can't be reached.
    """
    pictures = len(sights.o_m)
    threes = np.array(list(combinations(range(pictures), 3)))
    worth, first = _best_three(sights, threes, rng)
    if worth == 0:
        return np.empty((0, pictures, 3, 3))
    begun = _turns_of_three(sights, first)
    known = {int(i): begun[:, at] for at, i in enumerate(first)}
    while len(known) < pictures:
        pairs = list(combinations(known, 2))
        threes = np.array([(*pair, new) for new in range(pictures) if new not in known for pair in pairs])
        worth, three = _best_three(sights, threes, rng)
        if worth == 0:
            return np.empty((0, pictures, 3, 3))
        a, b, new = (int(i) for i in three)
        turns = _turns_of_three(sights, three)
        step = turns[:, 1] @ turns[:, 0].swapaxes(-1, -2)
        had = known[b] @ known[a].swapaxes(-1, -2)
        agrees = np.einsum("sab,tab->st", had, step).argmax(axis=1)
        known[new] = (turns[:, 2] @ turns[:, 0].swapaxes(-1, -2))[agrees] @ known[a]
    R = np.stack([known[i] for i in range(pictures)], axis=1)
    return R @ R[:, sights.reference, None].swapaxes(-1, -2)


def _best_three(sights: Sights, threes: np.ndarray, rng: np.random.Generator) -> tuple[float, Int[np.ndarray, "3"]]:
    """Give the three of pictures that tells turns best, and its worth: 0 if none shares points enough."""
    shared = sights.used[threes].all(axis=1).sum(axis=1)
    able = threes[shared >= SET]
    best, worth = threes[0], 0.0
    for three in able[rng.permutation(len(able))[:THREES]]:
        xy, _ = _in_parallel_rays(sights.of_pictures(three), _shared(sights, three))
        s = float(np.linalg.svd(xy[0], compute_uv=False)[2])
        best, worth = (three, s) if s > worth else (best, worth)
    return worth, best


def _turns_of_three(sights: Sights, three: np.ndarray) -> Float[np.ndarray, "2 3 3 3"]:
    return _turns(sights.of_pictures(three), _shared(sights, three))


def _shared(sights: Sights, pictures: np.ndarray) -> np.ndarray:
    return np.flatnonzero(sights.used[pictures].all(axis=0))[None]


def _in_parallel_rays(
    sights: Sights, sets: np.ndarray
) -> tuple[Float[np.ndarray, "set coordinate point"], Float[np.ndarray, "set picture 3 3"]]:
    """Give the marks of each set, ``(set, point)``, across the ray to their middle, two rows a picture; and those frames."""
    d = sights.rays()[:, sets].swapaxes(0, 1)
    frame = _towards(d.mean(axis=2))
    e = d @ frame.swapaxes(-1, -2)
    xy = e[..., :2] / e[..., 2:]
    xy = xy - xy.mean(axis=2, keepdims=True)
    return xy.swapaxes(-1, -2).reshape(len(sets), 2 * len(sights.o_m), -1), frame


def _turns(sights: Sights, sets: np.ndarray) -> Float[np.ndarray, "start picture 3 3"]:
    """Give both turns of each set of points, ``(set, point)``, one after the other."""
    count, pictures = len(sets), len(sights.o_m)
    xy, frame = _in_parallel_rays(sights, sets)
    U, s, _ = np.linalg.svd(xy, full_matrices=False)
    views = (U[..., :3] * (s[:, None, :3] / s[:, None, :1])).reshape(count, pictures, 2, 3)
    views = views @ _upgrade(views)[:, None]
    ahead = np.cross(views[:, :, 0], views[:, :, 1])
    ahead /= np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-12)
    views = views / np.maximum(np.linalg.norm(views, axis=(2, 3), keepdims=True) / np.sqrt(2), 1e-12)
    u, _, v = np.linalg.svd(np.concatenate([views, ahead[:, :, None]], axis=2))
    seen = u @ v  # the part's turn before each camera, within a turn of the whole
    mirror = np.diag([1.0, 1.0, -1.0])
    both = np.stack([seen, mirror @ seen @ mirror], axis=1)
    placed = (frame.swapaxes(-1, -2)[:, None] @ both).reshape(2 * count, pictures, 3, 3)
    return placed @ placed[:, sights.reference, None].swapaxes(-1, -2)


def _towards(ahead: Float[np.ndarray, "set picture 3"]) -> Float[np.ndarray, "set picture 3 3"]:
    """Give a frame whose third row is the direction; the others are any two across it."""
    z = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    side = np.where(np.abs(z[..., 1:2]) < 0.9, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    x = np.cross(side, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def _upgrade(views: Float[np.ndarray, "set picture 2 3"]) -> Float[np.ndarray, "set 3 3"]:
    """Give the matrix A that makes each picture's rows, times A, equally long and square to each other.

    Linear in ``Q = A Aᵀ``; where noise makes Q no square, its negative part is cut off.
    """
    x, y = views[:, :, 0], views[:, :, 1]
    rows = np.concatenate([_quadratic(x, x) - _quadratic(y, y), 2 * _quadratic(x, y)], axis=1)
    size = (views**2).sum(axis=(2, 3))
    rows /= np.maximum(np.concatenate([size, size], axis=1)[..., None], 1e-12)
    q = np.linalg.svd(rows)[2][:, -1]
    Q = q[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(Q)
    values = values * np.where(values.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    values = np.maximum(values, 1e-3 * np.abs(values).max(axis=1, keepdims=True))
    return vectors * np.sqrt(values)[:, None]


def _quadratic(a: Float[np.ndarray, "*batch 3"], b: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 6"]:
    """Give the factors of ``aᵀ Q b`` by Q's elements xx, yy, zz, xy, xz, yz."""
    ax, ay, az = np.moveaxis(a, -1, 0)
    bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack([ax * bx, ay * by, az * bz, ax * by + ay * bx, ax * bz + az * bx, ay * bz + az * by], axis=-1)
