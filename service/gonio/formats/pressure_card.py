"""Read a pressure card: one TOML file that says what the columns of a table of foot pressure mean.

What no table says of itself is declared here: its units, its clock, which foot is which, and where the sensors are. A table
with the columns of :data:`DEFAULT_COLUMNS` needs no card. ``docs/reference/pressure-formats.md`` explains each entry.
"""

import tomllib
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gonio.errors import InputError

DEFAULT_COLUMNS = (
    "time_s",
    "right_force_n",
    "right_along_m",
    "right_across_m",
    "left_force_n",
    "left_along_m",
    "left_across_m",
)
"""A table with these columns needs no card: force, and the centre of pressure along the sole from the back of the heel and
across it to the subject's right, both feet alike."""

MOST_SENSORS = 16384
"""Of one insole or mat. The densest insoles have some hundred; a mat of 2 m by 0.5 m with 8 mm between them has 16 000."""

FARTHEST_MM = {"insole": 500.0, "mat": 50_000.0}
"""From the heel, or from the lab's origin."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
NEWTONS = {"N": 1.0, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605}
PASCALS = {"Pa": 1.0, "kPa": 1e3, "N/cm2": 1e4, "psi": 6894.757293168}

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
_HINT = "Compare it with the examples in docs/reference/pressure-formats.md."

Name = Annotated[str, Field(min_length=1, max_length=200)]
Pair = tuple[float, float]


@dataclass(frozen=True, config=_STRICT)
class Clock:
    """The column of time stamps; ``zero`` is the time stamp at which the video starts, or the first one of the table."""

    column: Name
    unit: Literal["s", "ms", "us", "ns"]
    zero: float | Literal["first"] = 0.0


@dataclass(frozen=True, config=_STRICT)
class Force:
    """The unit of the force; ``saturation`` is the most that a foot's sensors can show, in that unit."""

    unit: Literal["N", "kN", "kgf", "lbf", "counts"]
    saturation: Annotated[float, Field(gt=0)] | None = None


@dataclass(frozen=True, config=_STRICT)
class Centre:
    """The unit and the directions of the centre of pressure: what grows along the sole, and what grows across it."""

    unit: Literal["m", "cm", "mm"]
    along: Literal["forwards", "backwards"] = "forwards"
    across: Literal["right", "left", "outwards", "inwards"] = "right"


@dataclass(frozen=True, config=_STRICT)
class Sensor:
    """What one sensor shows: a force, a pressure on its area, or counts. Values below ``threshold`` are zero."""

    unit: Literal["N", "Pa", "kPa", "N/cm2", "psi", "counts"]
    area_mm2: Annotated[float, Field(gt=0, le=1e5)] | None = None
    saturation: Annotated[float, Field(gt=0)] | None = None
    threshold: Annotated[float, Field(ge=0)] = 0.0


@dataclass(frozen=True, config=_STRICT)
class Grid:
    """Sensors in rows along the sole: the place of the first one, and the steps from row to row and within a row, mm."""

    rows: Annotated[int, Field(ge=1, le=MOST_SENSORS)]
    columns: Annotated[int, Field(ge=1, le=MOST_SENSORS)]
    first_mm: Pair
    pitch_mm: Pair


@dataclass(frozen=True, config=_STRICT)
class ForceFoot:
    """One foot's columns; ``heel`` is where the back of its heel lies in the file's own coordinates and unit."""

    force: Name
    cop: tuple[Name, Name]
    heel: Pair = (0.0, 0.0)


@dataclass(frozen=True, config=_STRICT)
class SensorField:
    """The sensors of an insole or a mat: a column each, or all in one column as a list; and where they are.

    Positions are mm, listed one by one, or as a grid whose rows follow one another: of an insole along the sole from the back
    of the heel, and across it to the subject's right.
    """

    columns: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MOST_SENSORS)] | None = None
    list_column: Name | None = None
    separator: Annotated[str, Field(min_length=1, max_length=1)] = ","
    positions_mm: Annotated[tuple[Pair, ...], Field(max_length=MOST_SENSORS)] | None = None
    grid: Grid | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class ForceCard:
    """A table with a force and its centre for each foot."""

    kind: Literal["forces"]
    decimal: Literal[".", ","] = "."
    time: Clock
    force: Force
    cop: Centre
    right: ForceFoot | None = None
    left: ForceFoot | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SensorCard:
    """A table with a value for each sensor of each foot's insole."""

    kind: Literal["sensors"]
    decimal: Literal[".", ","] = "."
    time: Clock
    sensor: Sensor
    right: SensorField | None = None
    left: SensorField | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class MatCard:
    """A table with a value for each sensor of a mat on the floor; positions are level ones in the lab, x and z, mm."""

    kind: Literal["mat"]
    decimal: Literal[".", ","] = "."
    time: Clock
    sensor: Sensor
    mat: SensorField


PressureCard = ForceCard | SensorCard | MatCard


