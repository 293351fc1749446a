"""Which way a person walks, how fast, and over what: the floor or a belt.

Forward is where the feet point, not where the pelvis goes: on a treadmill the pelvis goes nowhere. The ground is what the
standing foot stands on: its speed is that of the belt, zero on the floor. Relative to the ground, a treadmill walk is a
walk like any other.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from gonio.kernel.smoothing.filters import runs
from gonio.records import FootPaths

STRIDE_S = 1.2
"""Over which the feet's direction is averaged: about a stride, so that each foot's own turn in swing cancels."""

TURNING_RAD_S = np.deg2rad(30.0)
"""Someone who turns faster does not walk straight on. On a circle of 3 m at 1.2 m/s it is 23°/s; about-turns are 90°/s."""

SHORTEST_BOUT_S = 0.6

FLOOR_M_S = 0.15
"""A standing foot that seems to move more slowly stands on the floor: no treadmill runs as slowly."""

MOST_PROGRESS = 0.5
"""A pelvis that goes on by more than this share of the standing foot's speed is on no belt: the feet were found to slip, as a
single camera has it that errs in depth."""


class Bout(NamedTuple):
    """Straight walking in the frames ``start`` to ``stop``: where forward is, and how fast the ground moves along it."""

    start: int
    stop: int
    forward_lab: Float[np.ndarray, "3"]
    belt_m_s: float
    speed_m_s: float
    """Of the pelvis relative to the ground."""

    def along(self, points_m: Float[np.ndarray, "frame *rest 3"], rate_hz: float) -> Float[np.ndarray, " frame *rest"]:
        """Give how far forward points are, of all frames, as the ground under the feet counts it."""
        belt_m = self.belt_m_s * (np.arange(len(points_m)) - self.start) / rate_hz
        along_m = points_m @ self.forward_lab
        return along_m - belt_m.reshape(-1, *[1] * (along_m.ndim - 1))

    def rightwards(self, points_m: Float[np.ndarray, "*rest 3"]) -> Float[np.ndarray, "*rest"]:
        """Give how far to the right of the walker points are."""
        return points_m @ np.array([-self.forward_lab[2], 0.0, self.forward_lab[0]])


def find_bouts(paths: FootPaths) -> tuple[Bout, ...]:
    """Find where someone walks or stands facing one way; turns, and frames in which a foot is not known, are cut out."""
    heel_m, toe_m = paths.heel_lab_m, paths.toe_lab_m
    rate_hz = paths.timebase.rate_hz
    points = np.concatenate(
        [heel_m.reshape(len(heel_m), -1), toe_m.reshape(len(toe_m), -1), paths.pelvis_lab_m], axis=1
    )
    known = np.asarray(np.isfinite(points).all(axis=1))
    bouts: list[Bout] = []
    for start, stop in runs(known):
        feet = toe_m[start:stop] - heel_m[start:stop]
        yaw = np.arctan2(feet[..., 2], feet[..., 0])
        facing = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1).mean(axis=1)
        window = max(1, min(round(STRIDE_S * rate_hz), stop - start))
        facing = uniform_filter1d(facing, window, axis=0, mode="nearest")
        yaw = np.unwrap(np.arctan2(facing[:, 1], facing[:, 0]))
        turning = np.abs(np.gradient(yaw) * rate_hz) if len(yaw) > 1 else np.zeros(1)
        for first, last in runs(np.asarray(turning < TURNING_RAD_S)):
            if last - first >= SHORTEST_BOUT_S * rate_hz:
                bouts.append(_measure(paths, start + first, start + last, float(yaw[first:last].mean())))
    return tuple(bouts)


def _measure(paths: FootPaths, start: int, stop: int, yaw_rad: float) -> Bout:
    forward = np.array([np.cos(yaw_rad), 0.0, np.sin(yaw_rad)])
    rate_hz = paths.timebase.rate_hz
    # At each instant one foot's toes stand still on the ground, and no foot goes back relative to it.
    toe_m_s = np.gradient(paths.toe_lab_m[start:stop] @ forward, axis=0) * rate_hz
    ground_m_s = float(np.median(toe_m_s.min(axis=1)))
    pelvis_m = paths.pelvis_lab_m[start:stop] @ forward
    times_s = np.arange(stop - start) / rate_hz
    pelvis_m_s = float(np.polyfit(times_s, pelvis_m, 1)[0])
    on_belt = abs(ground_m_s) > max(FLOOR_M_S, abs(pelvis_m_s) / MOST_PROGRESS)
    belt_m_s = ground_m_s if on_belt else 0.0
    return Bout(start, stop, forward, belt_m_s, pelvis_m_s - belt_m_s)
