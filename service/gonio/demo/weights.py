"""See to it that the weights of the keypoint models are here."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from gonio.settings import Settings
from gonio.vision.model_cards import load_card
from gonio.vision.weights import ensure_weights

NEEDED = ("blazepose_detector", "blazepose_heavy")
"""What an analysis with default parameters needs."""


def ensure_models(names: Sequence[str] | None, from_files: Sequence[Path], console: Console) -> None:
    """Fetch and convert what is missing; ``from_files`` are used instead of the network, each for the models that it holds."""
    for name in names or NEEDED:
        card = load_card(name)
        console.print(f"Model: {name} ({card.licence})")
        path = ensure_weights(
            card,
            Settings().cache_dir,
            from_file=from_files[0] if len(from_files) == 1 else _file_for(name, from_files),
            progress=lambda what: console.print(f"  {what}", style="dim", soft_wrap=True),
        )
        console.print(f"  {path}", style="dim", soft_wrap=True)


def _file_for(name: str, from_files: Sequence[Path]) -> Path | None:
    """Choose among several files the one whose name speaks of the model; a package holds all of them."""
    role = name.rsplit("_", 1)[-1]
    wanted = {"detector": ("assets", "detection", "detector")}.get(role, (role,))
    named = [path for path in from_files if any(word in path.name for word in wanted)]
    packages = [path for path in from_files if path.suffix in {".tgz", ".whl", ".gz"}]
    return next(iter(named or packages), None)
