"""Calibration: real recordings against Caliscope and aniposelib, the virtual lab against the truth, the verdict against faults.

Recordings, where they lie in ``../shared/data``: Caliscope's own ChArUco session (four cameras, 111 frames, a white-on-black
board) and the checkerboard photographs of the balancing trial. What a good calibration must reach is in the metrics'
bounds; the rivals' numbers stand beside it. The rivals solve the same corners; the optics that come with the session are
given to gonio and to Caliscope, aniposelib finds its own.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gonio.bench import Bench
from gonio.bench.board_faults import measure_truth, measure_verdicts
from gonio.bench.peers import peer_python, run_in_peer
from gonio.bench.recordings import BALANCING, CALISCOPE_SESSION, need
from gonio.errors import GonioError, ResourceError
from gonio.formats.board_card import read_board_card
from gonio.formats.calibration import read_intrinsics
from gonio.formats.qualisys import read_qualisys_calibration
from gonio.kernel.calibration.board_terms import DELAY
from gonio.kernel.calibration.held_out import (
    BoardErrors,
    Halves,
    baselines_m,
    disagreement,
    measure_boards,
    solve_halves,
    split_blocks,
)
from gonio.kernel.calibration.intrinsics import solve_intrinsics
from gonio.kernel.calibration.rig import solve_rig
from gonio.kernel.geometry.transforms import inverse
from gonio.records import Board, BoardViews, Camera, Intrinsics, Rig
from gonio.vision.boards import find_boards, video_pictures
from gonio.vision.stills import still_pictures

PHOTOGRAPHS = BALANCING / "calibration" / "intrinsics"
RATE_HZ = 6.0
TRUE_DELAY_MS = 100.0
"""By how much camera 1 of the session runs late: found in two sessions of that rig, and in both halves of each."""

CALISCOPE, ANIPOSELIB = "caliscope==0.11.8", "aniposelib==0.8.0"


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("calibration")
    for names, measure in (("charuco_*", _measure_session), ("boards_found, qualisys_*", _measure_photographs)):
        try:
            measure(bench, build_dir)
        except GonioError as error:
            bench.leave_out(names, error)
    measure_truth(bench)
    measure_verdicts(bench, build_dir)
    return bench.to_json()


def _measure_session(bench: Bench, build_dir: Path) -> None:
    """Calibrate Caliscope's session from its videos to the cameras, and compare both halves of it."""
    videos = sorted((need(CALISCOPE_SESSION) / "calibration" / "extrinsic").glob("*.mp4"))
    # The card says that the board is inverted; gonio is not told.
    card = read_board_card(CALISCOPE_SESSION / "charuco.toml").board
    board = replace(card, inverted=False)
    optics = read_intrinsics(CALISCOPE_SESSION / "camera_array.toml")
    _warm_up(optics, board)
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    tracks = find_boards({video.stem: video_pictures(video) for video in videos}, board)
    views = BoardViews(
        camera_names=tuple(track.camera_name for track in tracks),
        image_sizes_px=tuple(track.image_size_px for track in tracks),
        board=board,
        times_s=np.arange(len(tracks[0].uv_px)) / RATE_HZ,
        uv_px=np.stack([track.uv_px for track in tracks]),
    )
    solution = solve_rig(views, optics)
    seconds, cpu_seconds = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    halves = solve_halves(views, solution)
    if halves is None:
        raise GonioError(
            "The session can't be halved.", hint="See gonio.kernel.calibration.held_out.", code="bench-failed"
        )
    _report_ours(bench, views, halves, 1e3 * float(solution.scene.theta[1, DELAY]))
    bench.add("charuco_total_s", seconds, "s")
    bench.add("charuco_total_cpu_s", cpu_seconds, "s")
    ours = [int((track.corner_counts >= 6).sum()) for track in tracks]
    bench.add("charuco_views", sum(ours), "pictures")
    parts = split_blocks(solution.frames, 6)
    _measure_rivals(bench, build_dir, views, parts, videos, (ours, seconds, cpu_seconds))


def _warm_up(optics: Sequence[Intrinsics], board: Board) -> None:
    """Compile, or load what was compiled: that comes once in a gonio's life."""
    rng = np.random.default_rng(0)
    uv_px = 300 + 5000 * board.corners_board_m[None, None, :, :2] + 200 * rng.random((2, 8, 1, 2))
    views = BoardViews(
        camera_names=("a", "b"), image_sizes_px=((1280, 720),) * 2, board=board, times_s=np.arange(8) / 6, uv_px=uv_px
    )
    solve_rig(views, optics[:2])


def _report_ours(bench: Bench, views: BoardViews, halves: Halves, delay_ms: float) -> None:
    worst = {
        "bias_pct": 100 * max(abs(errors.bias) for errors in halves.errors),
        "length_rms_mm": 1e3 * max(errors.length_rms_m for errors in halves.errors),
        "reprojection_px": max(errors.rms_px for errors in halves.errors),
    }
    bench.add("charuco_heldout_bias_pct", worst["bias_pct"], "%", at_most=0.2)
    bench.add("charuco_heldout_rms_mm", worst["length_rms_mm"], "mm", at_most=0.45)
    bench.add("charuco_heldout_px", worst["reprojection_px"], "px", at_most=0.8)
    bench.add("charuco_baseline_halves_pct", 100 * halves.baseline_rms, "%", at_most=0.5)
    bench.add("charuco_delay_error_ms", abs(delay_ms - TRUE_DELAY_MS), "ms", at_most=30.0)


