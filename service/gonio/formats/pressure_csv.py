"""Read a table of foot pressure (CSV) by its card, a part at a time: what is kept does not grow with the file.

Each part of the table becomes force and centre of pressure of both feet at once, so a matrix of sensors is never held for
longer than its part. Samples long before or after the video are passed over.
"""

import csv
from collections.abc import Generator, Iterator
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.formats.pressure_card import (
    DEFAULT_COLUMNS,
    METRES,
    NEWTONS,
    PASCALS,
    SECONDS,
    Centre,
    ForceCard,
    ForceFoot,
    MatCard,
    PressureCard,
    SensorCard,
    SensorField,
    columns_of,
    default_card,
    parts_of,
    sensor_places_m,
)
from gonio.formats.pressure_checks import check_values
from gonio.formats.pressure_mat import FeetOnMat, split_by_foot
from gonio.records import FEET, FootPressure, PressureStream

if TYPE_CHECKING:
    import pandas as pd

MOST_SAMPLES = 2_000_000
"""A recording of ten minutes at 3 kHz; kept, it takes 130 MB."""

SPAN_S = (-60.0, 600.0)
"""Kept where the video is not at hand: from a minute before its start to ten minutes after it."""

PART_VALUES = 2_000_000
"""So many cells are parsed at a time: some 16 MB as numbers."""

SEPARATORS = (",", ";", "\t")
LONGEST_LINE = 1 << 17
"""Characters: a line of more is no header of columns. It is also the longest name that the csv module reads."""

GAP_STEPS = 2.5
"""A step of the clock that is so many times the usual one is a gap: at least one sample was lost."""

MOST_DOUBLED = 0.05
"""Share of samples with the time stamp of the one before: more are no slip of the clock."""


class _Part(NamedTuple):
    times_s: Float[np.ndarray, " sample"]
    force: Float[np.ndarray, "sample foot"]
    cop_m: Float[np.ndarray, "sample foot 2"]
    saturated: Bool[np.ndarray, "sample foot"]


def read_pressure(
    path: Path,
    card: PressureCard | None = None,
    span_s: tuple[float, float] = SPAN_S,
    name: str = "",
    feet: FeetOnMat | None = None,
) -> PressureStream:
    """Read a pressure stream.

    Args:
        path: The table: one header line, one row a sample; columns separated by commas, semicolons or tabs.
        card: What the columns mean; None for a table with :data:`gonio.formats.pressure_card.DEFAULT_COLUMNS`.
        span_s: What is kept, by the video's clock as the card declares it. Reading ends where it does.
        name: What the owner calls the file.
        feet: Where the feet are, by the table's clock: a mat's sensors tell of the foot above them, which only the video
            knows.

    Returns:
        The stream. A cell that is empty or not finite is a lost sample of its foot: NaN. So is the moment of a gap of
        the clock. Negative values within noise are zero.

    Raises:
        InputError: ``pressure-unreadable``: no such table, a missing column, or a cell that is no number;
            ``pressure-clock``: times that are missing, go back, stand still or never reach the video;
            ``pressure-too-long``; ``pressure-one-foot``, ``pressure-negative``, ``pressure-unit`` or ``pressure-cop``:
            values that no pair of feet gives, see :mod:`gonio.formats.pressure_checks`.
    """
    name = name or path.name
    card = card or default_card()
    kept, count, first_s, last_s = [], 0, np.nan, np.nan
    with closing(_parts(path, name, card, feet)) as parts:
        for part in _ascending(parts, name):
            first_s, last_s = (part.times_s[0] if np.isnan(first_s) else first_s), part.times_s[-1]
            inside = (part.times_s >= span_s[0]) & (part.times_s <= span_s[1])
            kept.append(_Part(*(values[inside] for values in part)))
            count += int(inside.sum())
            if count > MOST_SAMPLES:
                raise InputError(
                    f"{name} has more than {MOST_SAMPLES} samples within {span_s[1] - span_s[0]:.0f} s.",
                    hint="Is the unit of its clock right? Export the trial alone, at 1000 Hz or less.",
                    code="pressure-too-long",
                )
            if last_s > span_s[1]:
                break
    if count < 10:
        raise InputError(
            f"{name} has too few samples between {span_s[0]:g} and {span_s[1]:g} s of the video: {count}. Its times run from "
            f"{first_s:.3f} s on.",
            hint="Check the unit of its clock and the time at which the video starts: time.zero in the card, a time stamp "
            'or "first".',
            code="pressure-clock",
        )
    whole = _Part(*(np.concatenate(values) for values in zip(*kept, strict=True)))
    return _finish(whole, card, name)


def write_pressure(path: Path, pressure: FootPressure) -> None:
    """Write a stream as a table that needs no card; a lost value is an empty cell. Microseconds, mN and µm are kept."""
    import pandas as pd

    columns = [pressure.times_s]
    for foot in range(len(FEET)):
        columns += [pressure.vertical_n[:, foot], *pressure.cop_foot_m[:, foot].T]
    table = pd.DataFrame(dict(zip(DEFAULT_COLUMNS, columns, strict=True)))
    table.to_csv(path, index=False, float_format="%.6f", lineterminator="\n")


