"""What a calibration is worth on pictures that it was not made from: the board is rebuilt corner by corner and measured.

A board that is small and near hides a wrong focal length in its depth, and the error that a solution reports of itself hides
everything. So the recording is cut into alternating blocks: each half is solved alone and measures the other half's boards,
and the two solutions' distances between the cameras are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaincinv

from gonio.errors import CaptureError, SolverError
from gonio.kernel.calibration.board_motion import advance
from gonio.kernel.calibration.board_terms import DELAY
from gonio.kernel.calibration.rig import RigSolution, solve_part
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import align
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Board, BoardViews, Rig, record

FEWEST_CORNERS = 4
"""With three, the board that fits them best goes along with their noise."""

TRIMMED = 0.1
"""This share of the lengths at either end is left out of their means."""

BLOCKS = (6, 8, 10, 14)
"""The recording is cut into so many blocks; more only if a half of it would not hold the cameras together by itself."""


@record
class BoardErrors:
    """How well cameras measure a board: errors against its true squares, and among the cameras.

    Lengths are between neighbouring corners, ``length_rms_m`` their scatter. ``bias`` is their mean error as a share
    (without the tenth at either end), measured along the sides of the board that fits a frame's corners best: noise across
    a side makes its own length longer, by ``σ² / 2 l²`` a direction, and would pass for a wrong scale. ``anisotropy`` is
    how much more that is along the rows than down the columns. ``median_px`` and ``rms_px`` are the cameras' reprojection
    errors, ``camera_bias_px`` each camera's mean residual (NaN for one that shares no corner). ``noise_px`` is the corners'
    standard deviation per axis that the residuals show: two cameras leave a point one residual of four, so that theirs look
    half as large as those of many.
    """

    corners: int
    median_px: float
    rms_px: float
    noise_px: float
    camera_bias_px: Float[np.ndarray, "camera 2"]
    bias: float
    anisotropy: float
    length_rms_m: float


@record
class Halves:
    """Two solutions of alternating blocks of the recording, each measured on the other's pictures.

    ``pooled`` takes both together: every corner measured by the solution that had not seen it. ``baseline_rms`` is how
    much the distances between cameras differ between the two, as a share.
    """

    solutions: tuple[RigSolution, RigSolution]
    errors: tuple[BoardErrors, BoardErrors]
    pooled: BoardErrors
    baseline_rms: float


@dataclass(frozen=True)
class _Measured:
    """Errors of single corners and squares: reprojection in pixels, lengths as shares."""

    residual_px: Float[np.ndarray, "camera point 2"]
    across: Float[np.ndarray, " pair"]
    down: Float[np.ndarray, " pair_down"]
    lengths: Float[np.ndarray, " pair_all"]

    def summary(self, square_m: float) -> BoardErrors:
        across, down = self.across[np.isfinite(self.across)], self.down[np.isfinite(self.down)]
        error_px = np.linalg.norm(self.residual_px, axis=-1)
        seen = np.isfinite(error_px)
        every, lengths = np.concatenate([across, down]), self.lengths[np.isfinite(self.lengths)]
        total = np.where(seen[..., None], self.residual_px, 0.0).sum(axis=1)
        known = bool(len(across) and len(down))
        return BoardErrors(
            corners=int(seen.any(axis=0).sum()),
            median_px=float(np.median(error_px[seen])) if known else np.nan,
            rms_px=float(np.sqrt((error_px[seen] ** 2).mean())) if known else np.nan,
            noise_px=_noise_px(self.residual_px, seen) if known else np.nan,
            camera_bias_px=total / np.where(seen.any(axis=1), seen.sum(axis=1), np.nan)[:, None],
            bias=_middle(every) if known else np.nan,
            anisotropy=_middle(across) - _middle(down) if known else np.nan,
            length_rms_m=float(np.sqrt((lengths**2).mean())) * square_m if known else np.nan,
        )


def _middle(values: Float[np.ndarray, " value"]) -> float:
    """Give the mean without the tenth at either end: one corner two pixels off is a tenth of a small square."""
    cut = int(TRIMMED * len(values))
    return float(np.sort(values)[cut : len(values) - cut].mean())


def measure_boards(
    views: BoardViews, rig: Rig, delay_s: Float[np.ndarray, " camera"], frames: Int[np.ndarray, " chosen"]
) -> BoardErrors:
    """Triangulate each corner of some frames from all cameras, delays taken out, and compare with the board.

    Nothing of the board's shape goes into it. Corners that fewer than two cameras see are left out.

    Args:
        views: Where the cameras saw the board.
        rig: The cameras of the views, in their order.
        delay_s: By how much each runs late.
        frames: The frames to measure.
    """
    return _measure(views, rig, delay_s, frames).summary(views.board.square_m)


def _measure(
    views: BoardViews, rig: Rig, delay_s: Float[np.ndarray, " camera"], frames: Int[np.ndarray, " chosen"]
) -> _Measured:
    # Neighbours in time may lie outside the chosen frames: they only tell of motion.
    uv_px = advance(views.uv_px, views.times_s, delay_s)[:, frames]
    ideal = undistort_rig(rig, uv_px).reshape(len(rig.cameras), -1, 2)
    seen = np.isfinite(ideal[..., 0]).astype(float)
    solved = triangulate(projection_matrices(rig), focal_lengths_px(rig), ideal, seen, method="reprojection")
    xyz = solved.xyz_lab_m.reshape(len(frames), -1, 3)
    sides = [xyz[:, pairs[:, 1]] - xyz[:, pairs[:, 0]] for pairs in views.board.neighbours]
    directions = _directions(xyz, views.board)
    square_m = views.board.square_m
    across, down = (
        (np.einsum("fpi,fi->fp", side, directions[:, axis]) / square_m - 1).ravel() for axis, side in enumerate(sides)
    )
    lengths = np.concatenate([(np.linalg.norm(side, axis=-1) / square_m - 1).ravel() for side in sides])
    return _Measured(solved.residual_px, across, down, lengths)


def _directions(xyz_lab_m: Float[np.ndarray, "frame corner 3"], board: Board) -> Float[np.ndarray, "frame 2 3"]:
    """Give the directions of rows and columns of the board that fits each frame's corners best; NaN with too few corners."""
    found = np.full((len(xyz_lab_m), 2, 3), np.nan)
    for frame, xyz in enumerate(xyz_lab_m):
        seen = np.isfinite(xyz[:, 0])
        places = board.corners_board_m[seen]
        if seen.sum() >= FEWEST_CORNERS and np.linalg.matrix_rank(places[:, :2] - places[0, :2]) == 2:
            found[frame] = align(places, xyz[seen])[:3, :2].T
    return found


