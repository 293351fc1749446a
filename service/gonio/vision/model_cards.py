"""Model cards: what a keypoint model is, where its weights come from, and how its numbers are read.

A card is one TOML file in ``models/keypoints/`` with the same tables as the records here. Weights are never committed:
a card pins the sha256 of the file that it was written for, so that a report can be traced to the exact network.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from gonio.errors import InputError
from gonio.records import record
from gonio.resources import models_dir


@record
class WeightSource:
    """A registry package that contains the weights.

    ``member`` is the file's path inside the package, ``sha256`` that file's digest (hexadecimal). ``integrity`` is the
    digest of the whole package as npm writes it (``sha512-`` and base64); empty where packages differ by platform.
    """

    registry: Literal["npm", "pypi"]
    package: str
    version: str
    member: str
    sha256: str
    integrity: str = ""

    @property
    def filename(self) -> str:
        """The file's name without its folders."""
        return self.member.rsplit("/", 1)[-1]


@record
class ModelInput:
    """The network's input: a square RGB picture of ``size_px``, its values scaled to ``range``."""

    size_px: int
    range: tuple[float, float]


@record
class Keypoints:
    """The points of a landmark model.

    ``names`` are the points that a report knows, ``auxiliary`` further points of the network that only steer the next
    crop.
    """

    names: tuple[str, ...]
    auxiliary: tuple[str, ...]


@record
class Refinement:
    """How landmarks are refined from their heatmaps: a window in heatmap cells, and the peak that is worth it."""

    window: int
    min_confidence: float


@record
class Detection:
    """How a detector's output is read: its anchors' strides in input pixels, and two thresholds between 0 and 1.

    Boxes below ``min_score`` are dropped; two whose intersection over union is above ``max_overlap`` are one person.
    """

    anchor_strides_px: tuple[int, ...]
    min_score: float
    max_overlap: float


@record
class ModelCard:
    """One keypoint model. ``outputs`` maps the tensor names of the source file to the names that gonio uses.

    A detector has ``detection``, a landmark model has ``refinement`` and ``keypoints``.
    """

    name: str
    kind: Literal["detector", "landmarks"]
    licence: str
    credit: str
    input: ModelInput
    outputs: Mapping[str, str]
    sources: tuple[WeightSource, ...]
    keypoints: Keypoints | None = None
    refinement: Refinement | None = None
    detection: Detection | None = None

    @property
    def source(self) -> str:
        """Where the weights come from in the first place."""
        return f"{self.sources[0].registry} package {self.sources[0].package} {self.sources[0].version}"

    def __post_init__(self) -> None:
        needed = ("detection",) if self.kind == "detector" else ("keypoints", "refinement")
        missing = [table for table in needed if getattr(self, table) is None]
        if missing:
            raise InputError(
                f"Model {self.name} is of kind {self.kind} but has no table [{'], ['.join(missing)}].",
                hint="Add it as in models/keypoints/blazepose_heavy.toml or blazepose_detector.toml.",
                code="model-card-invalid",
            )


def list_cards() -> tuple[str, ...]:
    """List the names of the cards that gonio ships, sorted."""
    return tuple(sorted(path.stem for path in _folder().glob("*.toml")))


def load_card(name: str) -> ModelCard:
    """Read the card called ``name``.

    Raises:
        InputError: There is no such card (``model-unknown``).
    """
    if name not in list_cards():
        raise InputError(
            f"There is no keypoint model called {name!r}.",
            hint=f"Choose one of: {', '.join(list_cards())}.",
            code="model-unknown",
        )
    return read_card(_folder() / f"{name}.toml")


def read_card(path: Path) -> ModelCard:
    """Read a card's file.

    Raises:
        InputError: It is no TOML, or an entry is missing, unknown or of the wrong type (``model-card-invalid``).
    """
    records = {"input": ModelInput, "keypoints": Keypoints, "refinement": Refinement, "detection": Detection}
    try:
        card = _tuples(tomllib.loads(path.read_text(encoding="utf-8")))
        tables = {key: build(**card[key]) for key, build in records.items() if key in card}
        sources = tuple(WeightSource(**source) for source in card.get("sources", ()))
        return ModelCard(**(card | tables | {"sources": sources}))
    except InputError as error:
        raise InputError(f"Model card {path.name}: {error.message}", hint=error.hint, code=error.code) from error
    except (ValueError, TypeError) as error:  # no TOML; or the records' own check of names and types
        reason = " ".join(str(error).strip().splitlines()[:2])
        raise InputError(
            f"Model card {path.name} is not valid: {reason}",
            hint="Compare it with models/keypoints/blazepose_heavy.toml; gonio.vision.model_cards explains each entry.",
            code="model-card-invalid",
        ) from error


def _folder() -> Path:
    return models_dir() / "keypoints"


def _tuples(value: Any) -> Any:  # noqa: ANN401 - whatever TOML can hold
    """Turn TOML's lists into tuples, at every depth: records hold no lists."""
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    return tuple(_tuples(entry) for entry in value) if isinstance(value, list) else value
