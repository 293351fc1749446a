"""Tracks over time, where single frames can't tell who is right."""

import numpy as np

from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.triangulation.fusion import FusedTracks, fuse
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Rig

RATE_HZ, FRAMES = 60.0, 90
TIMES_S = np.arange(FRAMES) / RATE_HZ
COURSE = np.stack([1.2 * TIMES_S - 0.9, 1.0 + 0.05 * np.sin(9 * TIMES_S), 0.03 * np.cos(5 * TIMES_S)], axis=-1)


def fuse_all(rig: Rig, uv_px: np.ndarray, confidence: np.ndarray) -> FusedTracks:
    P, focal_px, straight = projection_matrices(rig), focal_lengths_px(rig), undistort_rig(rig, uv_px)
    cameras, frames, keypoints = confidence.shape
    start = triangulate(P, focal_px, straight.reshape(cameras, -1, 2), confidence.reshape(cameras, -1)).xyz_lab_m
    start = start.reshape(frames, keypoints, 3)
    return fuse(P, focal_px, straight, confidence, start, rate_hz=RATE_HZ, cutoff_hz=8.0)


def track(rig: Rig, uv_px: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    return fuse_all(rig, uv_px[:, :, None], confidence[:, :, None]).xyz_lab_m[:, 0]


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
    uv_px[0, :, 0] += 3.0 * np.sin(8 * np.pi * np.arange(FRAMES) / FRAMES)
    shares = []
    for trust in (0.4, 0.8):
        confidence = np.full(uv_px.shape[:2], 0.8)
        confidence[0] = trust
        shares.append(np.linalg.norm(track(rig, uv_px, confidence) - still))
    # Half as sure pulls a quarter as strongly; a little more than that, since the others' weight then is more of the whole.
    assert 0.25 < shares[0] / shares[1] < 0.40


def mistake(rig: Rig, xyz: np.ndarray, rng: np.random.Generator, sigma_m: float, bias_m: float) -> np.ndarray:
    """Observe points (frame, keypoint, 3) with errors new in every frame, and others that a camera has for good."""
    uv_px = observe(rig, xyz)
    for camera, uv in zip(rig.cameras, uv_px, strict=True):
        T_cam_lab = np.linalg.inv(camera.T_lab_cam)
        px_per_m = camera.intrinsic_px[0, 0] / (xyz @ T_cam_lab[2, :3] + T_cam_lab[2, 3])
        away_m = sigma_m * rng.normal(size=uv.shape) + bias_m * rng.normal(size=uv.shape[1:])
        uv += px_per_m[..., None] * away_m
    return uv_px


def test_a_track_does_not_jump_where_a_camera_with_a_constant_error_drops_out(rig: Rig) -> None:
    rng = np.random.default_rng(4)
    still = np.tile(rng.uniform((-0.4, 0.2, -0.4), (0.4, 1.6, 0.4), (12, 3)), (FRAMES, 1, 1))
    uv_px = mistake(rig, still, rng, 0.002, 0.02)
    confidence = np.full(uv_px.shape[:3], 0.8)
    confidence[0, 30:60] = 0.0
    found = fuse_all(rig, uv_px, confidence)
    apart = found.xyz_lab_m[35:55].mean(axis=0) - found.xyz_lab_m[np.r_[5:25, 65:85]].mean(axis=0)
    # Points of three cameras and of four are 13 mm apart.
    assert np.sqrt((apart**2).sum(axis=-1).mean()) < 0.002


def test_constant_errors_are_found_and_their_part_of_the_covariance_holds_the_truth(rig: Rig) -> None:
    squares, sizes = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = COURSE[:, None] + rng.uniform((-0.3, -0.8, -0.3), (0.3, 0.6, 0.3), (20, 3))
        found = fuse_all(rig, mistake(rig, points, rng, 0.008, 0.015), np.full((4, FRAMES, 20), 0.8))
        away = found.xyz_lab_m - points
        scaled = np.linalg.solve(found.covariance_m2, away[..., None])[..., 0]
        squares.append((away * scaled).sum(axis=-1))
        sizes.append(np.sqrt((found.bias_m**2).mean()))
    assert 0.92 < np.mean(np.array(squares) < 7.815) < 0.98  # χ² with 3 degrees of freedom
    # A constant error that looks like a shifted point is not seen: of a moment's eight numbers three are the point's.
    assert np.sqrt(5 / 8) < np.mean(sizes) / 0.015 < 1.0
