"""Has a camera moved since the rig was calibrated? A new sweep of the board, seen through the old calibration, tells.

The sweep is solved anew, and laid onto the old rig by the cameras that agree about it. What counts is by how many pixels a
camera's picture of the board is off from its old place: turn and shift alone say little, for they make up for each other.
Optics are held: what changes from one day to the next is the tripod.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, SolverError
from gonio.kernel.calibration.board_motion import advance
from gonio.kernel.calibration.board_terms import DELAY
from gonio.kernel.calibration.boards import Observations, Scene, pose_boards
from gonio.kernel.calibration.held_out import some_cameras, split_blocks
from gonio.kernel.calibration.pairwise import pose_in_rig
from gonio.kernel.calibration.rig import RigSolution, solve_part, solve_rig
from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import align, apply, inverse
from gonio.records import BoardViews, Intrinsics, Rig, RigCheck

MOVED_PX = 1.5
"""A camera whose picture of the board is off by this in the median has moved; in pictures wider than 1280 by more."""

MOST_FRAMES = 60
HALF_BLOCKS = 6
"""The sweep's halves are every other of so many blocks."""


def check_rig(views: BoardViews, optics: Sequence[Intrinsics], rig: Rig) -> RigCheck:
    """Compare a new sweep with an earlier calibration.

    Args:
        views: The new sweep.
        optics: The optics of the earlier calibration, a camera of ``rig`` each.
        rig: The earlier calibration.

    Raises:
        CaptureError: ``cameras-differ``: fewer than two cameras are of the earlier calibration;
            ``cameras-unconnected``: the sweep is too poor to compare anything.
        SolverError: ``calibration-diverged``.
    """
    known = [c for c, name in enumerate(views.camera_names) if name in rig.names]
    if len(known) < 2:
        raise CaptureError(
            f"The earlier calibration is of {', '.join(rig.names)}, the sweep of {', '.join(views.camera_names)}: they "
            "have not two cameras in common.",
            hint="Name the videos after the cameras of the earlier calibration.",
            code="cameras-differ",
        )
    places = [rig.names.index(views.camera_names[c]) for c in known]
    solution = solve_rig(some_cameras(views, known), [optics[p] for p in places], hold_intrinsics=True)
    seen, places = [known[c] for c in solution.cameras], [places[c] for c in solution.cameras]
    Ts_lab_cam = np.stack([rig.cameras[p].T_lab_cam for p in places])
    own = some_cameras(views, seen)
    sweep = _Sweep(own, solution, Ts_lab_cam)
    widths = np.array([views.image_sizes_px[c][0] for c in seen])
    shift_px, T_lab_ref, steady = sweep.find_steady(MOVED_PX * np.maximum(widths / 1280, 1.0))
    steady_ones = [c for c in range(len(seen)) if steady[c]] or list(range(len(seen)))
    _, turn, shift_m = sweep.changes(steady_ones)
    shift_sd_px, turned_sd_rad, shifted_sd_m = _scatter(own, solution, Ts_lab_cam, steady_ones)
    return RigCheck(
        camera_names=tuple(views.camera_names[c] for c in seen),
        shift_px=shift_px,
        moved=~steady,
        turned_rad=np.linalg.norm(turn, axis=1),
        shifted_m=np.linalg.norm(shift_m, axis=1),
        shift_sd_px=shift_sd_px,
        turned_sd_rad=turned_sd_rad,
        shifted_sd_m=shifted_sd_m,
        T_lab_cam1=T_lab_ref,
    )


def _scatter(
    views: BoardViews, solution: RigSolution, Ts_lab_cam: Float[np.ndarray, "camera 4 4"], steady: list[int]
) -> tuple[Float[np.ndarray, " camera"], Float[np.ndarray, " camera"], Float[np.ndarray, " camera"]]:
    """Give the standard deviations of shifts in pixels, turns and ways: half the difference of two halves of the sweep."""
    try:
        one, other = (
            _Sweep(views, solve_part(views, solution, half), Ts_lab_cam).changes(steady)
            for half in split_blocks(solution.frames, HALF_BLOCKS)
        )
    except (CaptureError, SolverError):
        unknown = np.full(len(Ts_lab_cam), np.nan)
        return unknown, unknown, unknown
    px, turned, way = (np.asarray(a - b) / 2 for a, b in zip(one, other, strict=True))
    return np.abs(px), np.linalg.norm(turned, axis=1), np.linalg.norm(way, axis=1)