@dataclass(frozen=True)
class _Document:
    card: Annotated[PressureCard, Field(discriminator="kind")] = field()


_ADAPTER: TypeAdapter[_Document] = TypeAdapter(_Document)


def default_card() -> ForceCard:
    """Give the card of a table with the columns :data:`DEFAULT_COLUMNS`."""
    time, right_n, right_x, right_z, left_n, left_x, left_z = DEFAULT_COLUMNS
    return ForceCard(
        kind="forces",
        time=Clock(column=time, unit="s"),
        force=Force(unit="N"),
        cop=Centre(unit="m"),
        right=ForceFoot(force=right_n, cop=(right_x, right_z)),
        left=ForceFoot(force=left_n, cop=(left_x, left_z)),
    )


def read_pressure_card(path: Path) -> PressureCard:
    """Read a card's file.

    Raises:
        InputError: ``pressure-card-unreadable``: no TOML, an entry is missing, unknown or of the wrong type, or entries
            contradict each other; ``pressure-one-foot``: it describes one foot.
    """
    try:
        card = _ADAPTER.validate_python({"card": tomllib.loads(path.read_text(encoding="utf-8-sig"))}).card
    except ValidationError as error:
        wrong = "; ".join(
            # The first two parts of a place are the document and the kind of card.
            f"{'.'.join(str(part) for part in e['loc'][2:]) or 'kind'}: {e['msg']}"
            for e in error.errors(include_url=False)[:5]
        )
        raise _unreadable(path, wrong) from error
    except (OSError, ValueError) as error:
        raise _unreadable(path, str(error).strip().split("\n")[0]) from error
    for side in ("right", "left"):
        if not isinstance(card, MatCard) and getattr(card, side) is None:
            raise InputError(
                f"{path.name} describes no {side} foot.",
                hint="What the ground does to the body is known from both feet only. Describe both in the card; without "
                "the other sole, upload no pressure, and get the angles.",
                code="pressure-one-foot",
            )
    if not isinstance(card, ForceCard):
        _check_sensors(card, path)
    return card


def parts_of(card: PressureCard) -> dict[str, ForceFoot | SensorField]:
    """Give what a card describes, by its entry's name: ``right`` and ``left``, or ``mat``."""
    if isinstance(card, MatCard):
        return {"mat": card.mat}
    return {side: foot for side, foot in (("right", card.right), ("left", card.left)) if foot is not None}


def columns_of(foot: ForceFoot | SensorField) -> tuple[str, ...]:
    """Give the columns of the table that tell of a foot."""
    if isinstance(foot, ForceFoot):
        return (foot.force, *foot.cop)
    return foot.columns if foot.columns is not None else (foot.list_column or "",)


def sensor_places_m(foot: SensorField) -> Float[np.ndarray, "sensor 2"]:
    """Give where a foot's sensors are: along the sole from the back of the heel, and across it to the right."""
    if foot.grid is None:
        return np.array(foot.positions_mm, dtype=float).reshape(-1, 2) / 1e3
    rows, columns = np.meshgrid(np.arange(foot.grid.rows), np.arange(foot.grid.columns), indexing="ij")
    steps = np.stack([rows, columns], axis=-1).reshape(-1, 2)
    return (np.array(foot.grid.first_mm) + steps * np.array(foot.grid.pitch_mm)) / 1e3


def _check_sensors(card: SensorCard | MatCard, path: Path) -> None:
    if card.sensor.unit in PASCALS and card.sensor.area_mm2 is None:
        raise _unreadable(path, f"sensor.area_mm2 is missing: a pressure in {card.sensor.unit} acts on an area")
    farthest_mm = FARTHEST_MM["mat" if isinstance(card, MatCard) else "insole"]
    for side, foot in parts_of(card).items():
        assert isinstance(foot, SensorField)
        if (foot.columns is None) == (foot.list_column is None):
            raise _unreadable(path, f"{side}: give either columns or list_column")
        if (foot.positions_mm is None) == (foot.grid is None):
            raise _unreadable(path, f"{side}: give either positions_mm or grid")
        places = sensor_places_m(foot)
        if foot.columns is not None and len(foot.columns) != len(places):
            raise _unreadable(path, f"{side}: {len(foot.columns)} columns, but {len(places)} positions")
        if not 0 < len(places) <= MOST_SENSORS:
            raise _unreadable(path, f"{side}: {len(places)} sensors; at most {MOST_SENSORS} are read")
        if 1e3 * np.abs(places).max() > farthest_mm:
            origin = "the lab's origin" if isinstance(card, MatCard) else "the heel"
            raise _unreadable(path, f"{side}: a sensor lies {1e3 * np.abs(places).max():.0f} mm from {origin}")


def _unreadable(path: Path, said: str) -> InputError:
    return InputError(f"{path.name} is no pressure card: {said}.", hint=_HINT, code="pressure-card-unreadable")
