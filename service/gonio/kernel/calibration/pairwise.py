"""How the cameras stand to each other, from pairs of them that see the board at the same time: the start of everything.

Each common picture of a pair gives up to four candidates for their relative pose, because a flat board has two in each
camera; the one that explains the pair's other pictures best is taken. A spanning tree of the best pairs, or the chain
1-2, 2-3, 3-4 of the paper that gonio follows, then leads every camera back to the first. On the way along the tree each
camera is placed by all pictures that it shares with those before it, not by its own pair's alone.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from gonio.errors import CaptureError
from gonio.kernel.calibration.board_terms import score_boards
from gonio.kernel.calibration.planar_pose import BoardPoses, locate_board
from gonio.kernel.geometry.transforms import inverse
from gonio.records import Camera, record

Method = Literal["tree", "chain"]

CLIPPED_PX = 30.0
"""An error beyond this says only that a candidate is wrong, not how wrong."""

FLOOR_PX = 0.3
MIN_COMMON_VIEWS = 3
FEW_VIEWS_COST = 10.0
"""A pair with one or two common pictures may agree perfectly on a wrong pose: it is used only if nothing else connects."""

TRIAL_FRAMES = 40
"""More pictures than these are not tried as candidates: they are spread over the recording."""

HEAT_FRAMES, FINALISTS = 24, 32
"""All candidates are tried on so many pictures first, and so many of them then on all."""


@record
class Pair:
    """Two cameras' relative pose as the pictures that both have tell it; ``error_px`` in the second camera."""

    first: int
    second: int
    T_second_first: Float[np.ndarray, "4 4"]
    error_px: float
    common_views: int

    @property
    def cost(self) -> float:
        """What it costs to rely on this pair: its error, less the more pictures agree on it."""
        few = FEW_VIEWS_COST if self.common_views < MIN_COMMON_VIEWS else 0.0
        return (self.error_px + FLOOR_PX) / np.sqrt(self.common_views) + few


@record
class Arrangement:
    """All cameras and board poses in the first connected camera's frame (``ref``), before bundle adjustment.

    ``connected`` says which cameras belong to it; the poses of the others are NaN, as are those of frames that no connected
    camera can place. ``pairs`` are the edges that were used, ``views`` the pictures of each camera that have a pose.
    """

    Ts_cam_ref: Float[np.ndarray, "camera 4 4"]
    Ts_ref_board: Float[np.ndarray, "frame 4 4"]
    connected: Bool[np.ndarray, " camera"]
    pairs: tuple[Pair, ...]
    views: tuple[int, ...]


@dataclass(frozen=True)
class _Sights:
    """What the cameras see: their optics, the board, its corners and its poses in each of them."""

    cameras: tuple[Camera, ...]
    corners_board_m: Float[np.ndarray, "corner 3"]
    uv_px: Float[np.ndarray, "camera frame corner 2"]
    poses: tuple[BoardPoses, ...]

    def errors_px(self, camera: int, T_cam_board: Float[np.ndarray, "*batch frame 4 4"]) -> np.ndarray:
        """Give the rms reprojection error in a camera of boards posed otherwise, clipped; NaN where it sees none."""
        lens = self.cameras[camera]
        K = lens.intrinsic_px
        theta = np.array([K[0, 0], K[1, 1] / K[0, 0], K[0, 2], K[1, 2], *lens.distortion, 0.0])
        batch = int(np.prod(T_cam_board.shape[:-3]))
        poses = np.ascontiguousarray(T_cam_board.reshape(batch, *T_cam_board.shape[-3:]))
        rms_px = np.empty(poses.shape[:2])
        score_boards(theta, poses, self.corners_board_m, np.ascontiguousarray(self.uv_px[camera]), CLIPPED_PX, rms_px)
        return rms_px.reshape(T_cam_board.shape[:-2])


