"""Find the corners of a calibration board in one picture: ChArUco and checkerboard.

A finder is given a grey picture in which the board is seen from the front and, if it is a ChArUco board, dark on light.
:mod:`gonio.vision.boards` tries the picture's negative and mirror image and turns the result back.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gonio.errors import InputError
from gonio.records import Board

MIN_CORNERS = 6
GATE_PX, GATE_SQUARES = 4.0, 0.15
"""A corner may lie this far from the plane through the others, whichever is more: 4 pixels, or what a strong lens bends
within a board that fills the picture."""

LEAST_WINDOW_PX, SMALL_WINDOW_PX = 3.0, 2
"""OpenCV's window about a corner of a ChArUco board, half its side; and the one that small boards' corners are found in."""

AGREEING = 0.8
"""This share of the markers in a picture must be the card's, and in their places within their square."""

ROW_SEEN = 20
"""A row whose markers were seen so often, in five pictures or more, while the next one's never were, is the board's last
one or the last one that is not covered."""

BARE_STRIP = 0.15
"""This far below the last row's squares, as a share of one, a board that ends there shows bare paper; the next row would
show its dark squares."""

LIGHT_SHARE, BARE_SHARE = 0.7, 0.6
"""Bare paper is as light as this, between dark and light squares; and in this share of the pictures."""

LINE_CONTRAST, LINE_BEYOND = 0.25, 0.5
"""The squares of a checkerboard's outermost line must differ by so much of what those inside it do (a hand may cover some);
those of a line beyond it, which a larger board would show, by less than this."""

SEARCH_SIDE_PX = 960
"""A checkerboard is searched for in a picture of at most this size, and its corners are then located in the whole one."""


class BoardFinder(Protocol):
    """Finds a board's corners in a grey picture: (corner, 2) pixels, NaN where not found; None without a board."""

    def find(
        self, grey: UInt8[np.ndarray, "height width"], *, thorough: bool = False
    ) -> Float[np.ndarray, "corner 2"] | None:
        """Look for the board; ``thorough`` spends more time on a difficult picture."""
        ...

    @property
    def shown(self) -> Counter[int]:
        """How many markers were seen in each row of squares, the one below the last included; for last_row_seen."""
        ...


def open_finder(board: Board) -> BoardFinder:
    """Make the finder for a board.

    Raises:
        InputError: ``board-dictionary-unknown``, or ``board-dictionary-small`` if it has too few markers.
    """
    return CharucoFinder(board) if board.kind == "charuco" else CheckerboardFinder(board)


def last_row_seen(board: Board, shown: Iterable[Counter[int]]) -> int:
    """Give the last row of squares whose markers were ever seen, by a ChArUco board's card the last is ``corners_down``.

    More than that if the pictures show a row that the card has not; and the card's own last one where too little was seen
    to tell.

    Args:
        board: What the card says.
        shown: What the finders of all cameras saw (:attr:`BoardFinder.shown`).
    """
    total: Counter[int] = sum(shown, Counter())
    down = board.corners_down
    if total[down + 1] >= ROW_SEEN:
        return down + 1
    last = max((row for row in range(down + 1) if total[row]), default=down)
    return last if total[last] >= ROW_SEEN else down


def ends_after(
    grey: UInt8[np.ndarray, "height width"], uv_px: Float[np.ndarray, "corner 2"], board: Board, row: int
) -> bool | None:
    """Say whether bare paper follows a row of a ChArUco board's squares (dark on light); None where it can't be seen.

    A row that is covered in all pictures and one that the board does not have look alike to the detector. Under the last
    row of a board there is its margin, light all along; under any other one every second square is dark.
    """
    across = np.arange(board.corners_across + 1) - 0.5
    below = _sample(grey, uv_px, board, np.column_stack([across, np.full_like(across, row + BARE_STRIP)]))
    columns, rows = np.meshgrid(np.arange(board.corners_across + 1), np.arange(row + 1))
    edge = (1 - board.marker_m / board.square_m) / 4  # half-way from a square's side to its marker
    beside = _sample(grey, uv_px, board, np.column_stack([columns.ravel() - 1 + edge, rows.ravel() - 1 + edge]))
    if np.isnan(below).any() or np.isnan(beside).sum() > beside.size / 2:
        return None
    dark, light = np.nanpercentile(beside, [20, 80])
    return bool((below > dark + LIGHT_SHARE * (light - dark)).all())


