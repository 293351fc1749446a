"""Norm cards (``models/norms/*.toml``): how healthy people walk, by published curves and numbers, each with its source."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from gonio.errors import InputError
from gonio.records import CYCLE_POINTS, NormCondition, NormCurve, Norms, UsualValues
from gonio.resources import models_dir


def read_norms(path: Path) -> Norms:
    """Read curves over the gait cycle; they come at evenly spaced points and become 101, on straight lines.

    Raises:
        InputError: ``norms-invalid``: the file can't be read, or an entry is missing or of the wrong kind.
    """
    card = _load(path)
    try:
        return Norms(
            name=str(card["name"]),
            population=str(card["population"]),
            citation=str(card["citation"]),
            licence=str(card["licence"]),
            conditions=tuple(_condition(entry) for entry in card["conditions"]),
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise _wrong(path, error) from error


def read_usual_values(path: Path) -> UsualValues:
    """Read single numbers by parameter, for men, women or both.

    Raises:
        InputError: ``norms-invalid``: the file can't be read, or an entry is missing or of the wrong kind.
    """
    card = _load(path)
    try:
        both = {str(name): float(value) for name, value in card["both"].items()}
        men, women = ({**both, **{str(n): float(v) for n, v in card[sex].items()}} for sex in ("men", "women"))
        return UsualValues(population=str(card["population"]), citation=str(card["citation"]), male=men, female=women)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _wrong(path, error) from error


def builtin_norms() -> tuple[Norms, ...]:
    """Read the norm curves that gonio ships: adults, then children."""
    return tuple(read_norms(models_dir() / "norms" / f"{name}.toml") for name in ("fukuchi2018", "schwartz2008"))


def builtin_usual_values() -> UsualValues:
    """Read the usual values that gonio ships."""
    return read_usual_values(models_dir() / "norms" / "adults.toml")


def _load(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _wrong(path, error) from error


def _wrong(path: Path, error: Exception) -> InputError:
    return InputError(
        f"{path.name} is no norm card: {type(error).__name__} {error}.",
        hint="See the cards in models/norms.",
        code="norms-invalid",
    )


def _condition(entry: dict[str, Any]) -> NormCondition:
    low, high = entry["dimensionless_speed"]
    return NormCondition(
        name=str(entry["name"]),
        slowest=float(low),
        fastest=float(high),
        curves={str(name): _curve(curve) for name, curve in entry["curves"].items()},
    )


def _curve(entry: dict[str, Any]) -> NormCurve:
    mean, sd = (np.array(entry[key], dtype=float) for key in ("mean", "sd"))
    if len(mean) != len(sd):
        raise ValueError(f"{len(mean)} means and {len(sd)} standard deviations")
    percent = np.linspace(0.0, 100.0, len(mean))
    wanted = np.linspace(0.0, 100.0, CYCLE_POINTS)
    return NormCurve(unit=str(entry["unit"]), mean=np.interp(wanted, percent, mean), sd=np.interp(wanted, percent, sd))
