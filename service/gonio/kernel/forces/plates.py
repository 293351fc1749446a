"""Force plates to feet: which foot stood on which plate, when, and when it is not known."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.smoothing.filters import runs
from gonio.records import FEET, FootForces, ForcePlates

LEAST_N = 20.0
SHORTEST_S = 0.08
"""A load of less, or shorter, is crosstalk or somebody in passing."""

FARTHEST_M = 0.15
"""From a plate's centre of pressure to the line from heel to toe of the foot on it, in the median of a contact."""

STANDS_M, STANDS_M_S = 0.03, 0.4
"""A heel or toe stands if it is so low above its lowest and so slow."""

SHARED_S = 0.05
"""Both feet stand on one plate for so long: it tells of neither."""

EDGE_S = 0.06
"""So long before and after a measured contact a foot that seems to stand is taken as in the air: the plate knows better."""


class _Contact(NamedTuple):
    plate: int
    begin_s: float
    end_s: float


def assign_plates(
    plates: ForcePlates,
    times_s: Float[np.ndarray, " frame"],
    heel_lab_m: Float[np.ndarray, "frame foot 3"],
    toe_lab_m: Float[np.ndarray, "frame foot 3"],
) -> FootForces:
    """Give each foot the wrenches of the plates that it stood on.

    A contact with a plate belongs to the foot whose line from heel to toe is nearest to the centre of pressure. A contact
    during which the other foot also stands on the plate belongs to nobody: both feet are NaN then. A foot that stands
    where no plate measures it is NaN.

    Args:
        plates: What the plates measured, by the frames' clock and in the frames' lab.
        times_s: The frames, uniform.
        heel_lab_m: Right and left heel; NaN where not known.
        toe_lab_m: Right and left toe.

    Returns:
        The wrenches at the frames, averaged over each frame's time.
    """
    wrench = _averaged(plates, times_s)
    standing = _standing(times_s, heel_lab_m) | _standing(times_s, toe_lab_m)
    found = np.zeros((len(times_s), len(FEET), 6))
    measured = np.zeros((len(times_s), len(FEET)), dtype=bool)
    shared = np.zeros(len(times_s), dtype=bool)
    for contact in _contacts(plates):
        during = (times_s >= contact.begin_s) & (times_s <= contact.end_s)
        if not during.any():
            continue
        foot = _nearest_foot(plates, contact, times_s[during], heel_lab_m[during], toe_lab_m[during])
        if foot is None:
            continue
        other = standing[during, 1 - foot] & _on_plate(
            plates.corners_lab_m[contact.plate], heel_lab_m[during, 1 - foot], toe_lab_m[during, 1 - foot]
        )
        if other.sum() * np.median(np.diff(times_s)) > SHARED_S:
            shared |= during
            continue
        found[during, foot] += wrench[during, contact.plate]
        near = (times_s >= contact.begin_s - EDGE_S) & (times_s <= contact.end_s + EDGE_S)
        measured[near, foot] = True
    found[(standing & ~measured) | shared[:, None]] = np.nan
    vertical = found[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        # r × F = M on the floor y = 0, without the free moment: x = M_z / F_y, z = −M_x / F_y.
        cop = np.stack([found[..., 5] / vertical, np.zeros_like(vertical), -found[..., 3] / vertical], axis=-1)
    return FootForces(
        times_s=times_s,
        wrench=found,
        cop_lab_m=np.where(vertical[..., None] > LEAST_N, cop, np.nan),
        shared=shared,
    )


def _averaged(plates: ForcePlates, times_s: Float[np.ndarray, " frame"]) -> Float[np.ndarray, "frame plate 6"]:
    """Give the plates' wrenches about the lab's origin, averaged over each frame's time; zero without a load."""
    loaded = np.isfinite(plates.cop_lab_m).all(axis=-1, keepdims=True)
    force = np.where(loaded, plates.force_lab_n, 0.0)
    moment = np.cross(np.where(loaded, plates.cop_lab_m, 0.0), force)
    moment[..., 1] += plates.free_moment_nm
    wrench = np.concatenate([force, moment], axis=-1).reshape(len(plates.times_s), -1)
    steps_s = np.diff(plates.times_s)[:, None]
    summed = np.vstack([np.zeros(wrench.shape[1]), np.cumsum(steps_s * (wrench[1:] + wrench[:-1]) / 2, axis=0)])
    half_s = np.median(np.diff(times_s)) / 2
    ends = np.clip([times_s - half_s, times_s + half_s], plates.times_s[0], plates.times_s[-1])
    total = [np.stack([np.interp(end, plates.times_s, column) for column in summed.T], axis=1) for end in ends]
    long_s = (ends[1] - ends[0])[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(long_s > 0, (total[1] - total[0]) / long_s, 0.0)
    return mean.reshape(len(times_s), -1, 6)


def _contacts(plates: ForcePlates) -> list[_Contact]:
    found: list[_Contact] = []
    for plate in range(plates.force_lab_n.shape[1]):
        loaded = plates.force_lab_n[:, plate, 1] > LEAST_N
        for begin, end in runs(loaded):
            begin_s, end_s = float(plates.times_s[begin]), float(plates.times_s[end - 1])
            if end_s - begin_s >= SHORTEST_S:
                found.append(_Contact(plate, begin_s, end_s))
    return found


def _nearest_foot(
    plates: ForcePlates,
    contact: _Contact,
    times_s: Float[np.ndarray, " frame"],
    heel_m: Float[np.ndarray, "frame foot 3"],
    toe_m: Float[np.ndarray, "frame foot 3"],
) -> int | None:
    """Give the foot that a contact belongs to; None if no foot is near."""
    inside = (plates.times_s >= contact.begin_s) & (plates.times_s <= contact.end_s)
    known = inside & np.isfinite(plates.cop_lab_m[:, contact.plate, 0])
    place = [np.interp(times_s, plates.times_s[known], plates.cop_lab_m[known, contact.plate, axis]) for axis in (0, 2)]
    cop = np.stack(place, axis=-1)[:, None]
    heel, sole = heel_m[..., [0, 2]], (toe_m - heel_m)[..., [0, 2]]
    along = ((cop - heel) * sole).sum(axis=-1) / np.maximum((sole**2).sum(axis=-1), 1e-6)
    distance_m = np.linalg.norm(cop - heel - np.clip(along, 0.0, 1.0)[..., None] * sole, axis=-1)
    known_frames = np.isfinite(distance_m).all(axis=1)
    if not known_frames.any():
        return None
    median_m = np.median(distance_m[known_frames], axis=0)
    foot = int(median_m.argmin())
    return foot if median_m[foot] <= FARTHEST_M else None


def _standing(
    times_s: Float[np.ndarray, " frame"], place_m: Float[np.ndarray, "frame foot 3"]
) -> Bool[np.ndarray, "frame foot"]:
    """Mark when a point of each foot stands."""
    speed_m_s = np.linalg.norm(np.gradient(place_m, times_s, axis=0), axis=-1)
    if not np.isfinite(place_m[..., 1]).any(axis=0).all():
        return np.zeros(place_m.shape[:2], dtype=bool)
    height_m = place_m[..., 1] - np.nanpercentile(place_m[..., 1], 5, axis=0)
    return np.asarray((height_m < STANDS_M) & (speed_m_s < STANDS_M_S))


def _on_plate(
    corners_m: Float[np.ndarray, "4 3"], heel_m: Float[np.ndarray, "frame 3"], toe_m: Float[np.ndarray, "frame 3"]
) -> Bool[np.ndarray, " frame"]:
    """Mark when heel or toe are above a plate; never, where its corners are not known."""
    if not np.isfinite(corners_m).all():
        return np.zeros(len(heel_m), dtype=bool)
    on = np.zeros(len(heel_m), dtype=bool)
    for point in (heel_m, toe_m):
        edges = np.roll(corners_m, -1, axis=0) - corners_m
        side = np.cross(edges, point[:, None] - corners_m)[..., 1]
        on |= np.all(side > 0, axis=1) | np.all(side < 0, axis=1)
    return on
