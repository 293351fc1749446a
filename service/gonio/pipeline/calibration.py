"""The river of a calibration, from the videos of a board to a rig that is judged. Read it from top to bottom."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gonio.errors import InputError
from gonio.formats.calibration import read_intrinsics
from gonio.formats.floor_points import FloorPoints, read_floor_points
from gonio.kernel.calibration.intrinsics import choose_views, solve_intrinsics
from gonio.kernel.calibration.lab_frame import lab_from_board, lab_from_cameras, lab_from_points
from gonio.kernel.calibration.rig import RigSolution, place_boards, solve_rig
from gonio.kernel.calibration.volume import judge_volume
from gonio.kernel.geometry.transforms import apply, inverse
from gonio.pipeline.boards import describe_board
from gonio.pipeline.calibration_files import CalibrationFile, only_file, pictures_of, read_card
from gonio.pipeline.calibration_recording import find_floor_boards, find_lens_boards, find_sweep, read_sweep
from gonio.pipeline.calibration_report import CalibrationFiles, write_calibration_report
from gonio.pipeline.calibration_verdict import find_lengths, judge_rig, locate_points
from gonio.pipeline.findings import finding
from gonio.pipeline.params import parse_calibration_parameters
from gonio.pipeline.run import Outcome, StageRunner
from gonio.records import BoardTrack, BoardViews, Calibration, Finding, Intrinsics, LabFrame, Rig, record

CALIBRATION_SHARES: Mapping[str, float] = MappingProxyType(
    {
        "recording": 0.02,
        "lens-boards": 0.35,
        "boards": 0.5,
        "lenses": 0.03,
        "rig": 0.03,
        "floor-boards": 0.01,
        "lab": 0.005,
        "verdict": 0.05,
        "calibration-report": 0.005,
    }
)
"""Each stage's share of the wall time, in order."""

FEW_LENS_VIEWS = 12
STILL_S, STILL_M = 0.5, 0.005
"""A board that lies on the floor moves by less than this within that time."""

LAB_MISFIT_M = 0.02


@record
class Lab:
    """The lab frame, and the rig in it."""

    frame: LabFrame
    rig: Rig


