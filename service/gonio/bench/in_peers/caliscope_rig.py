# pyright: basic, reportMissingImports=false
"""Runs in Caliscope's environment: its own detection of a ChArUco board, and its calibration of the cameras' poses.

Usage: caliscope_rig.py IN.npz OUT.npz OPTICS.toml VIDEO...

IN holds the corners (camera, frame, corner, 2) that both programs solve, the frames of each part (``part_0`` …) and the board.
OUT gets each part's cameras (``K_0``, ``lens_0``, ``Ts_cam_0`` …), the pictures in which Caliscope itself found six corners,
and the seconds that detection and the solution of the first part took.
"""

import sys
import time

import numpy as np
import pandas as pd
from caliscope.api import (
    CameraArray,
    CaptureVolume,
    Charuco,
    CharucoTracker,
    ImagePoints,
    extract_image_points_multicam,
)

MIN_CORNERS = 6


def main(given: str, out: str, optics: str, *videos: str) -> None:
    """Detect the board in the videos, and solve all parts of the given corners."""
    task = np.load(given)
    board = Charuco.from_squares(
        columns=int(task["squares"][0]),
        rows=int(task["squares"][1]),
        square_size_cm=100 * float(task["square_m"]),
        dictionary=str(task["dictionary"]),
        aruco_scale=float(task["marker_scale"]),
        inverted=True,
    )
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    found = extract_image_points_multicam(dict(enumerate(videos)), CharucoTracker(board), progress=None)
    detect_s, detect_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    counts = found.df.groupby(["cam_id", "sync_index"]).size() >= MIN_CORNERS
    views = [int(counts[camera].sum()) if camera in counts.index else 0 for camera in range(len(videos))]
    answer = {"views": np.array(views)}
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    CaptureVolume.bootstrap(found, CameraArray.from_toml(optics)).optimize()
    answer["seconds"] = np.array([detect_s, time.perf_counter() - start_s])
    answer["cpu_seconds"] = np.array([detect_cpu_s, time.process_time() - start_cpu_s])
    for part in range(2):
        points = points_of(task["uv_px"], task["corners_board_m"], task[f"part_{part}"], float(task["rate_hz"]))
        volume = CaptureVolume.bootstrap(points, CameraArray.from_toml(optics)).optimize()
        cameras = [volume.camera_array.cameras[camera] for camera in range(len(videos))]
        answer[f"K_{part}"] = np.array([camera.matrix for camera in cameras])
        answer[f"lens_{part}"] = np.array([np.ravel(camera.distortions)[:5] for camera in cameras])
        answer[f"Ts_cam_{part}"] = np.array([camera.transformation for camera in cameras])
    np.savez(out, **answer)  # pyright: ignore[reportArgumentType] - NumPy's stub


def points_of(uv_px: np.ndarray, corners_board_m: np.ndarray, frames: np.ndarray, rate_hz: float) -> ImagePoints:
    """Give some frames' corners as Caliscope has them."""
    camera, frame, corner = np.nonzero(np.isfinite(uv_px[:, frames])[..., 0])
    pixels = uv_px[camera, frames[frame], corner]
    return ImagePoints(
        pd.DataFrame(
            {
                "sync_index": frames[frame],
                "cam_id": camera,
                "frame_index": frames[frame],
                "frame_time": frames[frame] / rate_hz,
                "object_id": 0,
                "keypoint_id": corner,
                "img_loc_x": pixels[:, 0],
                "img_loc_y": pixels[:, 1],
                "obj_loc_x": corners_board_m[corner, 0],
                "obj_loc_y": corners_board_m[corner, 1],
                "obj_loc_z": 0.0,
            }
        )
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
