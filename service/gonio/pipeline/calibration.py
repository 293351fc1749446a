"""The river of a calibration, from the videos of a board to a rig that is judged. Read it from top to bottom."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gonio.errors import InputError
from gonio.formats.calibration import intrinsics_of, read_intrinsics
from gonio.formats.calibration_json import read_calibration_document
from gonio.kernel.calibration.intrinsics import choose_views, solve_intrinsics
from gonio.kernel.calibration.rig import solve_rig
from gonio.kernel.calibration.rig_check import check_rig
from gonio.kernel.calibration.volume import judge_volume
from gonio.pipeline.boards import describe_board
from gonio.pipeline.calibration_files import only_file, pictures_of, read_card
from gonio.pipeline.calibration_lab import earlier_lab, find_lab, read_points
from gonio.pipeline.calibration_recording import find_floor_boards, find_lens_boards, find_sweep, read_sweep
from gonio.pipeline.calibration_report import check_rows, write_calibration_report
from gonio.pipeline.calibration_verdict import find_lengths, judge_rig
from gonio.pipeline.findings import finding
from gonio.pipeline.params import parse_calibration_parameters
from gonio.pipeline.run import CaptureFile, Outcome, ReportFiles, StageRunner
from gonio.records import BoardTrack, BoardViews, Calibration, Finding, Intrinsics, RigCheck

CALIBRATION_SHARES: Mapping[str, float] = MappingProxyType(
    {
        "recording": 0.02,
        "lens-boards": 0.35,
        "boards": 0.5,
        "lenses": 0.03,
        "rig": 0.03,
        "comparison": 0.005,
        "floor-boards": 0.01,
        "lab": 0.005,
        "verdict": 0.05,
        "calibration-report": 0.005,
    }
)
"""Each stage's share of the wall time, in order."""

FEW_LENS_VIEWS = 12


def calibrate(
    capture_files: Sequence[CaptureFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> ReportFiles:
    """Calibrate the cameras from recordings of a board.

    Args:
        capture_files: The recordings, the board's card, and what else is known.
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

    card = read_card(capture_files, chosen.board)
    sweep = runner(
        "recording", lambda _: read_sweep(pictures_of(capture_files, "sweep"), card.board, chosen.pictures_per_s)
    )
    lens_tracks = runner("lens-boards", lambda p: find_lens_boards(pictures_of(capture_files, "lens"), card.board, p))
    views = runner("boards", lambda progress: find_sweep(sweep, progress))
    intrinsics = runner("lenses", lambda _: calibrate_lenses(views, lens_tracks, capture_files))
    solution = runner("rig", lambda _: Outcome(solve_rig(views, intrinsics, method=chosen.method)))
    earlier = read_earlier(capture_files)
    check = None if earlier is None else runner("comparison", lambda _: compare(views, earlier))
    floor = runner("floor-boards", lambda _: find_floor_boards(pictures_of(capture_files, "floor"), views))
    floor_time_s = None if chosen.floor_frame is None else chosen.floor_frame * sweep.frame_period_s
    carried = earlier_lab(earlier, check, solution, views)
    lab = runner(
        "lab",
        lambda _: find_lab(
            views,
            solution,
            capture_files,
            floor,
            floor_time_s,
            chosen.board_thickness_mm / 1000,
            carried,
        ),
    )
    points = read_points(capture_files, lab.rig)
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
        findings=runner.findings,
    )
    return runner(
        "calibration-report",
        lambda _: Outcome(write_calibration_report(calibration, views, solution, check, output_dir)),
    )


def calibrate_lenses(
    views: BoardViews, lens_tracks: Sequence[BoardTrack], files: Sequence[CaptureFile]
) -> Outcome[tuple[Intrinsics, ...]]:
    """Give each camera's optics: from a recording of its own, a file, the earlier calibration, or the sweep itself.

    Raises:
        InputError: ``optics-size-wrong``: a lens was calibrated in another picture size than it is used in.
        CaptureError: ``intrinsics-too-few-views``.
    """
    recorded = {track.camera_name: track for track in lens_tracks}
    optics_file = only_file(files, "optics")
    earlier = read_earlier(files)
    given = {} if earlier is None else {optics.camera_name: optics for optics in earlier.intrinsics}
    given |= {} if optics_file is None else {o.camera_name: o for o in read_intrinsics(optics_file.path)}
    found: list[Intrinsics] = []
    findings: list[Finding] = []
    for name, size_px, uv_px in zip(views.camera_names, views.image_sizes_px, views.uv_px, strict=True):
        track = recorded.get(name)
        if track is not None and (track.corner_counts > 0).any():
            chosen = choose_views(views.board, track.uv_px, track.sharpness, track.image_size_px)
            optics = solve_intrinsics(views.board, track.uv_px[chosen], track.image_size_px, camera_name=name)
            if optics.views < FEW_LENS_VIEWS:
                findings.append(finding("lens-few-views", camera=name, value=optics.views))
        elif name in given:
            optics = given[name]
        elif np.isfinite(uv_px).any():
            chosen = choose_views(views.board, uv_px, np.ones(len(uv_px)), size_px)
            optics = solve_intrinsics(views.board, uv_px[chosen], size_px, camera_name=name, origin="session")
            share = 100 * float(optics.sd[0] / optics.parameters[0])
            findings.append(finding("lens-from-session", camera=name, value=share))
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


def read_earlier(files: Sequence[CaptureFile]) -> Calibration | None:
    """Read the earlier calibration of the same cameras, where one was given.

    Raises:
        InputError: ``calibration-unreadable``.
    """
    file = only_file(files, "previous")
    return None if file is None else read_calibration_document(file.path)


def compare(views: BoardViews, earlier: Calibration) -> Outcome[RigCheck]:
    """Say which cameras no longer stand where an earlier calibration has them.

    Raises:
        CaptureError: ``cameras-differ``, ``cameras-unconnected``.
    """
    optics = tuple(intrinsics_of(camera, "the earlier calibration") for camera in earlier.rig.cameras)
    check = check_rig(views, optics, earlier.rig)
    findings = [
        _displaced(name, float(shift), row)
        for name, shift, moved, row in zip(
            check.camera_names, check.shift_px, check.moved, check_rows(check), strict=True
        )
        if moved
    ]
    findings += [finding("camera-not-checked", camera=n) for n in earlier.rig.names if n not in check.camera_names]
    if not findings:
        findings.append(finding("cameras-steady", value=float(check.shift_px.max())))
    return Outcome(check, tuple(findings))


def _displaced(name: str, shift_px: float, row: Mapping[str, str]) -> Finding:
    """Name a camera that moved, and say how far with its error bar."""
    told = finding("camera-displaced", camera=name, value=shift_px)
    return replace(told, message=f"{told.message} It turned by {row['turned']} and moved by {row['shifted']}.")


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
