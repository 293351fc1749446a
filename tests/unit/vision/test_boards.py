"""Boards are found in rendered pictures: inverted, from behind, cut off; and what is no board is not."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from gonio.bench.board_sessions import BOARD
from gonio.errors import CaptureError, InputError
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab import make_rig
from gonio.records import Board
from gonio.vision.board_diagnosis import explain_missing, shows_other_layout
from gonio.vision.board_drawing import render_board
from gonio.vision.boards import find_boards
from gonio.vision.render import Print, draw_board
from gonio.vision.stills import read_grey

CHECKERS = Board(name="checkers", kind="checkerboard", corners_across=7, corners_down=4, square_m=0.06)
CAMERA = make_rig(1, radius_m=1.6, height_m=1.2, target_m=(0.0, 1.0, 0.0), focal_px=700.0).cameras[0]


def pose(seed: int, shift_m: float = 0.1) -> np.ndarray:
    """A board before the camera, tilted by up to 30°: ``T_lab_board``."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
    middle = BOARD.corners_board_m.mean(axis=0)
    T[:3, 3] = [*rng.uniform(-shift_m, shift_m, 2), 1.6] - T[:3, :3] @ middle
    return CAMERA.T_lab_cam @ T


def printed(board: Board) -> Print:
    return Print(render_board(board, 60), board.square_m / 60, (1.5 * 60 - 0.5,) * 2)


def shoot(board: Board, seeds=range(5), **how) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures of a board, and where its corners are in them."""
    poses = [pose(seed, **how) for seed in seeds]
    corners = [project(CAMERA, board.corners_board_m @ T[:3, :3].T + T[:3, 3]) for T in poses]
    return [draw(board, T.tobytes(), n).copy() for n, T in enumerate(poses)], corners


@cache
def draw(board: Board, T_lab_board: bytes, seed: int) -> np.ndarray:
    """A picture that several tests take; the pose as bytes, since arrays can't be looked up."""
    return draw_board(CAMERA, np.frombuffer(T_lab_board).reshape(4, 4), printed(board), seed=seed)


def find(pictures: list[np.ndarray], board: Board, **how):
    return find_boards({"cam": lambda: iter(enumerate(pictures))}, board, **how)[0]


@pytest.mark.parametrize("inverted", [False, True])
def test_a_charuco_board_is_found_and_so_is_its_negative_unasked(inverted: bool) -> None:
    board = replace(BOARD, inverted=inverted)
    pictures, corners = shoot(board)
    track = find(pictures, BOARD)
    assert (track.corner_counts == BOARD.corner_count).all()
    error = np.linalg.norm(track.uv_px - corners, axis=-1)
    assert np.median(error) < 0.15  # 0.15 px is what the reference's real boards have, here with a blur of 0.7 px
    assert (track.sharpness > 0).all()
    assert not track.mirrored.any()


def test_a_board_seen_through_its_paper_is_found_where_it_is() -> None:
    pictures, corners = shoot(BOARD)
    behind = [np.ascontiguousarray(picture[:, ::-1]) for picture in pictures]
    track = find(behind, BOARD)
    assert track.mirrored.all()
    there = np.stack(corners)
    there[..., 0] = CAMERA.image_size_px[0] - 1 - there[..., 0]
    assert np.median(np.linalg.norm(track.uv_px - there, axis=-1)) < 0.15


def test_a_part_of_a_charuco_board_is_enough() -> None:
    pictures, corners = shoot(BOARD)
    for picture in pictures:
        picture[:, 380:] = 96  # somebody stands before its right half
    track = find(pictures, BOARD)
    seen = np.isfinite(track.uv_px[..., 0])
    assert (seen.sum(axis=1) >= 6).all()
    assert not seen.all()
    error = np.linalg.norm(track.uv_px - corners, axis=-1)[seen]
    # A corner beside somebody's edge may be drawn to it, as far as the gate allows; the others are as good as ever.
    assert np.median(error) < 0.15
    assert error.max() < 4.0


def test_checkerboards_are_found_whole_and_only_where_they_are() -> None:
    pictures, corners = shoot(CHECKERS)
    wall = np.full_like(pictures[0], 96)
    track = find([*pictures, wall], CHECKERS, thorough=True)
    assert track.corner_counts.tolist() == [CHECKERS.corner_count] * 5 + [0]
    assert np.median(np.linalg.norm(track.uv_px[:5] - corners, axis=-1)) < 0.15


def test_progress_is_told_and_can_stop_the_search() -> None:
    class Enough(Exception):
        pass

    def stop(done: int) -> None:
        raise Enough

    pictures = shoot(CHECKERS, seeds=range(1))[0] * 200
    with pytest.raises(Enough):
        find(pictures, CHECKERS, thorough=True, on_progress=stop)


def test_pictures_of_different_sizes_are_refused() -> None:
    pictures, _ = shoot(BOARD, seeds=range(2))
    with pytest.raises(CaptureError) as caught:
        find([*pictures, pictures[0][:-2]], BOARD)
    assert caught.value.code == "pictures-differ-in-size"


