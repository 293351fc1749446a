"""Hold the segments' lengths steady: bones don't stretch, so a track whose segments do is wrong by at least as much.

Each keypoint's track is estimated by itself. What is known beyond that, without any body model, is that the joints at both
ends of a segment keep their distance. So the points of each moment are corrected by what they owe to it: the most probable
points given the tracks, their covariances and the segments' usual lengths, which moves the uncertain end (an occluded wrist,
a depth that two cameras on one side can't tell) and leaves the certain one.
"""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from gonio.kernel.body.tree import Array
from gonio.kernel.optimize.banded import factorise, substitute
from gonio.kernel.parallel import over_blocks

LEAST_SPREAD = 0.03
"""How far a segment's length goes from its usual one at least: a standard deviation, as a share of it.

The ends are what a detector calls hip or wrist, not the joints' centres, and wander by some per cent as the limb turns. How
much, each trial tells by itself (:func:`_usual_lengths`); where errors hide it, it is taken to be this.
"""

FEWEST_FRAMES = 10
"""So many frames must know both ends for a usual length."""

ROUNDS = 4  # Gauss-Newton: a correction turns the segment a little

DOUBTFUL_SD = 3.0
"""A length that is off by more standard deviations says that an end is wrong by more than its covariance admits."""

BLOCK_FRAMES = 256


def hold_segments(
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"],
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"],
    ends: Int[np.ndarray, "segment 2"],
    least_spread: float = LEAST_SPREAD,
) -> tuple[Float[np.ndarray, "frame keypoint 3"], Float[np.ndarray, "frame keypoint 3 3"]]:
    """Correct points by the segments' lengths.

    Args:
        xyz_lab_m: Tracks; NaN is missing, and stays so.
        covariance_m2: Theirs.
        ends: The columns of the two keypoints of each segment. A segment's usual length is the median over the frames that
            know both; one that fewer than :data:`FEWEST_FRAMES` know is left alone.
        least_spread: The least standard deviation of a length, as a share of the usual one; more where the lengths vary by more
            than the covariances explain.

    One Kalman update a frame, with all segments at once and iterated since a length is not linear in the points [Bell &
    Cathey 1993]. The covariances stay as they were, though the points are nearer to the truth: much of a point's error is its
    cameras' constant one, and the usual length, which comes from the same points, has it too. Where a length is off by more
    than :data:`DOUBTFUL_SD`, those of both ends are enlarged by as much: it is not known which one is wrong.
    """
    usual_m, spread_m = _usual_lengths(xyz_lab_m, covariance_m2, ends, least_spread)
    held = np.isfinite(usual_m)
    xyz, covariance = xyz_lab_m.copy(), covariance_m2.copy()
    if held.any():
        columns = np.asarray(ends, dtype=np.int64)[held]

        def update(start: int, stop: int) -> None:
            _update_frames(xyz, covariance, columns, usual_m[held], spread_m[held], _reach(columns) + 1, start, stop)

        over_blocks(update, len(xyz), BLOCK_FRAMES)
    return xyz, covariance


def _usual_lengths(
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"],
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"],
    ends: Int[np.ndarray, "segment 2"],
    least_spread: float,
) -> tuple[Float[np.ndarray, " segment"], Float[np.ndarray, " segment"]]:
    """Give each segment's usual length and how far it truly goes from it; NaN where too few frames know it.

    The variance of the lengths is that of their errors and the segment's own; medians tell both of the ordinary frames.
    """
    usual_m, spread_m = np.full(len(ends), np.nan), np.full(len(ends), np.nan)
    for segment, (first, second) in enumerate(ends):
        along_m = xyz_lab_m[:, first] - xyz_lab_m[:, second]
        length_m = np.linalg.norm(along_m, axis=-1)
        error_m2 = np.einsum("fi,fij,fj->f", along_m, covariance_m2[:, first] + covariance_m2[:, second], along_m)
        known = np.isfinite(error_m2) & (length_m > 0)
        if known.sum() < FEWEST_FRAMES:
            continue
        usual_m[segment] = usual = np.median(length_m[known])
        variance_m2 = (1.4826 * np.median(np.abs(length_m[known] - usual))) ** 2
        own_m2 = variance_m2 - np.median(error_m2[known] / length_m[known] ** 2)
        spread_m[segment] = np.sqrt(max(own_m2, (least_spread * usual) ** 2))
    return usual_m, spread_m