def _measure_rivals(
    bench: Bench,
    build_dir: Path,
    views: BoardViews,
    parts: tuple[np.ndarray, np.ndarray],
    videos: Sequence[Path],
    ours: tuple[list[int], float, float],
) -> None:
    folder = build_dir.resolve() / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    task = folder / "boards.npz"
    board = views.board
    np.savez(
        task,
        uv_px=views.uv_px,
        part_0=parts[0],
        part_1=parts[1],
        corners_board_m=board.corners_board_m,
        squares=[board.corners_across + 1, board.corners_down + 1],
        square_m=board.square_m,
        marker_scale=board.marker_m / board.square_m,
        dictionary=board.dictionary,
        rate_hz=RATE_HZ,
        image_size_px=views.image_sizes_px[0],
    )
    best_views = np.zeros(len(videos), dtype=int)
    totals: list[np.ndarray] = []
    for name, requirement, extra in (
        ("caliscope", CALISCOPE, [CALISCOPE_SESSION / "camera_array.toml"]),
        ("aniposelib", ANIPOSELIB, []),
    ):
        answer_path = folder / f"{name}_rig.npz"
        try:
            run_in_peer(peer_python(build_dir, name, requirement), f"{name}_rig", task, answer_path, *extra, *videos)
        except ResourceError as error:
            bench.leave_out(f"charuco_*_{name}", error)
            continue
        answer = np.load(answer_path)
        best_views = np.maximum(best_views, answer["views"])
        _report_rival(bench, name, views, parts, answer)
        totals.append(np.array([answer["seconds"].sum(), answer["cpu_seconds"].sum()]))
        bench.add(f"charuco_total_s_{name}", totals[-1][0], "s")
        bench.add(f"charuco_total_cpu_s_{name}", totals[-1][1], "s")
        bench.add(f"time_ratio_{name}", totals[-1][0] / ours[1], "1")
        bench.add(f"cpu_ratio_{name}", totals[-1][1] / ours[2], "1", at_least=1.0)
    if totals:
        least = int((np.array(ours[0]) - best_views).min())
        bench.add("charuco_views_more_than_best_rival", least, "pictures", at_least=0)


def _report_rival(
    bench: Bench,
    name: str,
    views: BoardViews,
    parts: tuple[np.ndarray, np.ndarray],
    answer: Any,  # noqa: ANN401 - npz
) -> None:
    rigs = [_rig_of(views, *(answer[f"{what}_{part}"] for what in ("K", "lens", "Ts_cam"))) for part in range(2)]
    none_s = np.zeros(len(views.camera_names))
    errors: list[BoardErrors] = [measure_boards(views, rigs[part], none_s, parts[1 - part]) for part in range(2)]
    bench.add(f"charuco_heldout_bias_pct_{name}", 100 * max(abs(e.bias) for e in errors), "%")
    bench.add(f"charuco_heldout_rms_mm_{name}", 1e3 * max(e.length_rms_m for e in errors), "mm")
    bench.add(f"charuco_heldout_px_{name}", max(e.rms_px for e in errors), "px")
    bench.add(f"charuco_baseline_halves_pct_{name}", 100 * disagreement(*map(baselines_m, rigs)), "%")
    bench.add(f"charuco_views_{name}", float(np.sum(answer["views"])), "pictures")


def _rig_of(views: BoardViews, K: np.ndarray, lens: np.ndarray, Ts_cam: np.ndarray) -> Rig:
    cameras = [
        Camera(
            name=name,
            image_size_px=size,
            intrinsic_px=K[c],
            distortion=np.pad(lens[c], (0, 5 - lens.shape[1])),
            T_lab_cam=inverse(Ts_cam[c]),
        )
        for c, (name, size) in enumerate(zip(views.camera_names, views.image_sizes_px, strict=True))
    ]
    return Rig(cameras=tuple(cameras), source="rival")


def _measure_photographs(bench: Bench, build_dir: Path) -> None:
    """Find the checkerboard in the balancing trial's photographs, and compare the lenses with Qualisys' own."""
    need(BALANCING)
    folders = sorted(folder for folder in PHOTOGRAPHS.glob("*") if folder.is_dir())
    board = Board(name="balancing", kind="checkerboard", corners_across=4, corners_down=7, square_m=0.06)
    pictures = {folder.name: still_pictures(sorted(folder.glob("*.[jp][pn]g"))) for folder in folders}
    tracks = find_boards(pictures, board, thorough=True)
    found = sum(int((track.corner_counts > 0).sum()) for track in tracks)
    bench.add("boards_found", found, "pictures", at_least=26, at_most=26)
    theirs = read_qualisys_calibration(PHOTOGRAPHS.parent / "Calib.qca.txt")
    off = []
    for track, camera in zip(tracks, theirs.cameras, strict=True):
        lens = solve_intrinsics(board, track.uv_px, track.image_size_px, model="k1k2")
        off.append([lens.distortion[0] - camera.distortion[0], lens.parameters[0] / camera.intrinsic_px[0, 0] - 1])
    bench.add("qualisys_k1_difference", np.abs(off)[:, 0].max(), "1", at_most=0.01)
    bench.add("qualisys_focal_difference_pct", 100 * np.abs(off)[:, 1].max(), "%", at_most=0.5)
