"""Where somebody's feet stood, and which way that person was upright, in a frame whose floor is not known."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.smoothing.filters import low_pass, runs

STILL_M_S = 0.5
"""A foot slower than this stands. In the swing it is several times faster; a track's noise of 10 mm, smoothed, is 0.2 m/s."""

SMOOTH_HZ = 6.0
SHORTEST_S = 0.15
SAME_PLACE_M = 0.15
"""A foot that stands for less was only turning; one that stands again this near never left."""


def find_contacts(
    left_foot_m: Float[np.ndarray, "frame 3"], right_foot_m: Float[np.ndarray, "frame 3"], rate_hz: float
) -> tuple[Float[np.ndarray, "contact 3"], Bool[np.ndarray, " contact"]]:
    """Find the places where the feet stood still, in the order of time, and which of them are the left foot's.

    Args:
        left_foot_m: A point of the foot, the heel at best, in any frame at rest; NaN where it is not known.
        right_foot_m: The same of the other foot.
        rate_hz: Frames a second.
    """
    found: list[tuple[float, np.ndarray, bool]] = []
    for track, is_left in ((left_foot_m, True), (right_foot_m, False)):
        found += [(time, place, is_left) for time, place in _places(track, rate_hz)]
    found.sort(key=lambda contact: contact[0])
    return (
        np.array([place for _, place, _ in found]).reshape(-1, 3),
        np.array([is_left for _, _, is_left in found], dtype=bool),
    )


def _places(track: Float[np.ndarray, "frame 3"], rate_hz: float) -> list[tuple[float, np.ndarray]]:
    """Give each place where a foot stood, with the frame in the middle of that time."""
    if len(track) < 3:
        return []
    smooth = low_pass(track, rate_hz, min(SMOOTH_HZ, 0.4 * rate_hz))
    speed = np.full(len(track), np.nan)
    speed[1:-1] = np.linalg.norm(smooth[2:] - smooth[:-2], axis=1) * rate_hz / 2
    places: list[tuple[float, np.ndarray]] = []
    for start, stop in runs(speed < STILL_M_S):
        if stop - start < SHORTEST_S * rate_hz:
            continue
        place = np.median(track[start:stop], axis=0)
        if not places or np.linalg.norm(place - places[-1][1]) > SAME_PLACE_M:
            places.append(((start + stop - 1) / 2, place))
    return places


def upright(
    feet_m: Float[np.ndarray, "frame 3"], shoulders_m: Float[np.ndarray, "frame 3"]
) -> Float[np.ndarray, "3"] | None:
    """Give the person's mean direction from the feet's to the shoulders' middle; None where neither is ever known.

    Over whole steps it is vertical but for the trunk's lean, which is forward and not to the side.
    """
    body = shoulders_m - feet_m
    known = np.isfinite(body[:, 0])
    if not known.any():
        return None
    mean = (body[known] / np.linalg.norm(body[known], axis=1, keepdims=True)).mean(axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 0.5 else None