@pytest.mark.parametrize(
    ("card", "code", "words"),
    [
        ({"corners_across": 5, "corners_down": 7}, "board-card-wrong", "the other way round"),
        ({"dictionary": "DICT_6X6_100"}, "board-card-wrong", "DICT_5X5"),
        ({}, "board-not-found", "no picture"),
    ],
)
def test_why_no_board_was_found(card, code, words) -> None:
    pictures, _ = shoot(BOARD, seeds=range(2)) if card else ([np.full((540, 720), 96, np.uint8)], None)
    wanted = replace(BOARD, **card)
    reason = explain_missing(pictures, wanted, "cam")
    assert reason.code == code
    assert words in reason.message
    assert not shows_other_layout(pictures, wanted)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (1, "the card says 7 × 6 inner corners, the pictures never show the outermost row"),
        (2, "never show the outermost 2 rows"),
        (-1, "the card says 7 × 4 inner corners, the pictures show more rows than that"),
    ],
)
def test_a_card_with_other_rows_than_the_board_is_refused_by_name(rows, words) -> None:
    # All other corners are where such a card has them, and at the paper's edge there is something like a corner.
    pictures, _ = shoot(BOARD)
    with pytest.raises(InputError) as caught:
        find(pictures, replace(BOARD, corners_down=BOARD.corners_down + rows))
    assert caught.value.code == "board-card-wrong"
    assert words in caught.value.message


def test_a_row_that_is_always_covered_is_left_out_and_not_refused() -> None:
    pictures, corners = shoot(BOARD, seeds=range(8))
    last = BOARD.corners_down - 1
    covered = np.array([[-1.3, last + 0.03], [7.3, last + 0.03], [7.3, last + 1.5], [-1.3, last + 1.5]])
    for picture, seen in zip(pictures, corners, strict=True):
        H, _ = cv2.findHomography(BOARD.corners_board_m[:, :2] / BOARD.square_m, seen)
        cv2.fillConvexPoly(picture, cv2.perspectiveTransform(covered[:, None], H).astype(int), 70)
    track = find(pictures, BOARD)
    rows = track.uv_px.reshape(8, BOARD.corners_down, BOARD.corners_across, 2)
    assert np.isfinite(rows[:, :last]).all()
    assert np.isnan(rows[:, last]).all()


@pytest.mark.parametrize(("across", "down"), [(8, 4), (6, 3), (7, 5), (6, 4)])
def test_a_checkerboard_with_another_count_of_squares_is_not_taken_for_the_cards(across, down) -> None:
    pictures, _ = shoot(CHECKERS)
    card = replace(CHECKERS, corners_across=across, corners_down=down)
    assert not find(pictures, card, thorough=True).corner_counts.any()
    assert "7 × 4" in explain_missing(pictures[:2], card, "cam").message


@pytest.mark.parametrize(("kind", "across", "down"), [("checkerboard", 7, 2), ("charuco", 2, 2), ("charuco", 1, 8)])
def test_boards_that_no_detector_can_find_are_refused(kind, across, down) -> None:
    with pytest.raises(InputError) as caught:
        replace(BOARD, kind=kind, corners_across=across, corners_down=down)
    assert caught.value.code == "board-invalid"


def test_a_checkerboard_of_another_size_is_named() -> None:
    pictures, _ = shoot(CHECKERS)
    reason = explain_missing(pictures, replace(CHECKERS, corners_across=9, corners_down=6), "cam")
    assert reason.code == "board-card-wrong"
    assert "7 × 4" in reason.message or "4 × 7" in reason.message


def test_the_other_layout_is_recognised() -> None:
    # The layouts differ for even numbers of rows of squares only.
    old = Board(name="old", kind="charuco", corners_across=4, corners_down=5, square_m=0.1, marker_m=0.075,
                dictionary="DICT_4X4_50", legacy_pattern=True)  # fmt: skip
    pictures, _ = shoot(old)
    new = Board(name="new", kind="charuco", corners_across=4, corners_down=5, square_m=0.1, marker_m=0.075,
                dictionary="DICT_4X4_50")  # fmt: skip
    assert shows_other_layout(pictures, new)
    assert (find(pictures, old).corner_counts > 0).all()


def test_unknown_dictionaries_and_too_small_ones_are_refused() -> None:
    for dictionary, code in (("DICT_9X9_1", "board-dictionary-unknown"), ("DICT_4X4_50", "board-dictionary-small")):
        board = Board(name="b", kind="charuco", corners_across=20, corners_down=20, square_m=0.1, marker_m=0.07,
                      dictionary=dictionary)  # fmt: skip
        with pytest.raises(InputError) as caught:
            find([np.zeros((540, 720), np.uint8)], board)
        assert caught.value.code == code


def test_photographs_of_any_depth_are_read_alike(tmp_path) -> None:
    pictures, corners = shoot(BOARD, seeds=[0])
    deep = pictures[0].astype(np.uint16) * 8 + 300  # twelve bits of a machine-vision camera
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    cv2.imwrite(str(tmp_path / "grey.png"), pictures[0])
    cv2.imwrite(str(tmp_path / "colour.png"), cv2.cvtColor(pictures[0], cv2.COLOR_GRAY2BGR))
    np.testing.assert_array_equal(read_grey(tmp_path / "grey.png"), pictures[0])
    np.testing.assert_array_equal(read_grey(tmp_path / "colour.png"), pictures[0])
    track = find([read_grey(tmp_path / "deep.png")], BOARD)
    assert np.median(np.linalg.norm(track.uv_px[0] - corners[0], axis=-1)) < 0.2
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("no picture")
    for name, code in (("empty", "image-empty"), ("text", "image-unreadable"), ("none", "image-missing")):
        with pytest.raises(InputError) as caught:
            read_grey(tmp_path / f"{name}.png")
        assert caught.value.code == code