def _reach(ends: Int[np.ndarray, "segment 2"]) -> int:
    """Give how many places in the list segments with a joint in common are apart, at most."""
    shared = (ends[:, None, :, None] == ends[None, :, None, :]).any(axis=(2, 3))
    first, second = np.nonzero(shared)
    return int(np.abs(first - second).max())


@njit(cache=True, nogil=True, error_model="numpy")
def _update_frames(
    xyz: Array, covariance: Array, ends: Array, usual_m: Array, spread_m: Array, width: int, start: int, stop: int
) -> None:
    """Correct the frames from ``start`` to ``stop`` in place; ``width`` is the band's of the lengths' covariance."""
    segments = len(ends)
    along, missing = np.zeros((segments, 3)), np.zeros(segments)
    band = np.zeros((segments, width))
    doubt = np.ones(xyz.shape[1])
    for frame in range(start, stop):
        x, x0, C = xyz[frame], xyz[frame].copy(), covariance[frame].copy()
        known = np.isfinite(x0[:, 0]) & np.isfinite(C[:, 0, 0])
        C[~known] = 0.0
        doubt[:] = 1.0
        for turn in range(ROUNDS):
            _linearise(x, x0, C, known, ends, usual_m, spread_m, along, missing, band)
            if turn == 0:
                for s in range(segments):
                    excess = missing[s] ** 2 / (band[s, 0] * DOUBTFUL_SD**2)
                    for end in range(2):
                        doubt[ends[s, end]] = max(doubt[ends[s, end]], excess)
            factorise(band)
            substitute(band, missing)
            x[:] = x0
            for s in range(segments):
                for i in range(3):
                    for j in range(3):
                        x[ends[s, 0], i] += C[ends[s, 0], i, j] * along[s, j] * missing[s]
                        x[ends[s, 1], i] -= C[ends[s, 1], i, j] * along[s, j] * missing[s]
        for k in range(len(x0)):
            covariance[frame, k] *= doubt[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise(  # noqa: PLR0913 - scratch arrays are arguments of compiled code
    x: Array, x0: Array, C: Array, known: Array, ends: Array, usual_m: Array, spread_m: Array,
    along: Array, missing: Array, band: Array,
) -> None:  # fmt: skip
    """Fill each segment's direction, what its length lacks at ``x0`` to first order, and the lengths' covariance.

    A segment of which an end is not known in this frame has no direction, lacks nothing and is alone in the band.
    """
    for s in range(len(ends)):
        a, b = ends[s]
        length_m = np.sqrt((x[a, 0] - x[b, 0]) ** 2 + (x[a, 1] - x[b, 1]) ** 2 + (x[a, 2] - x[b, 2]) ** 2)
        seen = known[a] and known[b] and length_m > 0.0
        missing[s] = usual_m[s] - length_m if seen else 0.0
        for i in range(3):
            along[s, i] = (x[a, i] - x[b, i]) / length_m if seen else 0.0
            if seen:
                missing[s] -= along[s, i] * ((x0[a, i] - x[a, i]) - (x0[b, i] - x[b, i]))
        for d in range(min(s + 1, band.shape[1])):
            band[s, d] = spread_m[s] ** 2 if d == 0 else 0.0
            for end in range(2):
                for its in range(2):
                    if ends[s, end] == ends[s - d, its]:
                        sign = 1.0 if end == its else -1.0
                        for i in range(3):
                            for j in range(3):
                                band[s, d] += sign * along[s, i] * C[ends[s, end], i, j] * along[s - d, j]
