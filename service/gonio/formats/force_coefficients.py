"""Coefficients of the ground's forces (``models/forces/*.toml``), each file with its source."""

import tomllib
from pathlib import Path
from typing import Any, get_args

import numpy as np

from gonio.errors import InputError
from gonio.records import ForceCoefficients, PhaseTemplate, Task, TaskForces
from gonio.resources import models_dir


def read_force_coefficients(path: Path) -> ForceCoefficients:
    """Read the numbers by which shear is found; ``models/forces/default.toml`` shows what such a file holds.

    Raises:
        InputError: ``force-coefficients-invalid``: the file can't be read, or an entry is missing or of the wrong kind.
    """
    try:
        card = tomllib.loads(path.read_text(encoding="utf-8"))
        knots = _numbers(card["knots"])
        return ForceCoefficients(
            source=str(card["source"]),
            knots=knots,
            tasks={task: _task(card[task], len(knots) - 4) for task in get_args(Task)},
            speed_range_m_s=_pair(card["speed_range_m_s"]),
            stance_range_s=_pair(card["stance_range_s"]),
            moment_smooth_s=float(card["moment_smooth_s"]),
            sd_bw=_numbers([card["sd_forward_bw"], card["sd_sideways_bw"]]),
            band_factor=float(card["band_factor"]),
        )
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path.name} does not hold the coefficients of forces: {type(error).__name__} {error}.",
            hint="Copy gonio's models/forces/default.toml, change its numbers, and say in `source` where they come from.",
            code="force-coefficients-invalid",
        ) from error


def builtin_force_coefficients() -> ForceCoefficients:
    """Read the coefficients that gonio ships."""
    return read_force_coefficients(models_dir() / "forces" / "default.toml")


def _task(entry: dict[str, Any], splines: int) -> TaskForces:
    given = entry.get("template")
    return TaskForces(
        pivot=_numbers(entry["pivot"]),
        moment_gain=float(entry["moment_gain"]),
        template=None if given is None else _template(given, splines),
        expected_nm_kg={str(name): float(value) for name, value in entry["expected_nm_kg"].items()},
    )


def _template(entry: dict[str, Any], splines: int) -> PhaseTemplate:
    forward, sideways = (_numbers(entry[name]) for name in ("forward", "sideways"))
    if not len(forward) == len(sideways) == splines:
        raise ValueError(f"the knots make {splines} splines, which have {len(forward)} and {len(sideways)} weights")
    return PhaseTemplate(
        lever=_numbers(entry["lever"]),
        forward=forward,
        sideways=sideways,
        reference_range=float(entry.get("reference_range", np.nan)),
    )


def _numbers(values: Any) -> np.ndarray:  # noqa: ANN401 - TOML gives what the file holds
    found = np.array(values, dtype=float)
    if not np.isfinite(found).all():
        raise ValueError(f"{values} is not finite")
    return found


def _pair(values: Any) -> tuple[float, float]:  # noqa: ANN401 - TOML
    low, high = values
    return float(low), float(high)
