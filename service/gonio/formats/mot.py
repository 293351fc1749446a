"""OpenSim's tables over time (``.mot``, ``.sto``): read and written.

A header of ``key=value`` lines up to ``endheader``, one line of labels, one row a time. Angles are in degrees where the
header says ``inDegrees=yes``. Which columns are angles, the file does not say; the model does.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records import Motion, record


@record
class Table:
    """The columns of a ``.mot`` or ``.sto`` file, in the file's own units; ``in_degrees`` is what its header says."""

    name: str
    labels: tuple[str, ...]
    times_s: Float[np.ndarray, " row"]
    values: Float[np.ndarray, "row column"]
    in_degrees: bool

    def of(self, label: str) -> Float[np.ndarray, " row"]:
        """Give one column by its label.

        Raises:
            InputError: there is no such column, or more than one.
        """
        if label not in self.labels:
            raise InputError(f"{self.name} has no column {label}.", hint=f"It has: {', '.join(self.labels)}.")
        if self.labels.count(label) > 1:
            raise InputError(
                f"{self.name} has {self.labels.count(label)} columns {label}.",
                hint="Give each column a name of its own.",
            )
        return self.values[:, self.labels.index(label)]


def read_mot(path: Path) -> Table:
    """Read a ``.mot`` or ``.sto`` file, with OpenSim's header or SIMM's (``datacolumns``, ``datarows``).

    Raises:
        InputError: the file can't be read, has no ``endheader`` or no time column, or rows that don't fit its labels.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{path.name} can't be read: {error.strerror}.", hint="Check the path.") from error
    end = next((row for row, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise InputError(f"{path.name} has no line 'endheader'.", hint="Give an OpenSim .mot or .sto file.")
    below = [line for line in lines[end + 1 :] if line.strip()]
    labels = below[0].split() if below else []
    if not labels or labels[0].lower() != "time":
        raise InputError(f"{path.name} has no column 'time' first.", hint="Give an OpenSim .mot or .sto file.")
    header = dict(_split(line) for line in lines[:end])
    values = _read_rows(path, below[1:], len(labels))
    promised = header.get("nrows", header.get("datarows", ""))
    if promised.isdecimal() and len(values) < int(promised):
        raise InputError(
            f"{path.name} holds {len(values)} of the {promised} rows that its header promises.",
            hint="Was the file cut short? Export it again.",
        )
    if len(values) == 0 or not np.all(np.diff(values[:, 0]) > 0):
        raise InputError(
            f"{path.name} holds {len(values)} rows, and their times don't ascend.", hint="Export the file again."
        )
    return Table(
        name=path.name,
        labels=tuple(labels[1:]),
        times_s=values[:, 0],
        values=values[:, 1:],
        in_degrees=header.get("indegrees", "no") == "yes",
    )


def _split(line: str) -> tuple[str, str]:
    """Split a header line into key and value: ``inDegrees=yes``, or SIMM's ``datarows 3009``."""
    key, _, value = line.strip().lower().replace("=", " ").partition(" ")
    return key, value.strip()


def _read_rows(path: Path, rows: list[str], columns: int) -> Float[np.ndarray, "row column"]:
    if not rows:
        return np.empty((0, columns))
    try:
        values = np.loadtxt(rows, dtype=float, comments=None, ndmin=2)
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{path.name} holds a row that does not fit its {columns} labels: {error}.",
            hint="Was the file cut short or edited? Export it again.",
        ) from error
    if values.shape[1] != columns or not np.all(np.isfinite(values[:, 0])):
        raise InputError(
            f"{path.name} has {columns} labels for {values.shape[1]} columns, or a row without a time.",
            hint="Was the file cut short or edited? Export it again.",
        )
    return values


def write_mot(path: Path, table: Table) -> None:
    """Write a ``.mot`` or ``.sto`` file that OpenSim opens. Missing values are written as ``nan``."""
    header = [
        table.name,
        "version=1",
        f"nRows={len(table.times_s)}",
        f"nColumns={len(table.labels) + 1}",
        f"inDegrees={'yes' if table.in_degrees else 'no'}",
        "",
        "Units are S.I. units (second, meters, Newtons, ...)",
        "Angles are in degrees." if table.in_degrees else "Angles are in radians.",
        "",
        "endheader",
        "\t".join(("time", *table.labels)),
    ]
    row = "\t".join(["%.10f"] * (len(table.labels) + 1)) + "\n"
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n")
        for time_s, values in zip(table.times_s.tolist(), table.values, strict=True):
            file.write(row % (time_s, *values.tolist()))


def table_of_motion(motion: Motion) -> Table:
    """Make the table of a motion as OpenSim writes it: angles in degrees, slides in metres."""
    return Table(
        name="Coordinates",
        labels=motion.coordinate_names,
        times_s=motion.times_s,
        values=np.where(motion.rotational, np.degrees(motion.values), motion.values),
        in_degrees=True,
    )
