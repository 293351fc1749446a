"""Why was no board found? Look at some pictures again and tell the card's error from the recording's."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from gonio.errors import CaptureError, GonioError
from gonio.records import Board
from gonio.vision.board_finders import find_dictionary, open_finder, wrong_card

Grey = UInt8[np.ndarray, "height width"]

ENOUGH_MARKERS = 4
"""So many markers in one picture are no accident."""

FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
            "DICT_APRILTAG_36h11", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5")  # fmt: skip
"""The smaller dictionaries of a family are the beginning of the largest."""


def shows_other_layout(pictures: Sequence[Grey], board: Board) -> bool:
    """Say whether the pictures show the board in the other layout of ChArUco boards (before or since OpenCV 4.6)."""
    if board.kind != "charuco":
        return False
    finder = open_finder(replace(board, legacy_pattern=not board.legacy_pattern))
    return any(finder.find(look) is not None for grey in pictures for look in (grey, 255 - grey))


def explain_missing(pictures: Sequence[Grey], board: Board, who: str) -> GonioError:
    """Give the error that says why the board was not found.

    ``board-card-wrong`` if the pictures show another board than the card says, ``board-not-found`` if they show none.
    """
    if board.kind == "checkerboard":
        swapped = [
            (across, down)
            for across in range(2, 16)
            for down in range(2, across + 1)
            if {across, down} != {board.corners_across, board.corners_down}
        ]
        seen = _other_checkerboard(pictures, swapped)
        return (
            wrong_card(board, f"a checkerboard of {seen[0]} × {seen[1]} inner corners")
            if seen
            else _nothing(board, who)
        )
    turned = replace(board, corners_across=board.corners_down, corners_down=board.corners_across)
    if board.corners_across != board.corners_down and _any_found(pictures, turned):
        return wrong_card(
            board, f"its counts the other way round: {board.corners_down} × {board.corners_across} inner corners"
        )
    counts = {name: max(_count_markers(grey, name) for grey in pictures) for name in FAMILIES}
    most = max(counts, key=lambda name: counts[name])
    if counts[most] < ENOUGH_MARKERS:
        return _nothing(board, who)
    family, own = most.rpartition("_")[0], board.dictionary.rpartition("_")[0]
    if family != own:
        return wrong_card(board, f"markers of the family {family}, not {own}")
    return wrong_card(board, f"{counts[most]} markers of {own}, but in other places than on the card")


def _any_found(pictures: Sequence[Grey], board: Board) -> bool:
    try:
        finder = open_finder(board)
    except GonioError:
        return False
    return any(finder.find(look) is not None for grey in pictures for look in (grey, 255 - grey))


def _count_markers(grey: Grey, dictionary: str) -> int:
    """Count the markers of a dictionary in a picture, dark on light or light on dark."""
    detector = cv2.aruco.ArucoDetector(find_dictionary(dictionary), cv2.aruco.DetectorParameters())
    found = [detector.detectMarkers(look)[1] for look in (grey, 255 - grey)]
    return max(0 if ids is None else len(ids) for ids in found)  # pyright: ignore[reportUnnecessaryComparison]


def _other_checkerboard(pictures: Sequence[Grey], sizes: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Find a checkerboard of any size: the largest that a picture shows, for the detector may stop at a part of it."""
    shown: list[tuple[int, int]] = []
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    for grey in pictures:
        scale = min(1.0, 960 / max(grey.shape))
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
        if found and (meta.shape[1], meta.shape[0]) in {*sizes, *((b, a) for a, b in sizes)}:
            shown.append((meta.shape[1], meta.shape[0]))
    return max(shown, key=lambda size: size[0] * size[1], default=None)


def _nothing(board: Board, who: str) -> CaptureError:
    return CaptureError(
        f"The board of the card {board.name} was found in no picture of {who}.",
        hint="Film it closer, in even light and without reflections, all of it in view; check that the card is the right one.",
        code="board-not-found",
    )
