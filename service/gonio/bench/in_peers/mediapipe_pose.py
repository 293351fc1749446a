# pyright: basic, reportMissingImports=false
"""Runs in MediaPipe's environment: its own pose solution on single frames of videos.

Usage: mediapipe_pose.py OUT.npz COMPLEXITY STEP VIDEO...

Writes an array (frame, 33, 2) per video, in pixels: the landmarks times the picture's width and height; NaN where nobody
was found.
"""

import sys
from pathlib import Path
from typing import Any

import cv2
import mediapipe
import numpy as np


def main(out: str, complexity: str, step: str, *videos: str) -> None:
    """Find the pose in every ``step``-th frame of each video, each frame on its own."""
    found = {}
    with mediapipe.solutions.pose.Pose(static_image_mode=True, model_complexity=int(complexity)) as pose:
        for video in videos:
            capture, frames = cv2.VideoCapture(video), []
            while True:
                index = len(frames)
                is_read, bgr = capture.read()
                if not is_read:
                    break
                frames.append(find(pose, bgr) if index % int(step) == 0 else None)
            found[Path(video).stem] = np.array([frame for frame in frames if frame is not None])
    np.savez(out, **found)


def find(
    pose: Any,  # noqa: ANN401 - it has no types
    bgr: np.ndarray,
) -> np.ndarray:
    """Give the landmarks of one picture in pixels."""
    landmarks = pose.process(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)).pose_landmarks
    if landmarks is None:
        return np.full((33, 2), np.nan)
    height, width = bgr.shape[:2]
    return np.array([[point.x * width, point.y * height] for point in landmarks.landmark])


if __name__ == "__main__":
    main(*sys.argv[1:])
