"""Marker trajectories as ``.trc`` files (Motion Analysis, OpenSim): read and written.

A file holds frame number, time and three columns a marker, in millimetres or metres as its header says; a missing
marker is blank. Axes are whatever the file's author chose: OpenSim's files are Y up like ours, and nothing is turned
here.
"""

import csv
from io import StringIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records import record

_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}
_HEADER_LINES = 5


@record
class Trajectories:
    """Named points over time, metres; NaN is missing."""

    names: tuple[str, ...]
    times_s: Float[np.ndarray, " frame"]
    xyz_m: Float[np.ndarray, "frame marker 3"]
    rate_hz: float


def read_trc(path: Path) -> Trajectories:
    """Read a ``.trc`` file.

    Blank, ``NaN`` and non-finite entries are missing. Times are the file's own, which are often rounded to
    milliseconds.

    Raises:
        InputError: the file can't be read, has no header of this format, an unknown unit, two markers of one name,
        rows that
            don't fit the header, or times that don't ascend.
    """
    lines = _read_lines(path)
    fields = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    unit = fields.get("Units", "mm")
    if unit not in _METRES:
        raise InputError(f"{path.name} gives its unit as {unit!r}.", hint=f"It must be one of {', '.join(_METRES)}.")
    names = lines[3].split()[2:]
    if not names or len(set(names)) != len(names):
        raise InputError(
            f"{path.name} names {len(names)} markers, {len(set(names))} of them different.",
            hint="Line 4 of a .trc file is Frame#, Time and one name for each marker.",
        )
    table = _read_table(path, lines[_HEADER_LINES:], 2 + 3 * len(names))
    promised = fields.get("NumFrames", "")
    if promised.isdecimal() and len(table) < int(promised):
        raise InputError(
            f"{path.name} holds {len(table)} of the {promised} frames that its header promises.",
            hint="Was the file cut short? Export the trial again.",
        )
    times_s = table[:, 1]
    if len(table) == 0 or not np.all(np.diff(times_s) > 0):
        raise InputError(
            f"{path.name} holds {len(table)} frames, and their times don't ascend.", hint="Export the trial again."
        )
    xyz_m = table[:, 2:].reshape(len(table), -1, 3) * _METRES[unit]
    xyz_m[~np.isfinite(xyz_m).all(axis=-1)] = np.nan
    return Trajectories(
        names=tuple(names), times_s=times_s, xyz_m=xyz_m, rate_hz=_rate_hz(fields.get("DataRate", ""), times_s)
    )


def _read_lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{path.name} can't be read: {error.strerror}.", hint="Check the path.") from error
    if len(lines) < _HEADER_LINES or not lines[0].startswith("PathFileType"):
        raise InputError(
            f"{path.name} is no .trc file: it does not start with PathFileType.",
            hint="Give a marker file in TRC format.",
        )
    return lines


def _read_table(path: Path, lines: list[str], columns: int) -> Float[np.ndarray, "frame column"]:
    """Parse the rows; short rows are filled with NaN, since trailing blanks are often lost."""
    import pandas as pd  # slow to load, and a worker starts without it

    rows = [line.rstrip() for line in lines if line.strip()]
    long = next((number for number, row in enumerate(rows, start=1) if row.count("\t") >= columns), None)
    if long is not None:
        raise InputError(
            f"Row {long} of {path.name} has more than the {columns} columns of its header.",
            hint="Export the trial again.",
        )
    if not rows:
        return np.empty((0, columns))
    try:
        table = pd.read_csv(
            StringIO("\n".join(rows)), sep="\t", header=None, names=range(columns), quoting=csv.QUOTE_NONE, dtype=float
        )
    except (ValueError, OverflowError, pd.errors.ParserError) as error:
        raise InputError(
            f"{path.name} holds a row that does not fit its header of {columns} columns: {error}.",
            hint="Was the file cut short or edited? Columns are separated by tabs.",
        ) from error
    values = table.to_numpy()
    if not np.all(np.isfinite(values[:, 1])):
        raise InputError(f"{path.name} has a row without a time.", hint="Was the file cut short? Export it again.")
    return values


def _rate_hz(given: str, times_s: Float[np.ndarray, " frame"]) -> float:
    """Take the header's rate if it is one, else that of the times."""
    try:
        rate_hz = float(given)
    except ValueError:
        rate_hz = 0.0
    if np.isfinite(rate_hz) and rate_hz > 0:
        return rate_hz
    return float(1.0 / np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0


def write_trc(path: Path, trajectories: Trajectories) -> None:
    """Write a ``.trc`` file in millimetres that OpenSim opens; missing points are blank.

    A hundredth of a micrometre and a microsecond are kept: finer than any camera, and times that OpenSim takes for
    uniform. Each row ends with a tab, without which OpenSim refuses a row whose last marker is missing.
    """
    count, names = len(trajectories.times_s), trajectories.names
    rate = f"{trajectories.rate_hz:.6g}"
    header = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{len(names)}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{marker}" for marker in range(1, len(names) + 1) for axis in "XYZ"),
        "",
    ]
    row = "\t%.5f" * (3 * len(names)) + "\t\n"
    values_mm = 1000.0 * trajectories.xyz_m.reshape(count, -1)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n")
        # Row by row: a long trial's text is larger than all its arrays together, and pandas' takes ten times as long.
        for number, (time_s, values) in enumerate(zip(trajectories.times_s.tolist(), values_mm, strict=True), start=1):
            file.write(f"{number}\t{time_s:.6f}" + (row % tuple(values.tolist())).replace("nan", ""))
