"""Median filter and zero-lag low-pass over frames: both leave gaps as they are and invent nothing past the ends."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError

MEDIAN_WINDOW_S = 0.083
"""The median's window in seconds: 5 frames at 60 Hz, the paper's choice, kept the same in time at other rates."""


def median_window(rate_hz: float) -> int:
    """Give the odd number of frames nearest to :data:`MEDIAN_WINDOW_S`, at least 3."""
    return max(3, 2 * round((MEDIAN_WINDOW_S * rate_hz - 1) / 2) + 1)


def median_filter(values: Float[np.ndarray, " frame *rest"], window: int) -> Float[np.ndarray, " frame *rest"]:
    """Replace each value by the median of the known values in a centred window of ``window`` frames (odd).

    At the ends the window is cut to stay symmetric, so that a trend is not bent. NaN stays NaN, and is not counted in its
    neighbours' medians.
    """
    if window % 2 == 0 or window < 1:
        raise InputError(f"A median window of {window} frames has no centre.", hint="Give an odd number of frames.")
    half = window // 2
    frames = values.shape[0]
    filtered = values.copy()
    for reach in range(1, half + 1):
        # Frames whose symmetric window reaches exactly this far: the inside for the last one, an end pair for others.
        first, last = (reach, frames - reach) if reach == half else (reach, reach + 1)
        centres = np.unique(np.r_[first:last, frames - 1 - reach : frames - reach])
        centres = centres[(centres >= reach) & (centres < frames - reach)]
        if centres.size:
            stack = np.stack([values[centres + offset] for offset in range(-reach, reach + 1)])
            filtered[centres] = _median_of_known(stack)
    return np.where(np.isnan(values), np.nan, filtered)


def low_pass(
    values: Float[np.ndarray, " frame *rest"], rate_hz: float, cutoff_hz: float
) -> Float[np.ndarray, " frame *rest"]:
    """Filter forward and backward with a 2nd-order Butterworth low-pass: 4th order, no lag.

    The cutoff is corrected for the double pass, so that the result is 3 dB down at ``cutoff_hz`` [Winter 2009, §2.2.4.4].
    Each run of known values is filtered for itself; a run too short to filter (9 frames or fewer) stays as it is.
    """
    from scipy.signal import butter, sosfiltfilt  # slow to load, and a worker starts without it

    if not 0 < cutoff_hz < rate_hz / 2:
        raise InputError(
            f"A cutoff of {cutoff_hz} Hz is impossible at {rate_hz} frames a second.",
            hint=f"Give a cutoff between 0 and {rate_hz / 2} Hz.",
            code="cutoff-impossible",
        )
    corrected_hz = cutoff_hz / (2**0.5 - 1) ** 0.25
    sections = butter(2, min(corrected_hz, 0.499 * rate_hz), fs=rate_hz, output="sos")
    pad = 3 * (2 * sections.shape[0] + 1)
    columns = values.reshape(values.shape[0], -1)
    filtered = columns.copy()
    for members, start, stop in known_runs(columns):
        if stop - start > pad:
            filtered[start:stop, members] = sosfiltfilt(sections, columns[start:stop, members], axis=0, padlen=pad)
    return filtered.reshape(values.shape)


def _median_of_known(stack: np.ndarray) -> np.ndarray:
    """Give the median over axis 0 without NaN (NaN where nothing is known): sorting puts NaN last."""
    ordered = np.sort(stack, axis=0)
    known = np.isfinite(stack).sum(axis=0)
    low = np.take_along_axis(ordered, np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    high = np.take_along_axis(ordered, (known // 2)[None], axis=0)[0] if stack.shape[0] > 1 else low
    return np.where(known > 0, (low + np.where(known % 2 == 0, high, low)) / 2, np.nan)


def runs(condition: Bool[np.ndarray, " frame"]) -> list[tuple[int, int]]:
    """List where a condition holds: the beginnings and ends (not included) of its runs."""
    edges = np.flatnonzero(np.diff(np.r_[False, condition, False].astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def known_runs(columns: Float[np.ndarray, "frame column"]) -> list[tuple[np.ndarray, int, int]]:
    """List the runs of frames without NaN as (columns, start, stop), columns with the same gaps together."""
    known = np.isfinite(columns)
    patterns, member_of = np.unique(known, axis=1, return_inverse=True)
    found: list[tuple[np.ndarray, int, int]] = []
    for pattern in range(patterns.shape[1]):
        members = np.flatnonzero(member_of.ravel() == pattern)
        found.extend((members, start, stop) for start, stop in runs(patterns[:, pattern]))
    return found
