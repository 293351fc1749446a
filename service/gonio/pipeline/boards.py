"""Make printable calibration boards from their cards."""

from pathlib import Path

from gonio.errors import InputError
from gonio.formats.board_card import PAPERS_MM, BoardCard, Paper
from gonio.vision.board_drawing import draw_board


def print_board(card: BoardCard, path: Path, tile_paper: Paper | None = None) -> int:
    """Write a board's PDF, whole or in tiles of a smaller paper; give the number of pages.

    Raises:
        InputError: ``board-dictionary-unknown``, ``board-dictionary-small``.
    """
    from gonio.formats.board_pdf import write_board_pdf  # with matplotlib: slow to load

    drawing = draw_board(card.board)
    return write_board_pdf(
        path,
        describe_board(card),
        (1000 * drawing.size_m[0], 1000 * drawing.size_m[1]),
        1000 * drawing.rectangles_m,
        drawing.dark,
        dark_ground=drawing.dark_ground,
        page_mm=card.page_mm,
        tile_mm=PAPERS_MM[tile_paper] if tile_paper else None,
    )


def describe_board(card: BoardCard) -> str:
    """Say in a line what a board is: what an operator needs to find its card again."""
    board = card.board
    words = f"{board.name}: {board.corners_across} × {board.corners_down} inner corners, squares {1000 * board.square_m:g} mm"
    if board.kind == "charuco":
        words += f", markers {1000 * board.marker_m:g} mm, {board.dictionary}"
    return words + (", inverted" if board.inverted else "")


def paper_named(name: str) -> Paper:
    """Give a paper by name.

    Raises:
        InputError: ``paper-unknown``.
    """
    for paper in ("A4", "A3", "A2", "A1", "A0"):
        if name.upper() == paper:
            return paper
    raise InputError(
        f"There is no paper called {name}.", hint=f"Choose one of {', '.join(PAPERS_MM)}.", code="paper-unknown"
    )


def card_text(corners: str, square_mm: float, paper: Paper, dictionary: str, *, inverted: bool) -> str:
    """Write a card's text; a marker is three quarters of its square.

    Raises:
        InputError: ``board-invalid``: the corners are not two counts.
    """
    counts = corners.lower().replace("×", "x").split("x")
    if len(counts) != 2 or not all(count.strip().isdigit() for count in counts):
        raise InputError(
            f"{corners} are no counts of inner corners.", hint="Give them as across x down: 8x5.", code="board-invalid"
        )
    across, down = (int(count) for count in counts)
    lines = [
        f'kind = "{"charuco" if dictionary else "checkerboard"}"',
        f"inner_corners = [{across}, {down}]  # across, down",
    ]
    lines.append(f"square_mm = {square_mm:g}")
    if dictionary:
        lines += [f"marker_mm = {0.75 * square_mm:g}", f'dictionary = "{dictionary}"']
    lines += [f"inverted = {str(inverted).lower()}", "", "[print]", f'paper = "{paper}"']
    return "\n".join([*lines, f"landscape = {str(across >= down).lower()}", ""])