def _sample(
    grey: UInt8[np.ndarray, "height width"],
    uv_px: Float[np.ndarray, "corner 2"],
    board: Board,
    places: Float[np.ndarray, "place 2"],
) -> Float[np.ndarray, " place"]:
    """Give the grey values at places of the board's plane, in squares from the first inner corner; NaN outside the picture."""
    seen = np.isfinite(uv_px[:, 0])
    H, _ = cv2.findHomography(board.corners_board_m[seen, :2] / board.square_m, uv_px[seen])
    at = cv2.perspectiveTransform(places[:, None].astype(np.float64), H)[:, 0]
    inside = np.all((at >= 0) & (at <= np.array(grey.shape[::-1]) - 1), axis=1)
    values = cv2.remap(grey, at[:, None].astype(np.float32), None, cv2.INTER_LINEAR)[:, 0].astype(np.float64)  # pyright: ignore[reportCallIssue, reportArgumentType] - the second map is optional
    return np.where(inside, values, np.nan)


def wrong_card(board: Board, shown: str) -> InputError:
    """Give the error of a card that says another board than the pictures show: ``board-card-wrong``."""
    return InputError(
        f"The pictures show another board than the card {board.name} says: {shown}.",
        hint="Give the card of the board that was filmed; inner corners are one less than the squares, across and down.",
        code="board-card-wrong",
    )


def find_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Give OpenCV's dictionary of markers by name.

    Raises:
        InputError: ``board-dictionary-unknown``.
    """
    known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
    if name not in known:
        raise InputError(
            f"There is no dictionary of markers called {name}.",
            hint=f"Known are {', '.join(known)}.",
            code="board-dictionary-unknown",
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def open_charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Make OpenCV's object of a ChArUco board.

    Raises:
        InputError: ``board-dictionary-unknown``, or ``board-dictionary-small`` if it has too few markers.
    """
    dictionary = find_dictionary(board.dictionary)
    squares = (board.corners_across + 1, board.corners_down + 1)
    needed, available = squares[0] * squares[1] // 2, len(dictionary.bytesList)
    if needed > available:
        raise InputError(
            f"Board {board.name} needs {needed} markers; {board.dictionary} has {available}.",
            hint="Take a larger dictionary of the same kind, for instance with 250 or 1000 markers.",
            code="board-dictionary-small",
        )
    made = cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, dictionary)
    made.setLegacyPattern(board.legacy_pattern)
    return made


