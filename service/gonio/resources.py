"""The data that gonio ships: model cards and body models."""

from pathlib import Path

_INSTALLED = Path(__file__).parent / "_data" / "models"
_CHECKOUT = Path(__file__).parents[2] / "models"


def models_dir() -> Path:
    """Give the folder with ``keypoints/`` and ``bodies/``: in the wheel, or in the checkout that is being worked on."""
    return _INSTALLED if _INSTALLED.is_dir() else _CHECKOUT
