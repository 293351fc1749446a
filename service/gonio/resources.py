"""The data that gonio ships: model cards, body models, and the cards of calibration boards."""

from pathlib import Path

_INSTALLED = Path(__file__).parent / "_data"
_CHECKOUT = Path(__file__).parents[2]


def models_dir() -> Path:
    """Give the folder with ``keypoints/`` and ``bodies/``: in the wheel, or in the checkout that is being worked on."""
    return _folder("models")


def boards_dir() -> Path:
    """Give the folder with the cards of calibration boards and their printable PDFs."""
    return _folder("calibration_boards")


def _folder(name: str) -> Path:
    return _INSTALLED / name if _INSTALLED.is_dir() else _CHECKOUT / name