class CharucoFinder:
    """Finds ChArUco boards, also partly hidden ones.

    OpenCV's detector has already refined the corners when it gives them. Refining again spoils those of a large board: the
    window then reaches the markers (0.146 became 0.249 px on real boards). Those of a small one it looks for in a window of a
    pixel or two beside a place that is off by as much: they are looked for again, from where the plane has them.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        parameters = cv2.aruco.CharucoParameters()
        # One marker beside a corner is enough: a third more corners. False ones are caught by the gate.
        parameters.minMarkers = 1
        made = open_charuco_board(board)
        self._exact = cv2.aruco.CharucoDetector(made, parameters, cv2.aruco.DetectorParameters())
        # Two of the three window sizes of the threshold: nearly as many boards in half the time.
        quick = cv2.aruco.DetectorParameters()
        quick.adaptiveThreshWinSizeStep = quick.adaptiveThreshWinSizeMax - quick.adaptiveThreshWinSizeMin
        self._quick = cv2.aruco.CharucoDetector(made, parameters, quick)
        self._markers = _marker_places(board)
        self._beyond = self._markers | _row_beyond(board)
        self.shown: Counter[int] = Counter()

    def find(
        self, grey: UInt8[np.ndarray, "height width"], *, thorough: bool = False
    ) -> Float[np.ndarray, "corner 2"] | None:
        """Look for the board; ``thorough`` also tries the slower search where the quick one finds nothing."""
        found = self._look(self._quick, grey)
        if (found is None and not thorough) or (found is not None and np.isfinite(found).all()):
            return found
        more = self._look(self._exact, grey)
        better = found is None or (more is not None and np.isfinite(more).sum() > np.isfinite(found).sum())
        return more if better else found

    def _look(
        self, detector: cv2.aruco.CharucoDetector, grey: UInt8[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "corner 2"] | None:
        corners, ids, markers, marker_ids = detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:  # pyright: ignore[reportUnnecessaryComparison] - None without any
            return None
        uv_px = np.full((self._board.corner_count, 2), np.nan)
        uv_px[np.asarray(ids, dtype=int).ravel()] = np.asarray(corners).reshape(-1, 2)
        gated = gate(uv_px, self._board)
        if gated is None or not self._markers_agree(gated, markers, marker_ids):
            return None
        return self._sharpen(grey, gated)

    def _sharpen(
        self, grey: UInt8[np.ndarray, "height width"], uv_px: Float[np.ndarray, "corner 2"]
    ) -> Float[np.ndarray, "corner 2"] | None:
        """Refine the corners again where OpenCV's window, as far as the markers less two pixels, was too small."""
        margin = 0.5 * (1.0 - (self._board.marker_m or 0.0) / self._board.square_m)
        if np.sqrt(2.0) * margin * square_size_px(uv_px, self._board) - 2.0 >= LEAST_WINDOW_PX:
            return uv_px
        seen = np.flatnonzero(np.isfinite(uv_px[:, 0]))
        plane = (self._board.corners_board_m[seen, :2] / self._board.square_m).astype(np.float64)
        H, _ = cv2.findHomography(plane, uv_px[seen], cv2.LMEDS)
        if H is None:  # pyright: ignore[reportUnnecessaryComparison] - it is, where no four corners agree
            return uv_px
        start = cv2.perspectiveTransform(plane[:, None], H).astype(np.float32)
        inside = ((start[:, 0] > 0) & (start[:, 0] < np.array(grey.shape[::-1]) - 1)).all(axis=1)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        sharp = np.full_like(uv_px, np.nan)
        sharp[seen[inside]] = cv2.cornerSubPix(grey, start[inside], (SMALL_WINDOW_PX,) * 2, (-1, -1), stop)[:, 0]
        return gate(sharp, self._board)

    def _markers_agree(
        self, uv_px: Float[np.ndarray, "corner 2"], markers: Sequence[np.ndarray], marker_ids: np.ndarray
    ) -> bool:
        """Say whether most markers are where the corners have them: a wrong card fits a few squares by accident."""
        seen = np.isfinite(uv_px[:, 0])
        H, _ = cv2.findHomography(self._board.corners_board_m[seen, :2], uv_px[seen])
        pairs = zip(np.ravel(marker_ids).tolist(), markers, strict=True)
        known = [(number, self._beyond[number], marker) for number, marker in pairs if number in self._beyond]
        if not known:
            return False
        there = cv2.perspectiveTransform(np.array([[place] for _, place, _ in known]), H)[:, 0]
        here = np.array([np.asarray(marker).reshape(4, 2).mean(axis=0) for _, _, marker in known])
        near = np.linalg.norm(there - here, axis=1) < square_size_px(uv_px, self._board) / 1.5
        agreeing = [place for (_, place, _), is_near in zip(known, near, strict=True) if is_near]
        if len(agreeing) < AGREEING * len(np.ravel(marker_ids)):
            return False
        self.shown.update(round(float(place[1] / self._board.square_m + 0.5)) for place in agreeing)
        return True


def _marker_places(board: Board) -> dict[int, np.ndarray]:
    """Give the middle of each marker in the board's frame, by its number."""
    made = open_charuco_board(board)
    outer = np.array([board.square_m, board.square_m])  # from OpenCV's origin to ours
    return {
        int(number): np.asarray(corners)[:, :2].mean(axis=0) - outer
        for number, corners in zip(np.asarray(made.getIds()).ravel(), made.getObjPoints(), strict=True)
    }


def _row_beyond(board: Board) -> dict[int, np.ndarray]:
    """Give the markers that the board would have below its last row, if it had one row more than its card says."""
    # The older layout begins with the other colour when the number of rows is even; the row beyond goes on as the board does.
    needed = (board.corners_across + 1) * (board.corners_down + 2) // 2
    if needed > len(find_dictionary(board.dictionary).bytesList) or board.legacy_pattern:
        return {}
    own = _marker_places(board)
    longer = _marker_places(replace(board, corners_down=board.corners_down + 1))
    return {number: place for number, place in longer.items() if number not in own}


