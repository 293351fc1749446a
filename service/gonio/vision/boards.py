"""Find a calibration board in the videos or photographs of several cameras.

A board may be printed white on black, and glass or thin paper shows it from behind as its own mirror image. Both are found
out on a sample of the pictures, so that the rest is searched in one way only. Every camera is searched by a thread of its own.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gonio.errors import CaptureError
from gonio.records import Board, BoardTrack
from gonio.vision.board_finders import (
    BARE_SHARE,
    MIN_CORNERS,
    BoardFinder,
    ends_after,
    last_row_seen,
    open_finder,
    square_size_px,
    wrong_card,
)
from gonio.vision.sessions import available_cores
from gonio.vision.video import iterate_frames

SAMPLES = ((16, (False,)), (4, (False,)), (4, (False, True)), (1, (False, True)))
"""Every so many pictures are tried in both polarities, ever more of them, until the board's is known; as their own mirror
image only when every other hope is gone, for few film a board through its paper."""

ENOUGH_VOTES = 3
PROGRESS_EVERY_S = 0.2
ROW_PICTURES = 12
"""So many of a camera's pictures are asked whether the board ends where its card has one row more."""

PROBE_EVERY = 8
"""Of the pictures without a board, every so many are tried in the other way too: somebody may have turned it round."""

Grey = UInt8[np.ndarray, "height width"]


class Pictures(Protocol):
    """The pictures of one camera, in order; may be gone through several times."""

    def __call__(self) -> Iterator[tuple[int, Grey]]:
        """Give each picture's number and its grey values."""
        ...


@dataclass(frozen=True)
class Look:
    """How a picture is shown to the finder: as its negative, as its mirror image."""

    inverted: bool = False
    mirrored: bool = False

    def apply(self, grey: Grey) -> Grey:
        """Turn a picture."""
        turned = 255 - grey if self.inverted else grey
        return np.ascontiguousarray(turned[:, ::-1]) if self.mirrored else turned

    def undo(self, uv_px: Float[np.ndarray, "corner 2"], width: int) -> Float[np.ndarray, "corner 2"]:
        """Turn corners back to the picture as it was: the paper seen through from behind."""
        return np.column_stack([width - 1 - uv_px[:, 0], uv_px[:, 1]]) if self.mirrored else uv_px


@dataclass
class _Found:
    """What was found in one picture."""

    uv_px: Float[np.ndarray, "corner 2"]
    look: Look
    sharpness: float


def video_pictures(path: Path, step: int = 1) -> Pictures:
    """Give every ``step``-th frame of a video as grey pictures: its luma, as it is viewed."""

    def pictures() -> Iterator[tuple[int, Grey]]:
        for frame in iterate_frames(path):
            if frame.index % step == 0:
                yield frame.index, frame.luma()

    return pictures