def calibrate(
    files: Sequence[CalibrationFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> CalibrationFiles:
    """Calibrate the cameras from recordings of a board.

    Args:
        files: The recordings, the board's card, and what else is known.
        parameters: What the request chose (:class:`gonio.pipeline.params.CalibrationParameters`).
        runner: Runs the stages; keeps what they give, where that is its job.
        output_dir: Where the calibration and its report go.

    Raises:
        InputError: A file or a parameter is wrong.
        CaptureError: The recording can't give the answer.
        SolverError: The numbers failed.
    """
    chosen = parse_calibration_parameters(parameters)
    output_dir.mkdir(parents=True, exist_ok=True)

    card = read_card(files, chosen.board)
    sweep = runner("recording", lambda _: read_sweep(pictures_of(files, "sweep"), card.board, chosen.pictures_per_s))
    lens_tracks = runner("lens-boards", lambda p: find_lens_boards(pictures_of(files, "lens"), card.board, p))
    views = runner("boards", lambda progress: find_sweep(sweep, progress))
    intrinsics = runner("lenses", lambda _: calibrate_lenses(views, lens_tracks, files))
    solution = runner("rig", lambda _: Outcome(solve_rig(views, intrinsics, method=chosen.method)))
    floor = runner("floor-boards", lambda _: find_floor_boards(pictures_of(files, "floor"), views))
    floor_time_s = None if chosen.floor_frame is None else chosen.floor_frame * sweep.frame_period_s
    lab = runner(
        "lab",
        lambda _: find_lab(views, solution, files, floor, floor_time_s, chosen.board_thickness_mm / 1000),
    )
    points = read_points(files, lab.rig)
    lengths = find_lengths(chosen.known_lengths, lab.rig, points)
    verdict = runner("verdict", lambda _: judge_rig(views, intrinsics, solution, sweep.frame_period_s, lengths))
    calibration = Calibration(
        rig=lab.rig,
        intrinsics=tuple(intrinsics[c] for c in solution.cameras),
        delay_s=solution.scene.theta[:, -1],
        covariance=solution.adjusted.covariance,
        sigma_px=solution.adjusted.sigma_px,
        lab=lab.frame,
        volume=judge_volume(views, solution, lab.frame.T_lab_ref),
        verdict=verdict,
        board=describe_board(card),
        left_out=tuple(name for c, name in enumerate(views.camera_names) if c not in solution.cameras),
    )
    return runner(
        "calibration-report",
        lambda _: Outcome(write_calibration_report(calibration, views, solution, runner.findings, output_dir)),
    )


def calibrate_lenses(
    views: BoardViews, lens_tracks: Sequence[BoardTrack], files: Sequence[CalibrationFile]
) -> Outcome[tuple[Intrinsics, ...]]:
    """Give each camera's optics: from a recording of its own, else from a file, else from the sweep itself.

    Raises:
        InputError: ``optics-size-wrong``: a lens was calibrated in another picture size than it is used in.
        CaptureError: ``intrinsics-too-few-views``.
    """
    recorded = {track.camera_name: track for track in lens_tracks}
    optics_file = only_file(files, "optics")
    given = {} if optics_file is None else {o.camera_name: o for o in read_intrinsics(optics_file.path)}
    found: list[Intrinsics] = []
    findings: list[Finding] = []
    for name, size_px, uv_px in zip(views.camera_names, views.image_sizes_px, views.uv_px, strict=True):
        track = recorded.get(name)
        if track is not None and (track.corner_counts > 0).any():
            chosen = choose_views(views.board, track.uv_px, track.sharpness, track.image_size_px)
            optics = solve_intrinsics(views.board, track.uv_px[chosen], track.image_size_px, camera_name=name)
            if optics.views < FEW_LENS_VIEWS:
                findings.append(finding("lens-few-views", where=name, value=optics.views))
        elif name in given:
            optics = given[name]
        elif np.isfinite(uv_px).any():
            chosen = choose_views(views.board, uv_px, np.ones(len(uv_px)), size_px)
            optics = solve_intrinsics(views.board, uv_px[chosen], size_px, camera_name=name, origin="session")
            share = 100 * float(optics.sd[0] / optics.parameters[0])
            findings.append(finding("lens-from-session", where=name, value=share))
        else:
            optics = unseen_optics(name, size_px)
        if optics.image_size_px != size_px:
            raise InputError(
                f"The lens of camera {name} was calibrated with pictures of {optics.image_size_px[0]} × "
                f"{optics.image_size_px[1]} pixels, but the sweep has {size_px[0]} × {size_px[1]}.",
                hint="Film both in the same video mode: modes crop the sensor differently.",
                code="optics-size-wrong",
            )
        found.append(optics)
    return Outcome(tuple(found), tuple(findings))


def unseen_optics(name: str, image_size_px: tuple[int, int]) -> Intrinsics:
    """Give the optics of a camera that never saw the board: a place holder, for it has no place in the rig either."""
    width, height = image_size_px
    return Intrinsics(
        camera_name=name,
        image_size_px=image_size_px,
        model="k1k2",
        parameters=np.array([width, 1.0, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0, 0.0]),
        covariance=np.zeros((9, 9)),
        held_out_px=np.nan,
        rms_px=np.nan,
        views=0,
        tilted_views=0,
        covered=np.zeros((4, 6), dtype=bool),
        origin="session",
        source="",
    )


def find_lab(
    views: BoardViews,
    solution: RigSolution,
    files: Sequence[CalibrationFile],
    floor: BoardViews | None,
    floor_time_s: float | None = None,
    board_thickness_m: float = 0.0,
) -> Outcome[Lab]:
    """Find the lab frame from what was given: floor points, the board on the floor, or only the cameras' own posture.

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


def read_points(files: Sequence[CalibrationFile], rig: Rig) -> FloorPoints | None:
    """Read the floor points, where there are any."""
    file = only_file(files, "floor_points")
    return None if file is None else read_floor_points(file.path, rig.names)
