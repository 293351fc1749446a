"""The floor in the fit to pixels: where a foot stands, its keypoints have the height at which they rest.

One camera that looks down at a floor sees how far away a standing foot is. To the fit the floor is one more camera, which
sees heights alone: an observation of it is the height at which a keypoint rests, its constant error is the sole's and the
detector's, and its loss is as robust, for a heel that only seems to stand.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gonio.kernel.body.forward import couple, marker_positions
from gonio.kernel.kinematics.covariance import place_covariance_m2
from gonio.kernel.kinematics.pixel_priors import BIAS_M
from gonio.kernel.kinematics.pixel_system import Trial
from gonio.records import BodyModel, Motion

STANDS_BELOW_M_S = 0.15
"""A heel or toe that is slower than this rests. A heel on its way up passes 0.25 m/s at 2 cm: it would lift the floor."""

SOLE_M = 0.02
"""How far a keypoint's height over the sole differs from the marker set's in one subject: shoes, and the detector's habit."""

DISAGREES_SD = 3.0
"""Feet that seem to stand farther than this above or below the floor stand on something else, or a size is wrong."""


class Standing(NamedTuple):
    """Where feet rest, and what a fit that did not know the floor says of it.

    ``resting_m`` is the height of each marker that rests, NaN elsewhere. ``gap_m`` is how far above the floor those markers
    seem to rest, NaN if none does; ``gap_sd_m`` its standard deviation.
    """

    resting_m: Float[np.ndarray, "frame marker"]
    gap_m: float
    gap_sd_m: float

    @property
    def is_on_floor(self) -> bool:
        """Whether the feet stand where the floor is; not if none stands."""
        return bool(abs(self.gap_m) <= DISAGREES_SD * self.gap_sd_m)


def feet_of(model: BodyModel) -> tuple[Int[np.ndarray, " foot_marker"], Float[np.ndarray, " foot_marker"]]:
    """Give the foot's markers (heels and toes; ankles where there are none), and how high they are when the foot stands."""
    names = model.markers.names
    feet = [i for i, name in enumerate(names) if "heel" in name or "toe" in name or "foot_index" in name]
    with_ankles = feet + [i for i, name in enumerate(names) if "ankle" in name]
    upright = marker_positions(model, couple(model, model.coordinates.default[None]))[0, :, 1]
    # Heels and toes rest within a centimetre of the sole; an ankle's height above it is that of every adult, 7 cm.
    chosen = feet or with_ankles
    floor_m = min((upright[i] for i in feet), default=upright[with_ankles].min() - 0.07 if with_ankles else 0.0)
    return np.array(chosen, dtype=int), upright[chosen] - floor_m


def find_standing(
    model: BodyModel,
    motion: Motion,
    feet: Int[np.ndarray, " foot_marker"],
    rest_m: Float[np.ndarray, " foot_marker"],
) -> Standing:
    """Find where feet rest, by their speed in a first answer.

    Args:
        model: The subject's body as that answer has it.
        motion: The answer, at a steady rate, with its covariance; NaN frames rest nowhere.
        feet: Which markers are on the feet.
        rest_m: How high those are when the foot stands.
    """
    places = marker_positions(model, motion.values)[:, feet]
    speed_m_s = np.linalg.norm(np.gradient(places, motion.times_s, axis=0), axis=-1)
    rests = speed_m_s < STANDS_BELOW_M_S
    resting_m = np.full((len(places), len(model.markers.names)), np.nan)
    resting_m[:, feet] = np.where(rests, rest_m, np.nan)
    if not rests.any():
        return Standing(resting_m, np.nan, np.nan)
    variance_m2 = place_covariance_m2(model, motion)[:, feet, 1, 1]
    # The error is that of the body's distance, the same all the time: more frames don't make it smaller.
    known = float(np.median(variance_m2[rests]))
    return Standing(resting_m, float(np.median((places[..., 1] - rest_m)[rests])), float(np.sqrt(known + SOLE_M**2)))


def with_floor(trial: Trial, resting_m: Float[np.ndarray, "frame marker"]) -> Trial:
    """Add the floor to a trial's cameras, as the last: its pictures' second axis is height, its first is empty."""
    px_per_m = float(trial.priors.bias_sd_px.mean()) / BIAS_M
    height = np.zeros((1, 3, 4))
    height[0, 1, 1], height[0, 2, 3] = px_per_m, 1.0
    rests = np.isfinite(resting_m)
    seen_px = np.zeros((1, *resting_m.shape, 2))
    seen_px[0, ..., 1] = np.where(rests, resting_m * px_per_m, 0.0)
    return replace(
        trial,
        projections=np.concatenate([trial.projections, height]),
        uv_px=np.concatenate([trial.uv_px, seen_px]),
        confidence=np.concatenate([trial.confidence, rests[None].astype(float)]),
        priors=replace(trial.priors, bias_sd_px=np.append(trial.priors.bias_sd_px, SOLE_M * px_per_m)),
        pictures=len(trial.projections),
    )
