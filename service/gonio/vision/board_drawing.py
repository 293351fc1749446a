"""What is printed on a calibration board: its dark and light rectangles, exactly, and a picture of them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from gonio.records import Board, record
from gonio.vision.board_finders import find_dictionary, open_charuco_board


@record
class BoardDrawing:
    """Rectangles (x, y, width, height) in metres from the board's outer corner, x to the right, y down.

    They are painted one after the other, each dark or light, on a light ground (dark for an inverted board).
    """

    size_m: tuple[float, float]
    rectangles_m: Float[np.ndarray, "rectangle 4"]
    dark: Bool[np.ndarray, " rectangle"]
    dark_ground: bool


def draw_board(board: Board) -> BoardDrawing:
    """Give what is printed on a board.

    Raises:
        InputError: ``board-dictionary-unknown``, ``board-dictionary-small``.
    """
    columns, rows = board.corners_across + 1, board.corners_down + 1
    markers = _markers(board) if board.kind == "charuco" else {}
    squares = [
        (column, row)
        for row in range(rows)
        for column in range(columns)
        if ((column, row) not in markers if markers else (column + row) % 2 == 0)
    ]
    painted = [
        (column * board.square_m, row * board.square_m, board.square_m, board.square_m) for column, row in squares
    ]
    dark = [True] * len(painted)
    for (x, y), cells in markers.values():
        painted.append((x, y, board.marker_m, board.marker_m))
        dark.append(True)
        runs = _light_runs(cells)
        cell = board.marker_m / len(cells)
        painted += [(x + cell * left, y + cell * top, cell * wide, cell * high) for left, top, wide, high in runs]
        dark += [False] * len(runs)
    return BoardDrawing(
        size_m=(columns * board.square_m, rows * board.square_m),
        rectangles_m=np.array(painted, dtype=np.float64),
        dark=np.array(dark) != board.inverted,
        dark_ground=board.inverted,
    )


def _markers(board: Board) -> dict[tuple[int, int], tuple[tuple[float, float], np.ndarray]]:
    """Give each square with a marker: the marker's outer corner in metres, and its cells (True: light)."""
    made, dictionary = open_charuco_board(board), find_dictionary(board.dictionary)
    side = dictionary.markerSize + 2  # a cell of border all round
    found: dict[tuple[int, int], tuple[tuple[float, float], np.ndarray]] = {}
    for number, corners in zip(np.asarray(made.getIds()).ravel(), made.getObjPoints(), strict=True):
        x, y = np.asarray(corners)[:, :2].min(axis=0)
        cells = cv2.aruco.generateImageMarker(dictionary, int(number), side)
        square = int((x + board.marker_m / 2) // board.square_m), int((y + board.marker_m / 2) // board.square_m)
        inset = (board.square_m - board.marker_m) / 2  # computed anew: OpenCV keeps its corners in single precision
        corner = square[0] * board.square_m + inset, square[1] * board.square_m + inset
        found[square] = corner, np.asarray(cells) > 127
    return found


def _light_runs(cells: Bool[np.ndarray, "row column"]) -> list[tuple[int, int, int, int]]:
    """Give the light cells as rows and as columns of neighbours: overlapping, so that no seam shows between them."""
    runs: list[tuple[int, int, int, int]] = []
    for turned, lines in ((False, cells), (True, cells.T)):
        for line, values in enumerate(lines):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]]).astype(int)))
            for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                runs.append((line, start, 1, stop - start) if turned else (start, line, stop - start, 1))
    return runs


def render_board(board: Board, px_per_square: int, margin_squares: float = 0.5) -> UInt8[np.ndarray, "height width"]:
    """Give a picture of the board, seen straight from the front, with a margin of the ground's colour.

    The board's frame has its origin, the first inner corner, at pixel ``(1 + margin) · px_per_square − 0.5`` both ways.
    """
    drawing, scale = draw_board(board), px_per_square / board.square_m
    margin = round(margin_squares * px_per_square)
    width, height = (round(size * scale) + 2 * margin for size in drawing.size_m)
    picture = np.full((height, width), 0 if drawing.dark_ground else 255, np.uint8)
    for (x, y, wide, high), dark in zip(
        drawing.rectangles_m * scale + [margin, margin, 0, 0], drawing.dark, strict=True
    ):
        rows, columns = slice(round(y), round(y + high)), slice(round(x), round(x + wide))
        picture[rows, columns] = 0 if dark else 255
    return picture
