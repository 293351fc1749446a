"""Curves as comma-separated tables, for spreadsheets and statistics: over time, and over the gait cycle."""

import csv
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.records import FEET, GaitAnalysis, TimeCurve

CYCLE_COLUMNS = ("quantity", "unit", "side", "cycle", "counts", "start_s", "end_s", "percent", "value", "error_sd")


def write_time_table(path: Path, times_s: Float[np.ndarray, " frame"], curves: Sequence[TimeCurve]) -> None:
    """Write a row a frame: the time, then each curve and the standard deviation of its error; blank is not known.

    A column is named after side, quantity and unit: ``right_knee_flexion_deg``, ``right_knee_flexion_sd_deg``.
    """
    header, columns = ["time_s"], [times_s]
    for curve in curves:
        unit = curve.unit.replace("/", "_per_")
        header += [f"{curve.side}_{curve.quantity}_{unit}", f"{curve.side}_{curve.quantity}_sd_{unit}"]
        columns += [curve.values, curve.sd]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(header)
        for row in np.stack(columns, axis=1):
            table.writerow([_text(value, 5) for value in row])


def write_cycle_table(path: Path, gait: GaitAnalysis) -> None:
    """Write a row for each per cent of each cycle of each curve, in the long form that statistics programs take.

    ``cycle`` counts from 1 on each side; ``counts`` is 0 for a cycle that is left out of the averages.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(CYCLE_COLUMNS)
        for *given, begin_s, end_s, percent, value, sd in _cycle_rows(gait):
            table.writerow([*given, _text(begin_s, 4), _text(end_s, 4), percent, _text(value, 4), _text(sd, 4)])


def can_write_parquet() -> bool:
    """Tell whether Apache Arrow is installed, as ``pip install gonio[parquet]`` does."""
    return importlib.util.find_spec("pyarrow") is not None


def write_cycle_parquet(path: Path, gait: GaitAnalysis) -> None:
    """Write what :func:`write_cycle_table` writes as Apache Parquet, with all digits; null is not known."""
    import pandas as pd  # slow to load, and a worker starts without it

    table = pd.DataFrame.from_records(list(_cycle_rows(gait)), columns=list(CYCLE_COLUMNS))
    table.to_parquet(path, engine="pyarrow", index=False)


def _cycle_rows(gait: GaitAnalysis) -> Iterator[tuple[str, str, str, int, int, float, float, int, float, float]]:
    for curve in gait.curves:
        for index, cycle in enumerate(gait.cycles_of(curve.side)):
            begin_s, end_s = (
                gait.timebase.start_s + f / gait.timebase.rate_hz for f in (cycle.start_frame, cycle.end_frame)
            )
            counts, side = int(not cycle.left_out), FEET[cycle.foot]
            values = zip(curve.values[index].tolist(), curve.sd[index].tolist(), strict=True)
            for percent, (value, sd) in enumerate(values):
                yield curve.quantity, curve.unit, side, index + 1, counts, begin_s, end_s, percent, value, sd


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""
