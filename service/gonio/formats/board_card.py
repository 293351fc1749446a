"""Read a board's card: one TOML file that says what is printed on a calibration board, and on which paper.

The cards that gonio ships are in ``calibration_boards/``. Caliscope's ``charuco.toml`` is read too.
"""

import tomllib
from pathlib import Path
from typing import Any, Literal

from gonio.errors import InputError
from gonio.records import Board, record
from gonio.resources import boards_dir

PAPERS_MM = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189)}
Paper = Literal["A4", "A3", "A2", "A1", "A0"]

_HINT = "Compare it with calibration_boards/charuco_a3.toml: kind, inner_corners = [across, down], square_mm."


@record
class BoardCard:
    """A board, and the paper that it is printed on: ``landscape`` lays the long side across."""

    board: Board
    paper: Paper
    landscape: bool = True

    @property
    def page_mm(self) -> tuple[int, int]:
        """Width and height of the page."""
        short, long = PAPERS_MM[self.paper]
        return (long, short) if self.landscape else (short, long)

    def __post_init__(self) -> None:
        board = self.board
        needed = [1000 * board.square_m * (count + 1) for count in (board.corners_across, board.corners_down)]
        if any(size > page for size, page in zip(needed, self.page_mm, strict=True)):
            raise InputError(
                f"Board {board.name} is {needed[0]:g} × {needed[1]:g} mm and does not fit on {self.paper} "
                f"({self.page_mm[0]} × {self.page_mm[1]} mm).",
                hint="Take a larger paper, or smaller or fewer squares; a large board can be printed in tiles.",
                code="board-too-large",
            )


def list_board_cards() -> tuple[str, ...]:
    """List the names of the cards that gonio ships, sorted."""
    return tuple(sorted(path.stem for path in boards_dir().glob("*.toml")))


def load_board_card(name: str) -> BoardCard:
    """Read the card called ``name``.

    Raises:
        InputError: ``board-unknown``.
    """
    if name not in list_board_cards():
        raise InputError(
            f"There is no calibration board called {name!r}.",
            hint=f"Choose one of {', '.join(list_board_cards())}, or give the path of a card.",
            code="board-unknown",
        )
    return read_board_card(boards_dir() / f"{name}.toml")


def read_board_card(path: Path) -> BoardCard:
    """Read a card's file.

    Raises:
        InputError: ``board-card-unreadable``: no TOML, or an entry is missing, unknown or of the wrong type;
            ``board-invalid`` or ``board-too-large``: it says something impossible.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        if "aruco_scale" in content:
            return _from_caliscope(content, path.stem)
        return _from_card(content, path.stem)
    except InputError as error:
        raise InputError(f"{path.name}: {error.message}", hint=error.hint, code=error.code) from error
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        said = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error).strip().split("\n")[0]
        raise InputError(
            f"{path.name} is no card of a calibration board: {said}.", hint=_HINT, code="board-card-unreadable"
        ) from error


def _from_card(content: dict[str, Any], name: str) -> BoardCard:
    known = {
        "name",
        "kind",
        "inner_corners",
        "square_mm",
        "marker_mm",
        "dictionary",
        "inverted",
        "legacy_pattern",
        "print",
    }
    unknown = sorted(set(content) - known)
    if unknown:
        raise ValueError(f"it has no entry called {unknown[0]}")
    across, down = content["inner_corners"]
    board = Board(
        name=str(content.get("name", name)),
        kind=content["kind"],
        corners_across=across,
        corners_down=down,
        square_m=float(content["square_mm"]) / 1000,
        marker_m=float(content.get("marker_mm", 0.0)) / 1000,
        dictionary=content.get("dictionary", ""),
        inverted=content.get("inverted", False),
        legacy_pattern=content.get("legacy_pattern", False),
    )
    printing = content.get("print", {})
    return BoardCard(
        board=board,
        paper=printing.get("paper", _smallest_paper(board)),
        landscape=printing.get("landscape", across >= down),
    )


def _from_caliscope(content: dict[str, Any], name: str) -> BoardCard:
    """Read Caliscope's card: squares instead of inner corners, centimetres; without them the board fills its paper."""
    columns, rows = int(content["columns"]), int(content["rows"])
    square_cm = content.get("square_size_override_cm")
    if not square_cm:
        unit_cm = {"inch": 2.54, "cm": 1.0}[content["units"]]
        square_cm = min(content["board_width"] / columns, content["board_height"] / rows) * unit_cm
    square_m = float(square_cm) / 100
    board = Board(
        name=name,
        kind="charuco",
        corners_across=columns - 1,
        corners_down=rows - 1,
        square_m=square_m,
        marker_m=square_m * float(content["aruco_scale"]),
        dictionary=content["dictionary"],
        inverted=bool(content.get("inverted", False)),
        legacy_pattern=bool(content.get("legacy_pattern", False)),
    )
    return BoardCard(board=board, paper=_smallest_paper(board), landscape=columns >= rows)


def _smallest_paper(board: Board) -> Paper:
    sizes = sorted(1000 * board.square_m * (count + 1) for count in (board.corners_across, board.corners_down))
    for paper in ("A4", "A3", "A2", "A1"):
        if all(size <= page for size, page in zip(sizes, PAPERS_MM[paper], strict=True)):
            return paper
    return "A0"