def has_default_columns(path: Path) -> bool:
    """Tell whether a table needs no card.

    Raises:
        InputError: ``pressure-unreadable``: the file can't be read, or is no table at all.
    """
    line = _first_line(path, path.name)
    if not line.strip() or not line.replace("\t", "").isprintable():
        raise InputError(
            f"{path.name} is no table: its first line names no columns.",
            hint="Give a CSV file with a header line.",
            code="pressure-unreadable",
        )
    return any(set(DEFAULT_COLUMNS) <= set(_split(line, separator)) for separator in SEPARATORS)


def _finish(whole: _Part, card: PressureCard, name: str) -> PressureStream:
    """Drop doubles, mark gaps, check the values."""
    single = np.r_[True, np.diff(whole.times_s) > 0]
    doubled = int((~single).sum())
    if doubled > MOST_DOUBLED * len(single):
        raise InputError(
            f"{name}: {doubled} of {len(single)} samples have the time stamp of the one before.",
            hint="Export the time stamps with all their digits.",
            code="pressure-clock",
        )
    times_s, force, cop_m, saturated = _with_gaps(_Part(*(values[single] for values in whole)))
    in_newtons = (card.force.unit if isinstance(card, ForceCard) else card.sensor.unit) != "counts"
    negative = check_values(force, cop_m, in_newtons, name)
    force = np.where(force < 0, 0.0, force)
    return PressureStream(
        source=name,
        pressure=FootPressure(
            times_s=times_s, vertical_n=force, cop_foot_m=np.where((force > 0)[..., None], cop_m, np.nan)
        ),
        saturated=saturated,
        in_newtons=in_newtons,
        doubled=doubled,
        negative=negative,
    )


def _with_gaps(part: _Part) -> _Part:
    """Put a lost sample into the middle of each gap of the clock."""
    steps_s = np.diff(part.times_s)
    gaps = np.flatnonzero(steps_s > GAP_STEPS * np.median(steps_s))
    middle_s = part.times_s[gaps] + steps_s[gaps] / 2
    return _Part(
        np.insert(part.times_s, gaps + 1, middle_s),
        np.insert(part.force, gaps + 1, np.nan, axis=0),
        np.insert(part.cop_m, gaps + 1, np.nan, axis=0),
        np.insert(part.saturated, gaps + 1, False, axis=0),
    )


def _ascending(parts: Iterator[_Part], name: str) -> Iterator[_Part]:
    """Pass on the parts, with times that never go back."""
    row, last_s = 2, -np.inf
    for part in parts:
        if not np.isfinite(part.times_s).all():
            wrong = row + int(np.argmin(np.isfinite(part.times_s)))
            raise InputError(
                f"{name} has no time in row {wrong}.", hint="Export it again.", code="pressure-clock", row=wrong
            )
        back = np.flatnonzero(np.diff(part.times_s, prepend=last_s) < 0)
        if back.size:
            raise InputError(
                f"The time stamps of {name} go back in row {row + back[0]}.",
                hint="Sort the samples; export one trial to a file.",
                code="pressure-clock",
                row=int(row + back[0]),
            )
        row, last_s = row + len(part.times_s), part.times_s[-1]
        yield part


def _parts(path: Path, name: str, card: PressureCard, feet: FeetOnMat | None) -> Generator[_Part, None, None]:
    """Parse the table a part at a time."""
    import pandas as pd  # slow to load, and a worker starts without it

    separator, header = _header(path, name, card.time.column)
    described = parts_of(card)
    absent = [side for side, part in described.items() if not set(columns_of(part)) & set(header)]
    if len(absent) == 1 and len(described) > 1:
        raise InputError(
            f"{name} has no column of the {absent[0]} foot.",
            hint="What the ground does to the body is known from both feet only. Export both soles; without the other one, "
            "upload no pressure, and get the angles.",
            code="pressure-one-foot",
        )
    parts = described.values()
    wanted = [card.time.column, *(column for part in parts for column in columns_of(part))]
    for column in wanted:
        if header.count(column) != 1:
            raise InputError(
                f"{name} has {header.count(column) or 'no'} column{'s' if header.count(column) > 1 else ''} {column!r}.",
                hint=f"Name its columns in a pressure card. The table has: {', '.join(header[:20])}"
                f"{', …' if len(header) > 20 else ''}.",
                code="pressure-unreadable",
            )
    lists = {part.list_column for part in parts if isinstance(part, SensorField) and part.list_column}
    listed = sum(len(sensor_places_m(part)) for part in parts if isinstance(part, SensorField) and part.list_column)
    zero: float | None = None
    try:
        with pd.read_csv(
            path,
            sep=separator,
            decimal=card.decimal,
            encoding="utf-8-sig",
            encoding_errors="replace",
            usecols=wanted,
            dtype={column: str if column in lists else float for column in wanted},
            chunksize=max(PART_VALUES // (len(header) + listed), 1),
        ) as tables:
            for table in tables:
                stamps = table[card.time.column].to_numpy(dtype=float)
                if zero is None:
                    zero = float(stamps[0]) if card.time.zero == "first" else float(card.time.zero)
                times_s = (stamps - zero) * SECONDS[card.time.unit]
                yield (
                    _reduce_mat(table, times_s, card, feet)
                    if isinstance(card, MatCard)
                    else _reduce(table, times_s, card)
                )
    except (ValueError, OverflowError, OSError, pd.errors.ParserError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{name} holds a row that does not fit: {str(error).strip().splitlines()[0]}.",
            hint="Each row needs a number in every column that the card names; a lost value is an empty cell.",
            code="pressure-unreadable",
        ) from error


def _header(path: Path, name: str, time: str) -> tuple[str, list[str]]:
    """Give the separator and the names of the columns."""
    line = _first_line(path, name)
    for separator in SEPARATORS:
        header = _split(line, separator)
        if time in header:
            return separator, header
    raise InputError(
        f"{name} has no column {time!r} in its first line: {line[:120]!r}.",
        hint="Give a table with a header line, and a pressure card that names its columns; without a card, they are those "
        "of docs/reference/pressure-formats.md.",
        code="pressure-unreadable",
    )


def _first_line(path: Path, name: str) -> str:
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return file.readline(LONGEST_LINE).rstrip("\r\n")
    except OSError as error:
        raise InputError(
            f"{name} can't be read: {error.strerror}.", hint="Check the path.", code="pressure-unreadable"
        ) from error


def _split(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator), [])


