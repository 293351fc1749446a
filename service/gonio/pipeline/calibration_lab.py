"""Stage ``lab``: where up, forward and the floor are, from what was given."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gonio.errors import InputError
from gonio.formats.floor_points import FloorPoints, read_floor_points
from gonio.kernel.calibration.lab_frame import lab_from_board, lab_from_cameras, lab_from_points
from gonio.kernel.calibration.rig import RigSolution, place_boards
from gonio.kernel.geometry.transforms import apply, inverse
from gonio.pipeline.calibration_files import only_file
from gonio.pipeline.calibration_verdict import locate_points
from gonio.pipeline.findings import finding
from gonio.pipeline.run import CaptureFile, Outcome
from gonio.records import BoardViews, Calibration, Finding, LabFrame, Rig, RigCheck, record

STILL_S, STILL_M = 0.5, 0.005
"""A board that lies on the floor moves by less than this within that time."""

LAB_MISFIT_M = 0.02


@record
class Lab:
    """The lab frame, and the rig in it."""

    frame: LabFrame
    rig: Rig


def find_lab(
    views: BoardViews,
    solution: RigSolution,
    files: Sequence[CaptureFile],
    floor: BoardViews | None,
    floor_time_s: float | None = None,
    board_thickness_m: float = 0.0,
    earlier: LabFrame | None = None,
) -> Outcome[Lab]:
    """Find the lab frame from what was given: floor points, the board on the floor, else as ``earlier`` had it.

    Without any of them, the cameras' own posture is all there is.

    Raises:
        InputError: ``floor-points-few``, ``floor-frame-empty``, or what reading the points says.
        CaptureError: ``floor-contradicts``.
    """
    lenses = solution.lenses(views)
    reference = Rig(cameras=lenses, source="")
    Ts_ref_cam = inverse(solution.scene.Ts_cam_ref)
    points = read_points(files, reference)
    findings: list[Finding] = []
    if points is not None and np.isfinite(points.xyz_lab_m[:, 0]).any():
        frame = lab_from_points(locate_points(reference, points), points.xyz_lab_m)
    elif floor is not None or floor_time_s is not None:
        boards = _floor_boards(views, solution, floor, floor_time_s)
        frame = lab_from_board(
            boards,
            Ts_ref_cam,
            middle_board_m=views.board.corners_board_m.mean(axis=0),
            thickness_m=board_thickness_m,
        )
    elif earlier is not None:
        frame = earlier
    else:
        corners = np.concatenate([apply(T, views.board.corners_board_m) for T in solution.scene.Ts_ref_board])
        frame = lab_from_cameras(Ts_ref_cam, corners)
        findings.append(finding("lab-guessed"))
    if frame.misfit_m > LAB_MISFIT_M:
        findings.append(finding("lab-misfit", value=1e3 * frame.misfit_m))
    cameras = tuple(replace(camera, T_lab_cam=frame.T_lab_ref @ camera.T_lab_cam) for camera in lenses)
    return Outcome(Lab(frame=frame, rig=Rig(cameras=cameras, source="gonio")), tuple(findings))


def _floor_boards(
    views: BoardViews, solution: RigSolution, floor: BoardViews | None, floor_time_s: float | None
) -> np.ndarray:
    """Give the poses of the board lying on the floor: in pictures of their own, or about a moment of the sweep."""
    connected = list(solution.cameras)
    if floor is not None:
        order = [floor.camera_names.index(views.camera_names[c]) for c in connected]
        uv_px = floor.uv_px[order]
    else:
        assert floor_time_s is not None  # one of the two is given
        near = np.abs(views.times_s - floor_time_s) <= STILL_S
        uv_px = views.uv_px[connected][:, near]
    boards = place_boards(solution, solution.lenses(views), views.board.corners_board_m, uv_px)
    boards = boards[np.isfinite(boards[:, 0, 0])]
    if not len(boards):
        raise InputError(
            "The board was not found where it should lie on the floor.",
            hint="Name a frame in which two cameras see it, or give pictures of it.",
            code="floor-frame-empty",
        )
    off_m = np.linalg.norm(boards[:, :3, 3] - np.median(boards[:, :3, 3], axis=0), axis=1)
    return boards[off_m <= max(STILL_M, float(off_m.min()))]


def read_points(files: Sequence[CaptureFile], rig: Rig) -> FloorPoints | None:
    """Read the floor points, where there are any."""
    file = only_file(files, "floor_points")
    return None if file is None else read_floor_points(file.path, rig.names)


def earlier_lab(
    earlier: Calibration | None, check: RigCheck | None, solution: RigSolution, views: BoardViews
) -> LabFrame | None:
    """Give the earlier calibration's lab, as the cameras that did not move carry it over."""
    if earlier is None or check is None or check.moved.all():
        return None
    names = [views.camera_names[c] for c in solution.cameras]
    if check.camera_names[0] not in names:
        return None
    T_cam1_ref = solution.scene.Ts_cam_ref[names.index(check.camera_names[0])]
    return replace(earlier.lab, T_lab_ref=check.T_lab_cam1 @ T_cam1_ref)