class CheckerboardFinder:
    """Finds complete checkerboards: the classic search in a small picture, the sector-based one where that fails.

    The corners are then located in the full picture by the sector-based detector, which is twice as exact as corner
    refinement (0.13 against 0.20 px on real boards), within the region that the search gave.
    """

    CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE

    def __init__(self, board: Board) -> None:
        self._board = board
        self._size = (board.corners_across, board.corners_down)
        self.shown: Counter[int] = Counter()  # nothing: only a checkerboard of just this size is found

    def find(
        self, grey: UInt8[np.ndarray, "height width"], *, thorough: bool = False
    ) -> Float[np.ndarray, "corner 2"] | None:
        """Look for the board; ``thorough`` also tries the slow search, about 100 ms, where the quick one fails."""
        scale = min(1.0, SEARCH_SIDE_PX / max(grey.shape))
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        found, corners = cv2.findChessboardCorners(small, self._size, flags=self.CLASSIC)
        if not found and thorough:
            found, corners = cv2.findChessboardCornersSB(small, self._size, flags=cv2.CALIB_CB_EXHAUSTIVE)
        if not found:
            return None
        rough = unscaled(corners, grey.shape, small.shape)
        located = self._locate(grey, rough, thorough)
        return None if located is None else self._ordered(grey, located)

    def _locate(
        self, grey: UInt8[np.ndarray, "height width"], rough_px: Float[np.ndarray, "corner 2"], thorough: bool
    ) -> Float[np.ndarray, "corner 2"] | None:
        square_px = square_size_px(rough_px, self._board)
        first = np.maximum(rough_px.min(axis=0) - 1.6 * square_px, 0).astype(int)
        last = np.minimum(rough_px.max(axis=0) + 1.6 * square_px + 1, grey.shape[::-1]).astype(int)
        region = np.ascontiguousarray(grey[first[1] : last[1], first[0] : last[0]])
        exact = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        for flags in (exact,) if thorough else (cv2.CALIB_CB_EXHAUSTIVE, exact):
            found, corners = cv2.findChessboardCornersSB(region, self._size, flags=flags)
            if found and (located := self._whole(grey, np.asarray(corners).reshape(-1, 2) + first)) is not None:
                return located
        window = max(2, int(0.25 * square_px))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        start = rough_px.astype(np.float32).reshape(-1, 1, 2)
        refined = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), stop)
        return self._whole(grey, np.asarray(refined).reshape(-1, 2))

    def _whole(
        self, grey: UInt8[np.ndarray, "height width"], uv_px: np.ndarray
    ) -> Float[np.ndarray, "corner 2"] | None:
        """Accept a board only with all of its corners, and no part of a larger one: no marker tells which part it is."""
        gated = gate(uv_px.astype(np.float64), self._board, right_handed=False)
        whole = gated is not None and np.isfinite(gated).all() and is_whole(grey, gated, self._board)
        return gated if whole else None

    def _ordered(self, grey: np.ndarray, uv_px: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "corner 2"]:
        """Number the corners as seen from the front, the first one beside the dark square of the board's outer corner."""
        rows = uv_px.reshape(self._board.corners_down, self._board.corners_across, 2)
        if orientation(uv_px, self._board) < 0:
            rows = rows[:, ::-1]
        if not self._board.is_ambiguous and not _starts_dark(grey, rows):
            rows = rows[::-1, ::-1]
        return rows.reshape(-1, 2).copy()


