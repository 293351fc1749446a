"""Find two cameras whose videos were exchanged: a person seen through the wrong calibration meets nobody.

Each pair of cameras is exchanged for trial. Only where the cameras disagree by far as they are, and agree as a good rig does
after one exchange, are that pair's videos taken to be exchanged.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.triangulation.points import triangulate
from gonio.records import ImagePoints, Rig, record

MOST_FRAMES = 60
"""Frames that are looked at: the disagreement of exchanged cameras is hundreds of millimetres in every one of them."""

DISAGREEMENT_M = 0.10
"""Cameras as they are must miss each other by more than this. A calibration that has drifted by a degree is off by 70 mm."""

LARGEST_REST = 1 / 3
"""What may remain of the disagreement once the right pair is exchanged; then it must also be below the limit above."""

AS_GOOD = 1.5
"""Another exchange whose disagreement is within this factor of the best one's explains the recording as well."""


@record
class Exchange:
    """Two cameras, by their positions in the rig, and the median disagreement in the lab as they are and exchanged.

    In a rig that is symmetric, another exchange may explain as much; ``pairs`` holds all that do, the best one first.
    """

    pairs: tuple[tuple[int, int], ...]
    miss_before_m: float
    miss_after_m: float


def find_exchange(rig: Rig, keypoints: ImagePoints, min_confidence: float) -> Exchange | None:
    """Find the two cameras whose videos stand under each other's name; None if all are right, or if it can't be told.

    Two cameras of a rig that a half turn maps onto each other can be exchanged without any consequence, and are not found.
    With more than two exchanged no single exchange helps, and nothing is found either.

    Args:
        rig: The calibrated cameras.
        keypoints: The person's keypoints, each camera's as its name says.
        min_confidence: Keypoints below it are not looked at.
    """
    looked_at = np.flatnonzero((keypoints.confidence >= min_confidence).any(axis=2).sum(axis=0) >= 2)
    chosen = looked_at[:: max(1, len(looked_at) // MOST_FRAMES)]
    uv_px = keypoints.uv_px[:, chosen]
    weight = np.where(keypoints.confidence >= min_confidence, keypoints.confidence, 0.0)[:, chosen]
    before_m = _median_miss_m(rig, uv_px, weight)
    if not before_m > DISAGREEMENT_M:
        return None
    trials: list[tuple[float, tuple[int, int]]] = []
    for a, b in combinations(range(len(rig.cameras)), 2):
        order = np.arange(len(rig.cameras))
        order[[a, b]] = b, a
        trials.append((_median_miss_m(rig, uv_px[order], weight[order]), (a, b)))
    after_m = min(trials)[0]
    if after_m > min(DISAGREEMENT_M, LARGEST_REST * before_m):
        return None
    pairs = tuple(pair for miss_m, pair in sorted(trials) if miss_m < AS_GOOD * after_m)
    return Exchange(pairs=pairs, miss_before_m=before_m, miss_after_m=after_m)


def _median_miss_m(
    rig: Rig, uv_px: Float[np.ndarray, "camera frame keypoint 2"], weight: Float[np.ndarray, "camera frame keypoint"]
) -> float:
    """Give the median reprojection error in the lab by least squares: no camera can be voted down in it.

    A point behind a camera counts as infinitely far off; NaN if nothing was seen by two cameras.
    """
    cameras = len(rig.cameras)
    projections, focal_px = projection_matrices(rig), focal_lengths_px(rig)
    seen = weight.reshape(cameras, -1)
    pixels = undistort_rig(rig, uv_px).reshape(cameras, -1, 2)
    solved = triangulate(projections, focal_px, pixels, seen, method="reprojection")
    depth_m = projections[:, 2, :3] @ solved.xyz_lab_m.T + projections[:, 2, 3:]
    miss_m = np.linalg.norm(solved.residual_px, axis=-1) * depth_m / focal_px[:, None]
    shared = (seen > 0) & ((seen > 0).sum(axis=0) >= 2)
    return float(np.median(np.where(np.isfinite(miss_m), miss_m, np.inf)[shared])) if shared.any() else np.nan
