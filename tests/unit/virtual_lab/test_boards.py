"""A waved board: exact without noise, seen by every camera, smooth."""

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab import Clocks, make_rig, wave_board


@pytest.fixture(scope="module")
def corners() -> np.ndarray:
    """7 × 5 corners, 100 mm apart."""
    row, column = np.divmod(np.arange(35), 7)
    return np.stack([column, row, np.zeros(35)], axis=-1) * 0.1


@pytest.fixture(scope="module")
def wide():
    return make_rig(4, radius_m=3.5, height_m=2.0, focal_px=600.0)


def test_each_camera_sees_about_25_of_60_poses(corners, wide):
    for seed in range(5):
        views = np.isfinite(wave_board(corners, wide, seed=seed).uv_px[..., 0]).any(axis=-1).sum(axis=1)
        assert views.min() >= 10
        assert 16 < views.mean() < 36


def test_without_noise_corners_are_exact_projections_of_the_board(corners, wide):
    board = wave_board(corners, wide, noise_px=0.0)
    places = np.einsum("fij,cj->fci", board.T_lab_board[:, :3, :3], corners) + board.T_lab_board[:, None, :3, 3]
    for camera, uv_px in zip(wide.cameras, board.uv_px, strict=True):
        seen = np.isfinite(uv_px[..., 0])
        np.testing.assert_allclose(uv_px[seen], project(camera, places)[seen], atol=1e-9)


def test_poses_are_rigid_tilted_and_slow(corners, wide):
    T = wave_board(corners, wide, poses=600, rate_hz=20.0).T_lab_board
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (600, 1, 1)), atol=1e-12)
    assert np.linalg.det(R).min() > 0.99
    tilt = np.rad2deg(np.arcsin(-R[:, 1, 2]))
    assert tilt.max() - tilt.min() > 30
    middle = T[:, :3, 3] + R @ corners.mean(axis=0)
    speed = np.linalg.norm(np.diff(middle, axis=0), axis=1) * 20.0
    assert 0.05 < np.median(speed) < 0.6
    assert speed.max() < 1.5


def test_noise_and_seed(corners, wide):
    first, again = (wave_board(corners, wide, noise_px=0.3, seed=2) for _ in range(2))
    np.testing.assert_array_equal(first.uv_px, again.uv_px)
    assert np.nanstd(first.uv_px - first.exact_px) == pytest.approx(0.3, rel=0.05)  # 5000 numbers: 1 %


def test_parts_of_a_board_are_seen_only_where_that_is_asked(corners):
    narrow = make_rig(4, radius_m=3.5, height_m=2.0, focal_px=1200.0)  # the board leaves the pictures now and then
    whole, parts = (wave_board(corners, narrow, whole=w, noise_px=0.0).uv_px[..., 0] for w in (True, False))
    counts = np.isfinite(whole).sum(axis=-1)
    assert set(np.unique(counts)) <= {0, 35}
    assert np.isfinite(parts).sum() > np.isfinite(whole).sum()


def test_a_late_camera_sees_the_board_later(corners, wide):
    late = wave_board(corners, wide, clocks=Clocks(delay_s=0.05), seed=1)
    on_time = wave_board(corners, wide, seed=1)
    moved = np.linalg.norm(late.exact_px - on_time.exact_px, axis=-1)
    assert moved[0].max() == 0
    assert np.all(np.median(moved[1:], axis=(1, 2)) > 0.05)


def test_one_picture_is_not_enough(corners, wide):
    with pytest.raises(InputError, match="calibrate nothing"):
        wave_board(corners, wide, poses=1)