class _Sweep:
    """The new sweep, solved with the old optics, beside the cameras' old places."""

    def __init__(self, views: BoardViews, solution: RigSolution, Ts_lab_cam: Float[np.ndarray, "camera 4 4"]) -> None:
        scene = solution.scene
        some = np.unique(np.linspace(0, len(solution.frames) - 1, MOST_FRAMES).astype(int))
        uv_px = advance(views.uv_px, views.times_s, scene.theta[:, DELAY])[:, solution.frames[some]]
        corners = views.board.corners_board_m
        self._corners_board_m = corners
        self._lenses = solution.lenses(views)
        self._theta = np.column_stack([scene.theta[:, :DELAY], np.zeros(len(scene.theta))])
        self._Ts_lab_cam = Ts_lab_cam
        self._Ts_cam_ref = scene.Ts_cam_ref
        self._uv_px = uv_px
        self._seen = np.isfinite(uv_px[..., 0])
        self._xyz_ref_m = np.stack([apply(T, corners) for T in scene.Ts_ref_board[some]])
        self._now_px = np.stack([project(lens, self._xyz_ref_m) for lens in self._lenses])

    def find_steady(
        self, limits_px: Float[np.ndarray, " camera"]
    ) -> tuple[Float[np.ndarray, " camera"], Float[np.ndarray, "4 4"], Bool[np.ndarray, " camera"]]:
        """Leave out cameras, the worst first, until the rest agree; all have moved if not even two do.

        Gives each camera's shift in pixels, the transform to the old lab, and which cameras are steady.
        """
        agreeing = list(range(len(limits_px)))

        def worst_of(cameras: list[int]) -> float:
            return float(np.nanmax((self._compare(cameras)[0] / limits_px)[cameras]))

        while len(agreeing) > 2 and worst_of(agreeing) > 1:
            agreeing = min(([c for c in agreeing if c != out] for out in agreeing), key=worst_of)
        shift_px, T_lab_ref = self._compare(agreeing)
        return shift_px, T_lab_ref, (shift_px <= limits_px) & (worst_of(agreeing) <= 1)

    def changes(
        self, steady: list[int]
    ) -> tuple[Float[np.ndarray, " camera"], Float[np.ndarray, "camera 3"], Float[np.ndarray, "camera 3"]]:
        """Give each camera's shift in pixels, turn (a rotation vector) and way, against the places of the steady ones."""
        shift_px, T_lab_ref = self._compare(steady)
        change = inverse(self._Ts_lab_cam) @ T_lab_ref @ inverse(self._Ts_cam_ref)
        return shift_px, np.asarray(Rotation.from_matrix(change[:, :3, :3]).as_rotvec()), change[:, :3, 3]

    def _compare(self, posing: list[int]) -> tuple[Float[np.ndarray, " camera"], Float[np.ndarray, "4 4"]]:
        """Pose the boards with some cameras at their old places, and see how far each camera's picture is off."""
        T_lab_ref = self._align(posing)
        xyz_lab_m = apply(T_lab_ref, self._xyz_ref_m)
        shift_px = np.full(len(self._lenses), np.inf)
        for camera, lens in enumerate(self._lenses):
            then_px = project(replace(lens, T_lab_cam=self._Ts_lab_cam[camera]), xyz_lab_m)
            off = np.linalg.norm(then_px - self._now_px[camera], axis=-1)[self._seen[camera]]
            # A corner that would be behind the camera is as far off as can be.
            shift_px[camera] = np.median(np.where(np.isfinite(off), off, np.inf))
        return shift_px, T_lab_ref

    def _align(self, posing: list[int]) -> Float[np.ndarray, "4 4"]:
        """Give the best rigid motion from the new boards to the same boards as the old places of some cameras have them."""
        Ts_cam_lab = inverse(self._Ts_lab_cam[posing])
        rough = pose_in_rig(
            tuple(self._lenses[c] for c in posing), Ts_cam_lab, self._corners_board_m, self._uv_px[posing]
        )
        known = np.isfinite(rough[:, 0, 0])
        if not known.any():
            return np.eye(4)
        seen = self._seen[posing][:, known]
        observations = Observations(
            corners_board_m=self._corners_board_m,
            uv_px=np.where(seen[..., None], self._uv_px[posing][:, known], 0.0),
            velocity_px_s=np.zeros((*seen.shape, 2)),
            weight=seen.astype(float),
        )
        scene = Scene(theta=self._theta[posing], Ts_cam_ref=Ts_cam_lab, Ts_ref_board=rough[known])
        boards = pose_boards(observations, scene).Ts_ref_board
        there = np.concatenate([apply(T, self._corners_board_m) for T in boards])
        here = self._xyz_ref_m[known].reshape(-1, 3)
        return align(here, there)
