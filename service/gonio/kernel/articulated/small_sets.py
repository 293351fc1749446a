"""Answers from few points: where wrong marks pull every answer that takes all marks, a set that holds none is right.

Sets of points whose marks fit parallel rays best (:mod:`gonio.kernel.articulated.affine`) are solved by themselves; those
that come out with small errors have no wrong mark, and their motion tells which marks of the other points are right.
"""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Float

from gonio.kernel.articulated.affine import affine_turns
from gonio.kernel.articulated.bundle import Sights, adjust, whitened
from gonio.kernel.articulated.motion import Motions, unknowns
from gonio.kernel.articulated.starts import LOOSE, started_with
from gonio.records import JointKind

SETS, SIZE = 12, 5
"""So many sets of so many points: eight wrong marks in a hundred leave one set of twenty marks in five clean."""

STEPS = 15
TRIED = 6
"""So many sets that come out well are followed."""

WELL = 4.0
"""A set whose loss is below this multiple of what its freedoms make of the expected noise has come out well."""

CUT_PX = 5.0
"""A mark that is further off counts no more."""

PAIRS = 30
"""At most so many pairs of pictures are asked where a point is."""


def answers_of_sets(
    kind: JointKind, sights: Sights, at_m: Float[np.ndarray, "picture 3"], seed: int
) -> Iterator[tuple[Motions, Float[np.ndarray, "1 point 3"]]]:
    """Give the motion of each set that comes out well, with all points placed where most of their marks say."""
    if kind not in LOOSE or sights.used.all(axis=0).sum() <= SIZE:
        return
    turns, of_set = affine_turns(sights, SETS + 1, np.random.default_rng(seed), size=SIZE)
    pictures, given = len(sights.o_m), 0
    expected = 2 * SIZE * pictures - 3 * SIZE - unknowns(kind, pictures)
    for two in range(2, len(turns), 2):
        few = sights.of_points(of_set[two])
        motions, x_m = started_with(few, kind, at_m, turns[two : two + 2])
        motions, x_m, cost = adjust(kind, few, motions, x_m, iterations=STEPS, settled=1e-3)
        best = np.array([int(np.argmin(cost))])
        if cost[best[0]] < WELL * max(expected, 1) and given < TRIED:
            given += 1
            yield motions.pick(best), _where_most_say(sights, motions.pick(best))


def _where_most_say(sights: Sights, motions: Motions) -> Float[np.ndarray, "1 point 3"]:
    """Put each point where the rays of those two pictures meet that the others agree with best."""
    R, t = motions.R[0], motions.t[0]
    o = ((sights.o_m - t)[:, None] @ R)[:, 0]
    d = np.nan_to_num(sights.rays()) @ R
    pictures = range(len(o))
    pairs = np.array(list(combinations(pictures, 2)))
    if len(pairs) > PAIRS:
        pairs = pairs[np.random.default_rng(0).permutation(len(pairs))[:PAIRS]]
    i, j = pairs.T
    w, b = (o[i] - o[j])[:, None], (d[i] * d[j]).sum(axis=-1)
    along_i, along_j = (d[i] * w).sum(axis=-1), (d[j] * w).sum(axis=-1)
    apart = np.maximum(1 - b * b, 1e-9)
    at_i = o[i][:, None] + ((b * along_j - along_i) / apart)[..., None] * d[i]
    at_j = o[j][:, None] + ((along_j - b * along_i) / apart)[..., None] * d[j]
    X = (at_i + at_j) / 2
    r, _ = whitened(sights.with_noise(1.0), motions.pick(np.zeros(len(pairs), dtype=int)).moved(X))
    off = np.minimum(np.hypot(r[..., 0], r[..., 1]), CUT_PX).sum(axis=1)
    off = np.where(sights.used[i] & sights.used[j], off, np.inf)
    return np.take_along_axis(X, np.argmin(off, axis=0)[None, :, None], axis=0)
