"""Find what stands still in photographs of one scene: points that look the same in two pictures or more.

SIFT [Lowe 2004] with the ratio test both ways; matches of pairs of pictures are joined into tracks. Which of them move with
the object is not told here: what the geometry of the cameras does not explain is thrown out there.
"""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gonio.vision.stills import Grey

RATIO = 0.75
"""A match is believed if the second best is so much worse [Lowe 2004, §7.1]."""

MOST = 1500
"""So many features a picture are looked at, the strongest."""

TRACKS = 250
"""So many points are kept, those that most pictures show: more tell little more of a few cameras."""

LONGEST_PX = 1600
"""Longer pictures are made smaller for the search: features of a finer grain do not survive a change of view anyway."""


def find_background(
    pictures: Sequence[Grey], still: Sequence[Bool[np.ndarray, "height width"]]
) -> Float[np.ndarray, "picture point 2"]:
    """Find points that two pictures or more share, as pixels; NaN where one is not found.

    Args:
        pictures: The photographs.
        still: Where each shows what may be background: elsewhere nothing is looked for.
    """
    found = [_features(grey, mask) for grey, mask in zip(pictures, still, strict=True)]
    offsets = np.cumsum([0, *(len(uv) for uv, _ in found)])
    links = [_matches(found[i][1], found[j][1]) + offsets[[i, j]] for i, j in combinations(range(len(found)), 2)]
    pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *links])
    total = int(offsets[-1])
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    picture = np.searchsorted(offsets, np.arange(total), side="right") - 1
    uv_all = np.concatenate([uv for uv, _ in found])
    tracks = np.full((len(pictures), int(label.max(initial=-1)) + 1, 2), np.nan)
    count = np.zeros(tracks.shape[:2], dtype=np.int64)
    np.add.at(count, (picture, label), 1)
    tracks[picture, label] = uv_all
    # A track that has two places in one picture is wrong somewhere.
    good = (count.max(axis=0) == 1) & (count.sum(axis=0) >= 2) if total else np.zeros(0, dtype=bool)
    chosen = np.flatnonzero(good)
    order = np.argsort(-count[:, chosen].sum(axis=0) + np.random.default_rng(0).random(len(chosen)))
    return tracks[:, chosen[order[:TRACKS]]]


def _features(grey: Grey, still: Bool[np.ndarray, "height width"]) -> tuple[np.ndarray, np.ndarray]:
    scale = min(1.0, LONGEST_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    mask = cv2.resize(still.astype(np.uint8) * 255, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_NEAREST)
    points, words = cv2.SIFT.create(nfeatures=MOST).detectAndCompute(small, mask)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    uv = np.array([point.pt for point in points])
    _, first = np.unique(uv.round(2), axis=0, return_index=True)  # one place may have two orientations: keep one
    uv, words = uv[first], np.asarray(words)[first]
    # Pixel centres: resizing maps (u + ½) to scale · (u + ½).
    return (uv + 0.5) / scale - 0.5, words


def _matches(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    there, back = _best(first, second), _best(second, first)
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    return np.array(mutual, dtype=np.int64).reshape(-1, 2)


def _best(first: np.ndarray, second: np.ndarray) -> dict[int, int]:
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    return {a.queryIdx: a.trainIdx for a, b in pairs if a.distance < RATIO * b.distance}
