"""Calibration boards, and where cameras saw their corners."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.errors import InputError
from gonio.records.record import record


@record
class Board:
    """A flat board of squares whose inner corners are known.

    ``corners_across`` × ``corners_down`` are the inner corners: one less than the squares each way. The board's frame has
    its origin at the first inner corner, X along a row, Y down the columns, Z into the paper, as seen from the front;
    corners are numbered row by row. A ChArUco board has a marker of ``dictionary`` (OpenCV's name) in every white square.
    ``inverted`` is white on black; ``legacy_pattern`` is the layout of OpenCV before 4.6.
    """

    name: str
    kind: Literal["checkerboard", "charuco"]
    corners_across: int
    corners_down: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = ""
    inverted: bool = False
    legacy_pattern: bool = False

    def __post_init__(self) -> None:
        least = 3 if self.kind == "checkerboard" else 2
        if min(self.corners_across, self.corners_down) < least or self.corner_count < 6 or not 0 < self.square_m < 10:
            raise InputError(
                f"Board {self.name}: {self.corners_across} × {self.corners_down} inner corners of {self.square_m} m "
                "are no board that can be found.",
                hint="Count the inner corners, at least 3 × 3 of a checkerboard and 2 × 3 of a ChArUco board, and measure a "
                "square in metres.",
                code="board-invalid",
            )
        if self.kind == "charuco" and not (0 < self.marker_m < self.square_m and self.dictionary):
            raise InputError(
                f"Board {self.name}: a ChArUco board needs a dictionary, and markers smaller than its squares.",
                hint="Give the dictionary's name, such as DICT_4X4_250, and measure a marker.",
                code="board-invalid",
            )

    @property
    def corner_count(self) -> int:
        """The number of inner corners."""
        return self.corners_across * self.corners_down

    @property
    def is_ambiguous(self) -> bool:
        """Whether the board looks the same when it is turned by half a turn, so that its corners can't be told apart."""
        return self.kind == "checkerboard" and self.corners_across % 2 == self.corners_down % 2

    @property
    def corners_board_m(self) -> Float[np.ndarray, "corner 3"]:
        """The inner corners in the board's frame."""
        row, column = np.divmod(np.arange(self.corner_count), self.corners_across)
        return np.stack([column, row, np.zeros_like(row)], axis=-1) * self.square_m

    @property
    def neighbours(self) -> tuple[Int[np.ndarray, "pair 2"], Int[np.ndarray, "pair_down 2"]]:
        """The pairs of corners that are one square apart: along the rows, and down the columns."""
        numbers = np.arange(self.corner_count).reshape(self.corners_down, self.corners_across)
        across = np.stack([numbers[:, :-1].ravel(), numbers[:, 1:].ravel()], axis=-1)
        return across, np.stack([numbers[:-1].ravel(), numbers[1:].ravel()], axis=-1)


@record
class BoardTrack:
    """Where one camera saw the board, in the pictures of one recording.

    ``frame_numbers`` count the recording's pictures. ``uv_px`` are pixels of the distorted image, NaN for a corner that
    was not found. ``sharpness`` compares pictures of this camera with each other (larger is sharper, 0 where no board is);
    ``mirrored`` marks the pictures in which the board was seen from behind, through the paper.
    """

    camera_name: str
    image_size_px: tuple[int, int]
    frame_numbers: Int[np.ndarray, " frame"]
    uv_px: Float[np.ndarray, "frame corner 2"]
    sharpness: Float[np.ndarray, " frame"]
    mirrored: Bool[np.ndarray, " frame"]

    @property
    def corner_counts(self) -> Int[np.ndarray, " frame"]:
        """How many corners were found in each picture."""
        return np.isfinite(self.uv_px[..., 0]).sum(axis=-1)


@record
class BoardViews:
    """Where all cameras saw the board at the same instants: frame ``i`` of every camera is the same moment.

    ``times_s`` are those moments by the first camera's clock. ``uv_px`` as in :class:`BoardTrack`.
    """

    camera_names: tuple[str, ...]
    image_sizes_px: tuple[tuple[int, int], ...]
    board: Board
    times_s: Float[np.ndarray, " frame"]
    uv_px: Float[np.ndarray, "camera frame corner 2"]

    def __post_init__(self) -> None:
        if not len(self.camera_names) == len(self.image_sizes_px) == len(self.uv_px):
            raise InputError(
                f"{len(self.camera_names)} cameras are named, but corners come from {len(self.uv_px)}.",
                hint="Name each camera and give the size of its pictures.",
            )
        if self.uv_px.shape[2] != self.board.corner_count:
            raise InputError(
                f"Board {self.board.name} has {self.board.corner_count} corners; {self.uv_px.shape[2]} were given.",
                hint="Give the card of the board that was filmed.",
            )