def find_boards(
    cameras: Mapping[str, Pictures],
    board: Board,
    *,
    thorough: bool = False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> tuple[BoardTrack, ...]:
    """Find the board in the pictures of all cameras, in their order.

    Args:
        cameras: Each camera's pictures by its name.
        board: The board; whether it is inverted is found out, whatever its card says.
        thorough: Spend more time on pictures in which the quick search fails: for photographs.
        on_progress: Hears several times a second how many pictures are done, in the caller's thread; what it raises
            stops the search.

    Raises:
        CaptureError: ``pictures-differ-in-size``.
        InputError: The card is not valid or not this board's (``board-card-wrong``), or a picture can't be read.
    """
    stop = Event()
    searches = [_Search(name, pictures, board, thorough, stop) for name, pictures in cameras.items()]
    # OpenCV works on each picture with all cores; with a thread a camera they would only be in each other's way.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(max_workers=available_cores()) as pool:
            inverted = _find_polarity(searches, board, pool)
            futures = [pool.submit(search.run, inverted) for search in searches]
            try:
                while wait(futures, timeout=PROGRESS_EVERY_S).not_done:
                    on_progress(sum(search.done for search in searches))
            finally:
                stop.set()
            for future in futures:
                future.result()
    finally:
        cv2.setNumThreads(threads)
    last = last_row_seen(board, [search.finder.shown for search in searches]) if board.kind == "charuco" else None
    if last is not None and last != board.corners_down:
        _refuse_other_rows(searches, board, last)
        for search in searches:
            search.leave_out_after(last)
    return tuple(search.track() for search in searches)


def _refuse_other_rows(searches: Sequence["_Search"], board: Board, last: int) -> None:
    """Refuse a card with more or fewer rows than the board; not one whose last rows are only covered in all pictures.

    Such a card fits the board everywhere else: its corners are found, those of a row that does not exist at the paper's edge.
    """
    card = f"the card says {board.corners_across} × {board.corners_down} inner corners, the pictures"
    if last > board.corners_down:
        raise wrong_card(board, f"{card} show more rows than that")
    ends = [end for search in searches for end in search.ends_after(last) if end is not None]
    if ends and sum(ends) >= BARE_SHARE * len(ends):
        unseen = board.corners_down - last
        raise wrong_card(board, f"{card} never show the outermost {'row' if unseen == 1 else f'{unseen} rows'}")


def _find_polarity(searches: Sequence["_Search"], board: Board, pool: ThreadPoolExecutor) -> bool:
    """Find out whether the board is white on black: try ever more pictures of all cameras until enough of them say so."""
    if board.kind == "checkerboard":
        return False  # its finder sees both alike
    for stride, sides in SAMPLES:
        list(pool.map(lambda search, stride=stride, sides=sides: search.sample(stride, sides), searches))
        votes = [found.look.inverted for search in searches for found in search.found.values()]
        if len(votes) >= ENOUGH_VOTES:
            return sum(votes) > len(votes) / 2
    return board.inverted


class _Search:
    """The search through one camera's pictures."""

    def __init__(self, name: str, pictures: Pictures, board: Board, thorough: bool, stop: Event) -> None:
        self._name = name
        self._pictures = pictures
        self._board = board
        self._thorough = thorough
        self._stop = stop
        self.done = 0
        self.finder: BoardFinder = open_finder(board)
        self._size_px: tuple[int, int] | None = None
        self._numbers: list[int] = []
        self._tried: set[int] = set()  # in every way: there is no more to try
        self._glanced: set[int] = set()  # from the front, in both polarities
        self.found: dict[int, _Found] = {}

    def sample(self, stride: int, sides: Sequence[bool]) -> None:
        """Try every ``stride``-th picture in both polarities, until the board was found often enough."""
        polarities = (self._board.inverted, not self._board.inverted)
        looks = [Look(inverted, mirrored) for mirrored in sides for inverted in polarities]
        for order, (number, grey) in enumerate(self._pictures()):
            if len(self.found) >= ENOUGH_VOTES:
                return
            seen_so = number in self.found or number in self._tried or (number in self._glanced and True not in sides)
            if order % stride == 0 and not seen_so:
                (self._tried if True in sides else self._glanced).add(number)
                self._try(number, grey, looks)

    def run(self, inverted: bool) -> None:
        """Go through all pictures, in the ways that are left."""
        has_back = self._board.kind == "charuco"
        self.found = {number: found for number, found in self.found.items() if found.look.inverted == inverted}
        sides = {found.look.mirrored for found in self.found.values()} if has_back else {False}
        misses, found_before = 0, False
        missed: tuple[int, Grey] | None = None  # the picture before, if it was searched in haste and in vain
        for number, grey in self._pictures():
            if self._stop.is_set():
                return
            self._check_size(grey)
            self._numbers.append(number)
            if number not in self.found and number not in self._tried:
                misses += 1
                probing = misses % PROBE_EVERY == 0
                known = number in self._glanced and sides == {False}
                tried = {False, True} if has_back and (probing or not sides) else sides
                thorough = self._thorough or found_before or (probing and not has_back)
                if thorough or probing or not known:
                    self._try(number, grey, [Look(inverted, side) for side in sorted(tried)], thorough=thorough)
                if missed is not None and number in self.found:
                    self._try(*missed, [self.found[number].look], thorough=True)
            found_before = number in self.found
            missed = None if found_before or number in self._tried else (number, grey)
            if found_before:
                sides.add(self.found[number].look.mirrored)
            self.done += 1

    def _try(self, number: int, grey: Grey, looks: Sequence[Look], *, thorough: bool = False) -> None:
        for look in looks:
            uv_px = self.finder.find(look.apply(grey), thorough=thorough)
            if uv_px is not None:
                uv_px = look.undo(uv_px, grey.shape[1])
                self.found[number] = _Found(uv_px, look, measure_sharpness(grey, uv_px, self._board))
                return

    def _check_size(self, grey: Grey) -> None:
        size = (grey.shape[1], grey.shape[0])
        self._size_px = self._size_px or size
        if size != self._size_px:
            raise CaptureError(
                f"The pictures of camera {self._name} differ in size: {self._size_px[0]} × {self._size_px[1]} and "
                f"{size[0]} × {size[1]} pixels.",
                hint="Give the pictures of one camera in one mode only; another resolution or zoom is another camera.",
                code="pictures-differ-in-size",
            )

    def ends_after(self, row: int) -> list[bool | None]:
        """Say of some pictures whether the board ends after a row of its squares (:func:`ends_after`)."""
        numbers = sorted(self.found)
        some = set(numbers[:: max(1, len(numbers) // ROW_PICTURES)])
        pictures = ((self.found[number], grey) for number, grey in self._pictures() if number in some)
        return [
            ends_after(255 - grey if found.look.inverted else grey, found.uv_px, self._board, row)
            for found, grey in pictures
        ]

    def leave_out_after(self, row: int) -> None:
        """Leave out the corners that only squares beyond a row confirm: there may be a hand, or the paper's edge."""
        first = row * self._board.corners_across
        for found in self.found.values():
            found.uv_px[first:] = np.nan
        self.found = {n: f for n, f in self.found.items() if np.isfinite(f.uv_px[:, 0]).sum() >= MIN_CORNERS}

    def track(self) -> BoardTrack:
        """Give what was found, picture by picture."""
        empty = np.full((self._board.corner_count, 2), np.nan)
        found = [self.found.get(number) for number in self._numbers]
        return BoardTrack(
            camera_name=self._name,
            image_size_px=self._size_px or (0, 0),
            frame_numbers=np.array(self._numbers, dtype=int),
            uv_px=np.array([f.uv_px if f else empty for f in found]).reshape(-1, *empty.shape),
            sharpness=np.array([f.sharpness if f else 0.0 for f in found]),
            mirrored=np.array([bool(f and f.look.mirrored) for f in found], dtype=bool),
        )


def measure_sharpness(grey: Grey, uv_px: Float[np.ndarray, "corner 2"], board: Board) -> float:
    """Measure how sharp the board's edges are: the steepest slope against the contrast, per pixel (1: a step in one).

    The 99th percentile of the gradient in the board's region, over the difference of its light and dark squares.
    """
    seen = uv_px[np.isfinite(uv_px[:, 0])]
    margin = square_size_px(uv_px, board) / 2
    margin = margin if np.isfinite(margin) else 4.0
    first = np.maximum(seen.min(axis=0) - margin, 0).astype(int)
    last = np.minimum(seen.max(axis=0) + margin + 1, grey.shape[::-1]).astype(int)
    region = grey[first[1] : last[1], first[0] : last[0]].astype(np.float32)
    dark, light = np.percentile(region, [10, 90])
    if light - dark < 1 or min(region.shape) < 3:
        return 0.0
    across, down = cv2.Sobel(region, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(region, cv2.CV_32F, 0, 1, scale=1 / 8)
    return float(np.percentile(np.hypot(across, down), 99) / (light - dark))