def _reduce_mat(
    table: "pd.DataFrame", times_s: Float[np.ndarray, " sample"], card: MatCard, feet: FeetOnMat | None
) -> _Part:
    """Turn a part of a mat's table into force and centre of pressure of the feet on it."""
    forces, saturated = _sensor_forces(table, card, card.mat)
    force, cop_m = split_by_foot(times_s, forces, sensor_places_m(card.mat), feet)
    return _Part(times_s, force, cop_m, np.stack([saturated, saturated], axis=1))


def _reduce(table: "pd.DataFrame", times_s: Float[np.ndarray, " sample"], card: ForceCard | SensorCard) -> _Part:
    """Turn a part of the table into force and centre of pressure."""
    force, cop_m = np.empty((len(table), len(FEET))), np.empty((len(table), len(FEET), 2))
    saturated = np.zeros((len(table), len(FEET)), dtype=bool)
    for side, foot in enumerate((card.right, card.left)):
        if isinstance(card, ForceCard):
            assert isinstance(foot, ForceFoot)
            shown = _finite(table[foot.force])
            force[:, side] = shown * NEWTONS.get(card.force.unit, 1.0)
            saturated[:, side] = shown >= (card.force.saturation or np.inf)
            cop_m[:, side] = _turn(
                np.stack([_finite(table[column]) for column in foot.cop], axis=1), card.cop, foot, side
            )
        else:
            assert isinstance(foot, SensorField)
            forces, saturated[:, side] = _sensor_forces(table, card, foot)
            force[:, side] = forces.sum(axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                cop_m[:, side] = forces @ sensor_places_m(foot) / force[:, side, None]
    return _Part(times_s, force, cop_m, saturated)


def _turn(
    shown: Float[np.ndarray, "sample 2"], centre: Centre, foot: ForceFoot, side: int
) -> Float[np.ndarray, "sample 2"]:
    """Turn a file's centre of pressure to ours: along from the back of the heel, across to the right."""
    outwards = 1.0 if side == 0 else -1.0
    signs = (
        {"forwards": 1.0, "backwards": -1.0}[centre.along],
        {"right": 1.0, "left": -1.0, "outwards": outwards, "inwards": -outwards}[centre.across],
    )
    return (shown - np.array(foot.heel)) * np.array(signs) * METRES[centre.unit]


def _sensor_forces(
    table: "pd.DataFrame", card: SensorCard | MatCard, field: SensorField
) -> tuple[Float[np.ndarray, "sample sensor"], Bool[np.ndarray, " sample"]]:
    """Give each sensor's force, NaN where it is lost, and where a sensor could not show all of it."""
    if field.list_column:
        import pandas as pd

        lines = table[field.list_column].fillna("").str.strip("[]() ")
        cells = pd.read_csv(
            StringIO("\n".join(line or field.separator for line in lines)),
            sep=field.separator,
            decimal=card.decimal,
            header=None,
            names=range(len(sensor_places_m(field))),
            index_col=False,
            dtype=float,
        ).to_numpy()
    else:
        cells = table[list(field.columns or ())].to_numpy(dtype=float)
    cells = np.where(np.isfinite(cells), cells, np.nan)
    saturated = np.asarray(np.any(cells >= (card.sensor.saturation or np.inf), axis=1))
    scale = NEWTONS.get(card.sensor.unit, 1.0)
    if card.sensor.unit in PASCALS:
        scale = PASCALS[card.sensor.unit] * (card.sensor.area_mm2 or 0.0) * 1e-6
    return scale * np.where(cells < card.sensor.threshold, 0.0, cells), saturated


def _finite(column: "pd.Series[float]") -> Float[np.ndarray, " sample"]:
    values = column.to_numpy(dtype=float)
    return np.where(np.isfinite(values), values, np.nan)