def arrange(
    cameras: tuple[Camera, ...],
    corners_board_m: Float[np.ndarray, "corner 3"],
    uv_px: Float[np.ndarray, "camera frame corner 2"],
    method: Method = "tree",
) -> Arrangement:
    """Place the cameras and boards roughly; the cameras' own poses play no part.

    Args:
        cameras: Their optics.
        corners_board_m: The board's corners.
        uv_px: Where each camera saw them at the same instants, NaN where it didn't.
        method: ``tree`` goes over the most reliable pairs, ``chain`` over neighbours only: 1-2, 2-3, 3-4.

    Raises:
        CaptureError: ``cameras-unconnected``: no two cameras saw the board at the same time, or the chain is broken.
    """
    poses = tuple(locate_board(camera, corners_board_m, uv) for camera, uv in zip(cameras, uv_px, strict=True))
    sights = _Sights(cameras, corners_board_m, uv_px, poses)
    count = len(cameras)
    couples = [(i, j) for i in range(count) for j in range(i + 1, count) if method == "tree" or j == i + 1]
    pairs = {(i, j): pair for i, j in couples if (pair := _relate(sights, i, j)) is not None}
    if method == "chain" and len(pairs) < count - 1:
        broken = next((i, i + 1) for i in range(count - 1) if (i, i + 1) not in pairs)
        raise unconnected(f"cameras {cameras[broken[0]].name} and {cameras[broken[1]].name}")
    Ts_cam_ref, used = _spread_out(sights, pairs, method)
    connected = np.isfinite(Ts_cam_ref[:, 0, 0])
    if connected.sum() < min(2, count):
        raise unconnected("any two cameras")
    return Arrangement(
        Ts_cam_ref=Ts_cam_ref,
        Ts_ref_board=_place_boards(sights, Ts_cam_ref),
        connected=connected,
        pairs=used,
        views=tuple(int(p.known.sum()) for p in poses),
    )


