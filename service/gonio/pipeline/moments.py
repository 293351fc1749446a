"""When something happened that a finding speaks of: stretches and moments on the trial's clock."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.smoothing.filters import runs

Span = tuple[float, float]


def longest_stretch(condition: Bool[np.ndarray, " frame"], times_s: Float[np.ndarray, " frame"]) -> Span | None:
    """Give the first and the last moment of the longest run in which a condition holds; None if it never does."""
    found = max(runs(condition), key=lambda run: run[1] - run[0], default=None)
    return None if found is None else (float(times_s[found[0]]), float(times_s[found[1] - 1]))


def worst_moment(values: Float[np.ndarray, " frame"], times_s: Float[np.ndarray, " frame"]) -> Span | None:
    """Give the moment of the largest of the known values; None if none is known."""
    if not np.isfinite(values).any():
        return None
    at_s = float(times_s[np.nanargmax(values)])
    return at_s, at_s
