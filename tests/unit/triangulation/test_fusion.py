"""Tracks over time, where single frames can't tell who is right."""

import numpy as np

from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.triangulation.fusion import fuse
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Rig

RATE_HZ, FRAMES = 60.0, 90
TIMES_S = np.arange(FRAMES) / RATE_HZ
COURSE = np.stack([1.2 * TIMES_S - 0.9, 1.0 + 0.05 * np.sin(9 * TIMES_S), 0.03 * np.cos(5 * TIMES_S)], axis=-1)


def track(rig: Rig, uv_px: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    P, focal_px, straight = projection_matrices(rig), focal_lengths_px(rig), undistort_rig(rig, uv_px)
    start = triangulate(P, focal_px, straight, confidence).xyz_lab_m
    fused = fuse(
        P, focal_px, straight[:, :, None], confidence[:, :, None], start[:, None], rate_hz=RATE_HZ, cutoff_hz=8.0
    )
    return fused.xyz_lab_m[:, 0]


def observe(rig: Rig, xyz: np.ndarray) -> np.ndarray:
    return np.stack([project(camera, xyz) for camera in rig.cameras])


def test_the_rest_of_the_track_decides_between_two_pairs_of_cameras(rig: Rig) -> None:
    uv_px = observe(rig, COURSE)
    confidence = np.full(uv_px.shape[:2], 0.8)
    burst = slice(30, 48)
    # Two cameras see the same wrong place for a third of a second, and are surer of it than the others of the right one.
    uv_px[:2, burst] = observe(rig, COURSE + np.array([0.0, 0.25, 0.1]))[:2, burst]
    confidence[:2, burst] = 0.9
    away = np.linalg.norm(track(rig, uv_px, confidence) - COURSE, axis=-1)
    # The loss leaves the wrong pair 1 % of its weight: 270 mm · 0.01, and what the smoothness rounds off.
    assert away.max() < 0.01


def test_a_quick_movement_is_no_outlier(rig: Rig) -> None:
    # A foot that kicks: 0.6 m to and fro at 2 Hz, more than 0.15 m from its half second's median at each turn.
    kick = COURSE + np.stack([0.3 * np.sin(4 * np.pi * TIMES_S), 0 * TIMES_S, 0 * TIMES_S], axis=-1)
    uv_px = observe(rig, kick)
    away = np.linalg.norm(track(rig, uv_px, np.full(uv_px.shape[:2], 0.8)) - kick, axis=-1)
    assert away.max() < 0.01


def test_surer_cameras_count_by_the_square_of_their_confidence(rig: Rig) -> None:
    still = np.tile([0.1, 1.0, 0.2], (FRAMES, 1))
    uv_px = observe(rig, still)
    uv_px[0, :, 0] += 3.0
    shares = []
    for trust in (0.4, 0.8):
        confidence = np.full(uv_px.shape[:2], 0.8)
        confidence[0] = trust
        shares.append(np.linalg.norm(track(rig, uv_px, confidence)[45] - still[45]))
    # Half as sure pulls a quarter as strongly; a little more than that, since the others' weight then is more of the whole.
    assert 0.25 < shares[0] / shares[1] < 0.40
