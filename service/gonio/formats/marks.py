"""Read tables of marks in pictures, as CSV with a row a mark or as JSON with an object a mark."""

import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from gonio.errors import InputError
from gonio.formats.strict import Strict


class LengthCard(Strict):
    """The distance of two points, by name."""

    points: tuple[str, str]
    length_m: float = Field(gt=0)
    sd_m: float = Field(default=0.0, ge=0)


COLUMNS = ("picture", "part", "point", "u_px", "v_px")

M = TypeVar("M", bound=BaseModel)


def read_marks(path: Path, model: type[M]) -> list[M]:
    """Read all rows of a table; its columns are the model's fields.

    Raises:
        InputError: ``tracks-unreadable``; the row and the field are named.
    """
    columns = tuple(model.model_fields)
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix == ".json":
            rows: Any = json.loads(text)
        else:
            reader = csv.DictReader(text.splitlines())
            if set(reader.fieldnames or ()) != set(columns):
                raise bad_marks(path, f"its columns are {', '.join(reader.fieldnames or ())}", columns=columns)
            rows = list(reader)
    except (ValueError, OSError, csv.Error) as error:
        raise bad_marks(path, str(error).splitlines()[0], columns=columns) from error
    if not isinstance(rows, list):
        raise bad_marks(path, "it is no list of marks", columns=columns)
    marks: list[M] = []
    for number, row in enumerate(rows, start=1):
        try:
            marks.append(model.model_validate(row))
        except ValidationError as error:
            first = error.errors()[0]
            what = f"mark {number}, {'.'.join(map(str, first['loc']))}: {first['msg']}"
            raise bad_marks(path, what, columns=columns) from error
    return marks


def bad_marks(
    path: Path,
    what: str,
    known: Iterable[str] = (),
    *,
    columns: tuple[str, ...] = COLUMNS,
) -> InputError:
    """Make the error of a table that can't be used."""
    names = ", ".join(known)
    hint = f"Known are {names}." if names else f"Give the columns {', '.join(columns)}, a row a mark."
    return InputError(f"{path.name} can't be read as tracks: {what}.", hint=hint, code="tracks-unreadable")
