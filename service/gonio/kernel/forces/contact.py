"""Contacts of the feet with the ground, from vertical force: when, and how far each has gone."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.smoothing.filters import runs

LEAST_N = 10.0
"""A foot that carries less is in the air, or its sole has noise."""

GAP_S = 0.08
"""Shorter gaps are no steps."""

CORE_BW, CORE_S, OUTSIDE_S = 0.06, 0.1, 0.06
"""A contact has a core above this share of the body's weight for so long, if it was not cut, and reaches at most so far beyond
it."""


class Contact(NamedTuple):
    """One contact of one foot: frames ``begin`` to ``end`` (not included); ``whole`` if its beginning and end were seen."""

    foot: int
    begin: int
    end: int
    opened: bool  # its beginning was seen
    closed: bool  # its end was seen

    @property
    def whole(self) -> bool:
        """Whether it was seen from the beginning to the end."""
        return self.opened and self.closed


def find_contacts(vertical_n: Float[np.ndarray, "frame foot"], rate_hz: float, weight_n: float) -> tuple[Contact, ...]:
    """Find the contacts of both feet, in the order of feet and time.

    Args:
        vertical_n: NaN where not known: a contact that reaches such a frame, or an end of the recording, is cut there.
        rate_hz: Of the frames.
        weight_n: Of the body.
    """
    found: list[Contact] = []
    for foot in range(vertical_n.shape[1]):
        force = vertical_n[:, foot]
        known = np.isfinite(force)
        for begin, end in _merged(runs(np.nan_to_num(force) > LEAST_N), known, GAP_S * rate_hz):
            core = [
                (begin + first, begin + last)
                for first, last in runs(force[begin:end] > CORE_BW * weight_n)
                if last - first >= CORE_S * rate_hz or _is_cut(known, begin + first, begin + last)
            ]
            if core:
                outside = round(OUTSIDE_S * rate_hz)
                first = max(begin, core[0][0] - outside)
                last = min(end, core[-1][1] + outside)
                opened = first > 0 and bool(known[first - 1])
                closed = last < len(force) and bool(known[last])
                found.append(Contact(foot, first, last, opened, closed))
    return tuple(found)


def mark(contacts: tuple[Contact, ...], frames: int) -> Bool[np.ndarray, "frame foot"]:
    """Mark the frames in which each foot has contact."""
    marked = np.zeros((frames, 2), dtype=bool)
    for contact in contacts:
        marked[contact.begin : contact.end, contact.foot] = True
    return marked


def median_frames(contacts: tuple[Contact, ...]) -> float:
    """Give how long a whole contact lasts in the median, frames; NaN if there is none."""
    lengths = [contact.end - contact.begin for contact in contacts if contact.whole]
    return float(np.median(lengths)) if lengths else np.nan


def phases(contacts: tuple[Contact, ...], frames: int) -> Float[np.ndarray, "frame foot"]:
    """Give how far each contact has gone, 0 to 1; NaN in the air.

    One that was cut takes the median length of whole ones. Without those, or cut at both ends, it has its own length.
    """
    phase, usual = np.full((frames, 2), np.nan), median_frames(contacts)
    for contact in contacts:
        length = contact.end - contact.begin
        lasts = float(length - 1)
        if contact.opened != contact.closed and np.isfinite(usual):
            lasts = max(usual - 1.0, lasts)
        since = np.arange(length, dtype=float)
        if not contact.opened:
            since += lasts - (length - 1)
        phase[contact.begin : contact.end, contact.foot] = np.clip(since / max(lasts, 1.0), 0.0, 1.0)
    return phase


def _is_cut(known: Bool[np.ndarray, " frame"], begin: int, end: int) -> bool:
    """Say whether what was seen of a core ends with the recording, or with what is known: it may have lasted on."""
    return begin == 0 or end == len(known) or not known[begin - 1] or not known[end]


def _merged(
    found: list[tuple[int, int]], known: Bool[np.ndarray, " frame"], gap_frames: float
) -> list[tuple[int, int]]:
    """Merge runs with a short gap between them, in which all is known."""
    merged: list[tuple[int, int]] = []
    for begin, end in found:
        if merged and begin - merged[-1][1] < gap_frames and known[merged[-1][1] : begin].all():
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((begin, end))
    return merged
