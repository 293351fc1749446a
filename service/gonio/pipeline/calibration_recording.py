"""Stages ``recording``, ``lens-boards``, ``boards`` and ``floor-boards``: where the cameras saw the board."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gonio.errors import CaptureError, InputError
from gonio.pipeline.calibration_files import CameraPictures
from gonio.pipeline.capture import common_time
from gonio.pipeline.findings import finding
from gonio.pipeline.run import Outcome, Progress
from gonio.records import Board, BoardTrack, BoardViews, Finding, record
from gonio.vision.board_diagnosis import explain_missing, shows_other_layout
from gonio.vision.boards import Pictures, find_boards, video_pictures
from gonio.vision.stills import still_pictures
from gonio.vision.video import probe_video

MAX_PICTURES = 600
"""More pictures of a sweep than these tell nothing new: a minute at ten a second."""

MAX_LENS_PICTURES = 200
STILLS_PERIOD_S = 10.0
"""Photographs were taken at rest, so far apart that nothing is concluded about the motion between them."""

SAMPLE_PICTURES = 6
FEW_FOUND, FEW_SHARE = 3, 0.05
"""A wrong card shares some markers with the board, and is found by accident: in less than so many pictures, or less than
this share of them, the pictures are asked what they show."""

FEW_ROWS_PICTURES = 10
"""In fewer pictures a row may be out of sight by chance."""

MAX_CAMERAS = 16


@record
class SweepPlan:
    """Which pictures of the sweep are looked at: every ``steps``-th frame of each camera's video.

    ``paths`` are a video each, or photographs. ``times_s`` are the pictures' times; ``frame_period_s`` is that of the
    videos themselves.
    """

    board: Board
    camera_names: tuple[str, ...]
    paths: tuple[tuple[Path, ...], ...]
    steps: tuple[int, ...]
    times_s: tuple[float, ...]
    frame_period_s: float
    is_video: bool


def read_sweep(cameras: Sequence[CameraPictures], board: Board, pictures_per_s: float) -> Outcome[SweepPlan]:
    """Probe the sweep's recordings and choose the pictures to look at.

    Raises:
        CaptureError: ``too-few-cameras``, ``too-many-cameras``.
        InputError: ``board-ambiguous-turned``: several cameras can't tell this checkerboard's corners apart;
            ``calibration-files-mixed``, ``pictures-differ-in-number``, ``video-rates-differ``, or what a video says.
    """
    if len(cameras) < 2:
        raise CaptureError(
            f"The sweep was filmed by {len(cameras)} camera{'' if len(cameras) == 1 else 's'}; a rig has two or more.",
            hint="Give one video a camera, all of them filmed at the same time.",
            code="too-few-cameras",
        )
    if len(cameras) > MAX_CAMERAS:
        raise CaptureError(
            f"The sweep was filmed by {len(cameras)} cameras; gonio calibrates up to {MAX_CAMERAS}.",
            hint="Leave some out.",
            code="too-many-cameras",
        )
    if board.is_ambiguous:
        raise InputError(
            f"The checkerboard {board.name} looks the same when it is turned round: no two cameras could agree on its corners.",
            hint="Take a board with an odd and an even count of inner corners, or a ChArUco board.",
            code="board-ambiguous-turned",
        )
    names = tuple(camera.camera for camera in cameras)
    paths = tuple(camera.paths for camera in cameras)
    if all(camera.is_video for camera in cameras):
        return _plan_videos(names, paths, board, pictures_per_s)
    if any(camera.is_video for camera in cameras):
        raise InputError(
            "Some cameras' sweeps are videos, others' are photographs.",
            hint="Give videos of all cameras, or photographs of all.",
            code="calibration-files-mixed",
        )
    counts = {camera.camera: len(camera.paths) for camera in cameras}
    if len(set(counts.values())) != 1:
        raise InputError(
            f"The cameras have different numbers of photographs: {', '.join(f'{n} {c}' for n, c in counts.items())}.",
            hint="Photograph each pose of the board with all cameras; the first picture of each belongs together, and so on.",
            code="pictures-differ-in-number",
        )
    times_s = tuple(STILLS_PERIOD_S * index for index in range(len(paths[0])))
    return Outcome(
        SweepPlan(
            board=board,
            camera_names=names,
            paths=paths,
            steps=(1,) * len(names),
            times_s=times_s,
            frame_period_s=STILLS_PERIOD_S,
            is_video=False,
        )
    )


def _plan_videos(
    names: tuple[str, ...], paths: tuple[tuple[Path, ...], ...], board: Board, pictures_per_s: float
) -> Outcome[SweepPlan]:
    infos = [probe_video(own[0]) for own in paths]
    timebase, count, steps, findings = common_time(names, infos)
    stride = max(1, round(timebase.rate_hz / pictures_per_s), -(-count // MAX_PICTURES))
    return Outcome(
        SweepPlan(
            board=board,
            camera_names=names,
            paths=paths,
            steps=tuple(step * stride for step in steps),
            times_s=tuple((np.arange(0, count, stride) / timebase.rate_hz).tolist()),
            frame_period_s=1.0 / timebase.rate_hz,
            is_video=True,
        ),
        findings,
    )


def find_sweep(plan: SweepPlan, progress: Progress) -> Outcome[BoardViews]:
    """Find the board in all cameras' pictures of the sweep.

    Raises:
        InputError: ``board-card-wrong``: the pictures show another board.
        CaptureError: ``board-not-found``, ``pictures-differ-in-size``.
    """
    pictures = {
        name: video_pictures(paths[0], step) if plan.is_video else still_pictures(paths)
        for name, paths, step in zip(plan.camera_names, plan.paths, plan.steps, strict=True)
    }
    total = len(plan.times_s) * len(pictures)
    tracks, findings = _find(pictures, plan.board, total, progress, thorough=not plan.is_video)
    count = len(plan.times_s)
    uv_px = np.full((len(tracks), count, plan.board.corner_count, 2), np.nan)
    for camera, track in enumerate(tracks):
        known = min(count, len(track.uv_px))
        uv_px[camera, :known] = _sharp_ones(track)[:known]
    views = BoardViews(
        camera_names=plan.camera_names,
        image_sizes_px=tuple(track.image_size_px for track in tracks),
        board=plan.board,
        times_s=np.array(plan.times_s),
        uv_px=uv_px,
    )
    return Outcome(views, findings)


def find_lens_boards(
    cameras: Sequence[CameraPictures], board: Board, progress: Progress
) -> Outcome[tuple[BoardTrack, ...]]:
    """Find the board in the recordings that were made of it for each lens alone.

    Raises:
        InputError: ``board-card-wrong``.
        CaptureError: ``board-not-found``, ``pictures-differ-in-size``.
    """
    pictures: dict[str, Pictures] = {}
    total = 0
    for camera in cameras:
        if camera.is_video:
            count = probe_video(camera.paths[0]).frame_count
            step = max(1, count // MAX_LENS_PICTURES)
            pictures[camera.camera] = video_pictures(camera.paths[0], step)
            total += count // step
        else:
            pictures[camera.camera] = still_pictures(camera.paths)
            total += len(camera.paths)
    if not pictures:
        return Outcome(())
    thorough = not any(camera.is_video for camera in cameras)
    tracks, findings = _find(pictures, board, total, progress, thorough=thorough)
    return Outcome(tracks, findings)


def find_floor_boards(cameras: Sequence[CameraPictures], views: BoardViews) -> Outcome[BoardViews | None]:
    """Find the board in the pictures of it on the floor; the first pictures of all cameras belong together, and so on.

    Raises:
        CaptureError: ``board-not-found``.
    """
    if not cameras:
        return Outcome(None)
    pictures = {
        camera.camera: video_pictures(camera.paths[0]) if camera.is_video else still_pictures(camera.paths)
        for camera in cameras
        if camera.camera in views.camera_names
    }
    tracks, findings = _find(pictures, views.board, 1, lambda fraction: None, thorough=True)
    count = max(len(track.uv_px) for track in tracks)
    uv_px = np.full((len(views.camera_names), count, views.board.corner_count, 2), np.nan)
    for track in tracks:
        uv_px[views.camera_names.index(track.camera_name), : len(track.uv_px)] = track.uv_px
    return Outcome(replace(views, times_s=STILLS_PERIOD_S * np.arange(count), uv_px=uv_px), findings)


def _find(
    pictures: dict[str, Pictures], board: Board, total: int, progress: Progress, *, thorough: bool
) -> tuple[tuple[BoardTrack, ...], tuple[Finding, ...]]:
    """Find the board, in its other layout if need be; say why where it is nowhere."""

    def share(done: int) -> None:
        progress(min(done / max(total, 1), 1.0))

    tracks = find_boards(pictures, board, thorough=thorough, on_progress=share)
    found = sum(int((track.corner_counts > 0).sum()) for track in tracks)
    if found >= max(FEW_FOUND, FEW_SHARE * sum(len(track.frame_numbers) for track in tracks)):
        return tracks, _rows_unseen(tracks, board)
    sample = [picture for source in pictures.values() for picture in _spread(source, SAMPLE_PICTURES)]
    if not shows_other_layout(sample, board):
        reason = explain_missing(sample, board, ", ".join(pictures))
        if found and reason.code != "board-card-wrong":
            return tracks, ()
        raise reason
    other = replace(board, legacy_pattern=not board.legacy_pattern)
    tracks = find_boards(pictures, other, thorough=thorough, on_progress=share)
    return tracks, (finding("board-layout"),)


def _rows_unseen(tracks: Sequence[BoardTrack], board: Board) -> tuple[Finding, ...]:
    """Tell of the outermost rows of corners that no picture confirmed (:func:`gonio.vision.boards.find_boards`)."""
    seen = np.any([np.isfinite(track.uv_px[..., 0]).any(axis=0) for track in tracks], axis=0)
    rows = np.flatnonzero(seen.reshape(board.corners_down, board.corners_across).any(axis=1))
    unseen = board.corners_down - 1 - int(rows.max(initial=-1))
    enough = sum(int((track.corner_counts > 0).sum()) for track in tracks) >= FEW_ROWS_PICTURES
    return (finding("board-rows-unseen", value=unseen),) if unseen and enough and board.kind == "charuco" else ()


def _spread(source: Pictures, count: int) -> list[np.ndarray]:
    """Give some pictures that are spread over a recording."""
    numbers = [number for number, _ in source()]
    wanted = {numbers[i] for i in np.unique(np.linspace(0, len(numbers) - 1, count).astype(int))} if numbers else set()
    return [grey for number, grey in source() if number in wanted]


def _sharp_ones(track: BoardTrack) -> np.ndarray:
    """Leave out the pictures that are clearly blurred against this camera's others."""
    seen = track.sharpness > 0
    limit = 0.6 * np.percentile(track.sharpness[seen], 75) if seen.any() else 0.0
    return np.where((track.sharpness >= limit)[:, None, None], track.uv_px, np.nan)
