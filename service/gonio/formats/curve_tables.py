"""Curves as comma-separated tables, for spreadsheets and statistics: over time, and over the gait cycle."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.records import FEET, GaitAnalysis, TimeCurve


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
        table.writerow(
            ["quantity", "unit", "side", "cycle", "counts", "start_s", "end_s", "percent", "value", "error_sd"]
        )
        for curve in gait.curves:
            for index, cycle in enumerate(gait.cycles_of(curve.side)):
                begin_s, end_s = (
                    gait.timebase.start_s + f / gait.timebase.rate_hz for f in (cycle.start_frame, cycle.end_frame)
                )
                given = [curve.quantity, curve.unit, FEET[cycle.foot], index + 1, int(not cycle.left_out)]
                for percent, (value, sd) in enumerate(zip(curve.values[index], curve.sd[index], strict=True)):
                    table.writerow([*given, _text(begin_s, 4), _text(end_s, 4), percent, _text(value, 4), _text(sd, 4)])


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""
