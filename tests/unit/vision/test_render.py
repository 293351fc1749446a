"""Drawn boards and walkers show what they should, where it should be."""

import av
import cv2
import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab import make_rig, walk, wave_board
from gonio.kernel.virtual_lab.harmonics import coordinates_at
from gonio.kernel.virtual_lab.shape import capsules_of, hidden, place
from gonio.records import Walk
from gonio.resources import models_dir
from gonio.vision.render import GREY, Print, draw_board, draw_walk, print_checkerboard, write_video


@pytest.fixture(scope="module")
def camera():
    return make_rig(focal_px=1400.0, image_size_px=(1280, 960)).cameras[0]


@pytest.fixture(scope="module")
def walker() -> Walk:
    return walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.25)


def corners_of(across, down, square_m):
    row, column = np.divmod(np.arange(across * down), across)
    return np.stack([column, row, np.zeros(across * down)], axis=-1) * square_m


def test_a_detector_finds_the_corners_where_they_are():
    corners = corners_of(7, 4, 0.12)
    rig = make_rig(focal_px=900.0, image_size_px=(800, 600))
    board = wave_board(corners, rig, noise_px=0.0, seed=3)
    printed, found, errors = print_checkerboard(7, 4, 0.12), 0, []
    for frame in np.flatnonzero(np.isfinite(board.uv_px[0, :, 0, 0]))[:2]:
        picture = draw_board(rig.cameras[0], board.T_lab_board[frame], printed)
        ok, seen = cv2.findChessboardCornersSB(picture, (7, 4), flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        if ok:
            found += 1
            exact, seen = board.exact_px[0, frame], seen.reshape(-1, 2)
            errors.append(min(np.abs(seen - exact).mean(), np.abs(seen[::-1] - exact).mean()))
    assert found == 2
    # OpenCV finds corners of a clean picture to about 0.05 px; a shift by half a pixel anywhere would be 0.5.
    assert np.median(errors) < 0.15


def test_a_charuco_board_is_read(camera):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    charuco = cv2.aruco.CharucoBoard((5, 4), 0.15, 0.11, dictionary)

    picture = np.asarray(charuco.generateImage((500, 400)), dtype=np.uint8)
    T_lab_board = np.eye(4)
    T_lab_board[:3, :3] = camera.T_lab_cam[:3, :3]  # facing the camera
    T_lab_board[:3, 3] = [-0.3, 1.3, 0.0]
    drawn = draw_board(camera, T_lab_board, Print(picture, 0.75 / 500, (99.5, 99.5)))
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(drawn)
    assert len(ids) == 12
    first = corners.reshape(-1, 2)[ids.ravel() == 0][0]
    np.testing.assert_allclose(first, project(camera, T_lab_board[:3, 3]), atol=0.3)


def test_boards_from_behind_and_out_of_sight_leave_the_picture_empty(camera):
    printed = print_checkerboard(7, 4, 0.12)
    behind = np.eye(4)
    behind[:3, :3] = camera.T_lab_cam[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    behind[:3, 3] = [0.0, 1.2, 0.0]
    away = np.eye(4)
    away[:3, :3], away[:3, 3] = camera.T_lab_cam[:3, :3], camera.centre_lab_m - 2.0 * camera.T_lab_cam[:3, 2]
    for pose in (behind, away):
        assert np.all(draw_board(camera, pose, printed, noise=0.0) == GREY)


def test_pictures_repeat_with_the_seed(camera, walker):
    first, again, other = (next(draw_walk(camera, walker, np.array([1.0]), seed=s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_walker_is_drawn_where_his_joints_are(camera, walker):
    times = np.array([1.0, 1.4, 1.8])
    capsules = capsules_of(walker.body)
    placed = place(walker.body, capsules, coordinates_at(walker, times).q)
    middles = (placed.start_m + placed.end_m) / 2
    seen = ~hidden(camera.centre_lab_m, middles, placed)
    empty = next(draw_walk(camera, walker, np.array([-60.0]), noise=0.0))  # the walker is far away
    for frame, picture in enumerate(draw_walk(camera, walker, times, noise=0.0)):
        changed = np.abs(picture.astype(int) - empty).max(axis=-1) > 8
        for point in project(camera, middles[frame][seen[frame]]):
            column, row = np.round(point).astype(int)
            assert changed[row, column]
        assert 0.005 < changed.mean() < 0.1


def test_a_video_keeps_every_frame(camera, walker, tmp_path):
    small = make_rig(focal_px=300.0, image_size_px=(320, 240)).cameras[0]
    write_video(tmp_path / "walk.mp4", draw_walk(small, walker, np.arange(12) / 30), 30.0)
    with av.open(str(tmp_path / "walk.mp4")) as container:
        frames = list(container.decode(video=0))
        assert float(container.streams.video[0].average_rate) == 30.0
    assert len(frames) == 12
    assert (frames[0].width, frames[0].height) == (320, 240)
