"""Numbers as the report has them: rounded, and null where they are not known."""

import numpy as np
from jaxtyping import Float

from gonio.pipeline.report_base import Series


def number(value: float, digits: int = 2) -> float | None:
    """Round a number for the report; NaN becomes null."""
    return round(float(value), digits) if np.isfinite(value) else None


def array_of(values: Series) -> Float[np.ndarray, " value"]:
    """Give a curve of the report as numbers again; null becomes NaN."""
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def series(values: np.ndarray) -> Series:
    """Round a curve for the report; NaN becomes null."""
    return [number(v, 3) for v in values]
