# pyright: basic, reportMissingImports=false
"""Runs in aniposelib's environment: its own detection of a ChArUco board, and its calibration of the cameras.

Usage: aniposelib_rig.py IN.npz OUT.npz VIDEO...

As caliscope_rig.py, but that aniposelib finds the optics itself.
"""

import sys
import time

import cv2
import numpy as np
from aniposelib.boards import CharucoBoard
from aniposelib.cameras import CameraGroup

MIN_CORNERS = 6


def main(given: str, out: str, *videos: str) -> None:
    """Detect the board in the videos, and solve all parts of the given corners."""
    task = np.load(given)
    square_mm = 1000 * float(task["square_m"])
    board = CharucoBoard(
        int(task["squares"][0]),
        int(task["squares"][1]),
        square_mm,
        float(task["marker_scale"]) * square_mm,
        marker_bits=4,
        dict_size=1000,
    )
    names = [str(camera) for camera in range(len(videos))]
    group = CameraGroup.from_names(names)
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    rows = group.get_rows_videos([[video] for video in videos], board, verbose=False)
    detect_s, detect_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    answer = {"views": np.array([sum(np.size(row["ids"]) >= MIN_CORNERS for row in own) for own in rows])}
    uv_px = task["uv_px"]
    seconds, cpu_seconds = [], []
    for part in range(2):
        group = CameraGroup.from_names(names)
        for camera in group.cameras:
            camera.set_size(tuple(int(side) for side in task["image_size_px"]))
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        group.calibrate_rows(
            [rows_of(uv_px[c], task[f"part_{part}"], board) for c in range(len(videos))], board, verbose=False
        )
        seconds.append(time.perf_counter() - start_s)
        cpu_seconds.append(time.process_time() - start_cpu_s)
        answer[f"K_{part}"] = np.array([camera.get_camera_matrix() for camera in group.cameras])
        answer[f"lens_{part}"] = np.array([np.ravel(camera.get_distortions())[:5] for camera in group.cameras])
        answer[f"Ts_cam_{part}"] = np.array([pose_of(camera) for camera in group.cameras])
    # The halves together are about what the whole would take: it is not solved for its own sake.
    answer["seconds"] = np.array([detect_s, sum(seconds)])
    answer["cpu_seconds"] = np.array([detect_cpu_s, sum(cpu_seconds)])
    np.savez(out, **answer)  # pyright: ignore[reportArgumentType] - NumPy's stub


def rows_of(uv_px: np.ndarray, frames: np.ndarray, board: CharucoBoard) -> list:
    """Give some frames' corners as aniposelib has them."""
    rows = []
    for frame in frames:
        (ids,) = np.nonzero(np.isfinite(uv_px[frame, :, 0]))
        if len(ids):
            corners = uv_px[frame, ids].astype(np.float32)[:, None]
            rows.append({"framenum": (0, int(frame)), "corners": corners, "ids": ids.astype(np.int32)[:, None]})
    return board.fill_points_rows(rows)


def pose_of(camera) -> np.ndarray:  # noqa: ANN001 - it has no types
    """Give the camera's pose, metres."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(camera.get_rotation())[0]
    T[:3, 3] = camera.get_translation() / 1000
    return T


if __name__ == "__main__":
    main(*sys.argv[1:])
