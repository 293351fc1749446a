"""A mat's sensors to the feet that stand on it: which foot is above a sensor, only the video knows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gonio.records import FEET

FARTHEST_M = 0.12
"""From a sensor to the line from heel to toe joint of the foot above it: half a wide foot, its toes, and the video's error."""


class FeetOnMat(NamedTuple):
    """Heels and toe joints in the lab, by the clock of the mat; NaN where not known."""

    times_s: Float[np.ndarray, " frame"]
    heel_lab_m: Float[np.ndarray, "frame foot 3"]
    toe_lab_m: Float[np.ndarray, "frame foot 3"]


def split_by_foot(
    times_s: Float[np.ndarray, " sample"],
    forces: Float[np.ndarray, "sample sensor"],
    places_m: Float[np.ndarray, "sensor 2"],
    feet: FeetOnMat | None,
) -> tuple[Float[np.ndarray, "sample foot"], Float[np.ndarray, "sample foot 2"]]:
    """Give the force under each foot, and its centre along the sole from the back of the heel and across it to the right.

    A sensor belongs to the foot whose line from heel to toe joint is nearest; what lies farther than :data:`FARTHEST_M` from
    both is nobody's. A sample that lost a sensor, or at which a foot's place is not known, is NaN; so is a foot whose heel or
    toe joint is beside the mat: it may stand there.

    Args:
        times_s: Of the samples.
        forces: Of the sensors.
        places_m: Where they lie on the lab's floor, x and z.
        feet: Where the feet are; None: not known yet, and each foot is given half of the whole, on the middle of its sole.
    """
    force, cop_m = np.full((len(times_s), len(FEET)), np.nan), np.full((len(times_s), len(FEET), 2), np.nan)
    whole = np.asarray(~np.isnan(forces).any(axis=1))
    if feet is None:
        force[whole] = forces[whole].sum(axis=1, keepdims=True) / 2
        cop_m[whole] = [0.1, 0.0]
        return force, cop_m
    heel_m, toe_m = (_at(times_s, feet.times_s, place) for place in (feet.heel_lab_m, feet.toe_lab_m))
    known = whole & np.isfinite(heel_m).all(axis=(1, 2)) & np.isfinite(toe_m).all(axis=(1, 2))
    force[known] = 0.0
    sample, sensor = np.nonzero(np.where(known[:, None], forces, 0.0))
    point_m = np.insert(places_m[sensor], 1, 0.0, axis=1)[:, None]
    sole = toe_m[sample] - heel_m[sample]
    along = ((point_m - heel_m[sample]) * sole)[..., [0, 2]].sum(axis=-1) / (sole[..., [0, 2]] ** 2).sum(axis=-1)
    nearest = heel_m[sample] + np.clip(along, 0.0, 1.0)[..., None] * sole
    distance_m = np.linalg.norm((point_m - nearest)[..., [0, 2]], axis=-1)
    foot = distance_m.argmin(axis=1)
    row = np.arange(len(foot))
    near = distance_m[row, foot] <= FARTHEST_M
    axis = sole[row, foot] / np.linalg.norm(sole[row, foot], axis=1, keepdims=True)
    right = np.stack([-axis[:, 2], np.zeros(len(row)), axis[:, 0]], axis=1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    arm_m = point_m[:, 0] - heel_m[sample[row], foot]
    in_sole_m = np.stack([(arm_m * axis).sum(axis=1), (arm_m * right).sum(axis=1)], axis=1)
    load = forces[sample, sensor]
    np.add.at(force, (sample[near], foot[near]), load[near])
    moment = np.zeros_like(cop_m)
    np.add.at(moment, (sample[near], foot[near]), load[near, None] * in_sole_m[near])
    force[~_above(places_m, heel_m, toe_m)] = np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        return force, np.where((force > 0)[..., None], moment / force[..., None], np.nan)


def _above(
    places_m: Float[np.ndarray, "sensor 2"],
    heel_m: Float[np.ndarray, "sample foot 3"],
    toe_m: Float[np.ndarray, "sample foot 3"],
) -> Bool[np.ndarray, "sample foot"]:
    """Mark the feet whose heel and toe joint are above the rectangle of the sensors."""
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    ends_m = np.stack([heel_m, toe_m])[..., [0, 2]]
    return np.asarray(((ends_m >= low_m) & (ends_m <= high_m)).all(axis=(0, -1)))


def _at(
    times_s: Float[np.ndarray, " sample"],
    frames_s: Float[np.ndarray, " frame"],
    place_m: Float[np.ndarray, "frame foot 3"],
) -> Float[np.ndarray, "sample foot 3"]:
    """Interpolate places; NaN outside the video and beside unknown frames."""
    columns = place_m.reshape(len(frames_s), -1).T
    found = [np.interp(times_s, frames_s, column, left=np.nan, right=np.nan) for column in columns]
    return np.stack(found, axis=1).reshape(-1, *place_m.shape[1:])
