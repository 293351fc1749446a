# pyright: basic, reportMissingImports=false
"""Runs in aniposelib's environment: its optimised triangulation of one trial, timed.

Usage: aniposelib_points.py TRIAL.npz OUT.npz LEAST_CONFIDENCE

TRIAL.npz is that of ``pose2sim_points``. Writes ``xyz`` (frame, keypoint, 3) and the seconds, the clock's and the
processor's, of the second of two calls, which compiles nothing any more.
"""

import sys
import time

import cv2
import numpy as np
from aniposelib.cameras import Camera, CameraGroup


def main(trial: str, out: str, least: str) -> None:
    """Triangulate, and write what came out."""
    data = np.load(trial)
    cameras = [
        Camera(
            matrix=K,
            dist=distortion,
            size=tuple(int(n) for n in size),
            rvec=cv2.Rodrigues(T[:3, :3])[0].ravel(),
            tvec=T[:3, 3],
            name=str(number),
        )
        for number, (K, distortion, size, T) in enumerate(
            zip(data["intrinsic_px"], data["distortion"], data["size_px"], data["T_cam_lab"], strict=True)
        )
    ]
    group = CameraGroup(cameras)
    used = data["confidence"] >= float(least)
    uv_px = np.where(used[..., None], data["uv_px"], np.nan)
    scores = np.where(used, data["confidence"], 0.0)
    for _ in range(2):
        start, start_cpu = time.perf_counter(), time.process_time()
        xyz = group.triangulate_optim(uv_px, scores=scores)
        seconds = time.perf_counter() - start, time.process_time() - start_cpu
    np.savez(out, xyz=xyz, seconds=seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