def _noise_px(residual_px: Float[np.ndarray, "camera point 2"], seen: Bool[np.ndarray, "camera point"]) -> float:
    """Give the corners' standard deviation per axis, from points that n cameras see: ``Σ r² / σ²`` has 2 n − 3 freedoms.

    By each count's median, for which a chi-squared variable's is taken, ``2 P⁻¹(freedoms / 2, 1/2)`` with the regularized
    gamma function P: some corners may be misread altogether. (``scipy.stats`` has it, too, and is slow to load.)
    """
    counts = seen.sum(axis=0)
    squared = np.where(seen, (residual_px**2).sum(axis=-1), 0.0).sum(axis=0)
    shared = counts >= 2
    freedom = 2 * counts[shared] - 3
    return (
        float(np.sqrt(np.median(squared[shared] / (2.0 * gammaincinv(freedom / 2.0, 0.5))))) if shared.any() else np.nan
    )


def solve_halves(views: BoardViews, solution: RigSolution) -> Halves | None:
    """Solve both halves of a recording and measure each on the other; None where no half can be solved alone.

    Args:
        views: The whole recording.
        solution: The solution of the whole: its cameras and frames are those that are compared.
    """
    chosen = some_cameras(views, solution.cameras)
    for count in BLOCKS:
        halves = split_blocks(solution.frames, count)
        try:
            first, second = (solve_part(chosen, solution, half) for half in halves)
        except (CaptureError, SolverError):
            continue
        if first.adjusted.converged and second.adjusted.converged:
            return _compare(chosen, (first, second), halves)
    return None


def split_blocks(frames: Int[np.ndarray, " frame"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut frames into blocks, and give every other one, and the rest."""
    blocks = np.array_split(frames, count)
    return np.concatenate(blocks[::2]), np.concatenate(blocks[1::2])


def _compare(
    views: BoardViews, solutions: tuple[RigSolution, RigSolution], halves: tuple[np.ndarray, np.ndarray]
) -> Halves:
    rigs = [Rig(cameras=solution.lenses(views), source="") for solution in solutions]
    delays_s = [solution.scene.theta[:, DELAY] for solution in solutions]
    measured = _measure(views, rigs[0], delays_s[0], halves[1]), _measure(views, rigs[1], delays_s[1], halves[0])
    together = _Measured(
        residual_px=np.concatenate([m.residual_px for m in measured], axis=1),
        across=np.concatenate([m.across for m in measured]),
        down=np.concatenate([m.down for m in measured]),
        lengths=np.concatenate([m.lengths for m in measured]),
    )
    square_m = views.board.square_m
    a, b = map(baselines_m, rigs)
    return Halves(
        solutions=solutions,
        errors=(measured[0].summary(square_m), measured[1].summary(square_m)),
        pooled=together.summary(square_m),
        baseline_rms=disagreement(a, b),
    )


def baselines_m(rig: Rig) -> Float[np.ndarray, " pair"]:
    """Give the distances between all pairs of cameras."""
    centres = np.stack([camera.centre_lab_m for camera in rig.cameras])
    i, j = np.triu_indices(len(centres), 1)
    return np.linalg.norm(centres[i] - centres[j], axis=1)


def disagreement(one: Float[np.ndarray, " pair"], other: Float[np.ndarray, " pair"]) -> float:
    """Give the root mean square difference of two sets of lengths, as a share."""
    return float(np.sqrt(np.mean((2 * (one - other) / (one + other)) ** 2)))


def some_cameras(views: BoardViews, cameras: Sequence[int]) -> BoardViews:
    """Give the recording of a part of the cameras."""
    return replace(
        views,
        camera_names=tuple(views.camera_names[c] for c in cameras),
        image_sizes_px=tuple(views.image_sizes_px[c] for c in cameras),
        uv_px=views.uv_px[list(cameras)],
    )