def is_whole(grey: UInt8[np.ndarray, "height width"], uv_px: Float[np.ndarray, "corner 2"], board: Board) -> bool:
    """Say whether a checkerboard's outermost squares are where its card says, and none further out.

    The detector finds a part of a larger board, and beside a smaller one takes the paper's edge for a line of corners.
    """
    rows, columns = np.arange(-1, board.corners_down + 2), np.arange(-1, board.corners_across + 2)
    row, column = np.meshgrid(rows, columns, indexing="ij")  # of squares: 0 is the outermost, -1 beyond it
    places = np.column_stack([column.ravel() - 0.5, row.ravel() - 0.5])
    values = _sample(grey, uv_px, board, places).reshape(row.shape)
    even = (row + column) % 2 == 0

    def contrast(line: tuple[slice | int, slice | int]) -> float:
        of_even, of_odd = values[line][even[line]], values[line][~even[line]]
        return float(np.nanmedian(of_even) - np.nanmedian(of_odd)) if _any(of_even) and _any(of_odd) else np.nan

    usual = contrast((slice(2, -2), slice(2, -2)))
    if usual == 0:
        return False
    along = slice(1, -1)
    outermost = [contrast(line) / usual for line in ((1, along), (-2, along), (along, 1), (along, -2))]
    beyond = [contrast(line) / usual for line in ((0, along), (-1, along), (along, 0), (along, -1))]
    return not any(c < LINE_CONTRAST for c in outermost) and not any(c > LINE_BEYOND for c in beyond)


def _any(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).any())


def unscaled(corners: np.ndarray, shape: tuple[int, ...], small: tuple[int, ...]) -> Float[np.ndarray, "corner 2"]:
    """Turn pixels of a smaller picture into those of the whole one; a pixel's centre is at a whole number in both."""
    ratio = np.array([shape[1] / small[1], shape[0] / small[0]])
    return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5


def square_size_px(uv_px: Float[np.ndarray, "corner 2"], board: Board) -> float:
    """Give the median distance of neighbouring corners; NaN where no two neighbours were found."""
    pairs = np.concatenate(board.neighbours)
    lengths = np.linalg.norm(uv_px[pairs[:, 0]] - uv_px[pairs[:, 1]], axis=1)
    known = lengths[np.isfinite(lengths)]
    return float(np.median(known)) if known.size else np.nan


def orientation(uv_px: Float[np.ndarray, "corner 2"], board: Board) -> float:
    """Give the sign of the area that the corners span: negative for a board seen from behind."""
    seen = np.isfinite(uv_px[:, 0])
    plane = board.corners_board_m[seen, :2]
    slopes = np.linalg.lstsq(np.column_stack([plane, np.ones(len(plane))]), uv_px[seen], rcond=None)[0]
    return float(np.sign(np.linalg.det(slopes[:2])))


def gate(
    uv_px: Float[np.ndarray, "corner 2"], board: Board, *, right_handed: bool = True
) -> Float[np.ndarray, "corner 2"] | None:
    """Keep the corners that lie on one plane seen in perspective; None if they are too few or say too little.

    At least six, in two rows and two columns. With ``right_handed`` a board that seems to be seen from behind is refused:
    its markers were misread.
    """
    seen = np.flatnonzero(np.isfinite(uv_px[:, 0]))
    if len(seen) < MIN_CORNERS:
        return None
    square_px = square_size_px(uv_px, board)
    limit_px = max(GATE_PX, GATE_SQUARES * square_px if np.isfinite(square_px) else 0.0)
    plane = (board.corners_board_m[seen, :2] / board.square_m).astype(np.float64)
    H, inliers = cv2.findHomography(plane, uv_px[seen], cv2.RANSAC, limit_px)
    if H is None:  # pyright: ignore[reportUnnecessaryComparison] - it is, where no four corners agree
        return None
    kept = seen[np.asarray(inliers).ravel() > 0]
    rows, columns = np.divmod(kept, board.corners_across)
    if len(kept) < MIN_CORNERS or len(set(rows)) < 2 or len(set(columns)) < 2:
        return None
    gated = np.full_like(uv_px, np.nan)
    gated[kept] = uv_px[kept]
    return gated if not right_handed or orientation(gated, board) > 0 else None


def _starts_dark(grey: np.ndarray, rows: Float[np.ndarray, "row column 2"]) -> bool:
    """Say whether the square inside the first corner is dark, against the one beside it: then the outermost one is too."""
    centres = (rows[:-1, :-1] + rows[1:, 1:] + rows[:-1, 1:] + rows[1:, :-1]) / 4
    across, down = np.rint(np.moveaxis(centres, -1, 0)).astype(int)
    values = grey[np.clip(down, 0, grey.shape[0] - 1), np.clip(across, 0, grey.shape[1] - 1)].astype(float)
    row, column = np.indices(values.shape)
    even = (row + column) % 2 == 0
    return bool(values[even].mean() < values[~even].mean())