def pose_in_rig(
    cameras: tuple[Camera, ...],
    Ts_cam_ref: Float[np.ndarray, "camera 4 4"],
    corners_board_m: Float[np.ndarray, "corner 3"],
    uv_px: Float[np.ndarray, "camera frame corner 2"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Pose boards roughly among cameras whose poses are known: ``T_ref_board``, NaN where no camera sees enough of one."""
    poses = tuple(locate_board(camera, corners_board_m, uv) for camera, uv in zip(cameras, uv_px, strict=True))
    return _place_boards(_Sights(cameras, corners_board_m, uv_px, poses), Ts_cam_ref)


def unconnected(who: str) -> CaptureError:
    """Say that cameras can't be put together because they never saw the board at the same time."""
    return CaptureError(
        f"The board was never seen by {who} at the same time.",
        hint="Film the board where the pictures overlap: two neighbouring cameras must see it at once, ten times or more.",
        code="cameras-unconnected",
    )


def _relate(sights: _Sights, first: int, second: int) -> Pair | None:
    """Find the relative pose of two cameras that their common pictures agree on; None without common pictures."""
    found = _attach(sights, sights.poses[first].T_cam_board, second)
    if found is None:
        return None
    T, error_px, common = found
    return Pair(first=first, second=second, T_second_first=T, error_px=error_px, common_views=common)


def _attach(
    sights: _Sights, Ts_ref_board: Float[np.ndarray, "frame option 4 4"], camera: int
) -> tuple[np.ndarray, float, int] | None:
    """Place a camera among boards that each have several possible poses (NaN: none).

    Gives ``T_cam_ref``, its error, and the number of pictures behind it; None where the camera sees none of the boards.
    """
    own = sights.poses[camera].T_cam_board
    common = np.flatnonzero(np.isfinite(Ts_ref_board[..., 0, 0]).any(axis=1) & np.isfinite(own[:, 0, 0, 0]))
    if not len(common):
        return None
    trial = common[np.unique(np.linspace(0, len(common) - 1, min(len(common), TRIAL_FRAMES)).astype(int))]
    candidates = (own[trial][:, :, None] @ inverse(Ts_ref_board[trial])[:, None]).reshape(-1, 4, 4)
    candidates = candidates[np.isfinite(candidates[:, 0, 0])]
    if len(candidates) > FINALISTS and len(common) > HEAT_FRAMES:
        few = common[np.unique(np.linspace(0, len(common) - 1, HEAT_FRAMES).astype(int))]
        best = np.argsort(_misses_px(sights, Ts_ref_board, candidates, camera, few), kind="stable")
        candidates = candidates[best[:FINALISTS]]
    mean = _misses_px(sights, Ts_ref_board, candidates, camera, common)
    best = int(np.argmin(mean))
    return candidates[best], float(mean[best]), len(common)


def _misses_px(
    sights: _Sights,
    Ts_ref_board: Float[np.ndarray, "frame option 4 4"],
    Ts_cam_ref: Float[np.ndarray, "candidate 4 4"],
    camera: int,
    frames: Int[np.ndarray, " chosen"],
) -> Float[np.ndarray, " candidate"]:
    """Give the mean error of candidates for a camera's pose, each picture with the pose of its board that suits it best."""
    errors = np.full((len(Ts_cam_ref), len(frames)), np.inf)
    there = replace(sights, uv_px=sights.uv_px[:, frames])
    for option in range(Ts_ref_board.shape[1]):
        posed = Ts_cam_ref[:, None] @ Ts_ref_board[frames, option]
        known = np.isfinite(Ts_ref_board[frames, option, 0, 0])
        errors = np.fmin(errors, np.where(known, there.errors_px(camera, posed), np.inf))
    return errors.mean(axis=1)


def _spread_out(
    sights: _Sights, pairs: dict[tuple[int, int], Pair], method: Method
) -> tuple[np.ndarray, tuple[Pair, ...]]:
    """Lead every camera back to the first of the largest connected group, over the pairs that cost least."""
    count = len(sights.cameras)
    cost = np.zeros((count, count))
    for (i, j), pair in pairs.items():
        cost[i, j] = pair.cost
    tree = minimum_spanning_tree(cost).toarray()
    tree = np.maximum(tree, tree.T)
    reached = [breadth_first_order(tree, i, directed=False, return_predecessors=True) for i in range(count)]
    root = max(range(count), key=lambda i: (len(reached[i][0]), -i))
    Ts, used = np.full((count, 4, 4), np.nan), []
    Ts[root] = np.eye(4)
    options = [sights.poses[root].T_cam_board]
    for camera in reached[root][0][1:]:
        before = int(reached[root][1][camera])
        pair = pairs[min(before, camera), max(before, camera)]
        T_cam_before = pair.T_second_first if pair.first == before else inverse(pair.T_second_first)
        Ts[camera] = T_cam_before @ Ts[before]
        if method == "tree" and (found := _attach(sights, np.concatenate(options, axis=1), int(camera))) is not None:
            Ts[camera] = found[0]
        options.append(inverse(Ts[camera]) @ sights.poses[camera].T_cam_board)
        used.append(pair)
    return Ts, tuple(used)


def _place_boards(sights: _Sights, Ts_cam_ref: np.ndarray) -> Float[np.ndarray, "frame 4 4"]:
    """Pose the board of each frame as the camera has it whose pose the other cameras agree with best."""
    cameras, frames = sights.uv_px.shape[:2]
    usable = [c for c in range(cameras) if np.isfinite(Ts_cam_ref[c, 0, 0])]
    best, placed = np.full(frames, np.inf), np.full((frames, 4, 4), np.nan)
    for camera in usable:
        for solution in range(2):
            T_ref_board = inverse(Ts_cam_ref[camera]) @ sights.poses[camera].T_cam_board[:, solution]
            known = np.isfinite(T_ref_board[:, 0, 0])
            total = np.where(known, 0.0, np.inf)
            for other in usable:
                error = sights.errors_px(other, Ts_cam_ref[other] @ T_ref_board)
                total += np.where(np.isfinite(error) & known, error, 0.0)
            better = total < best
            best[better], placed[better] = total[better], T_ref_board[better]
    return placed
