"""Shear under the feet, from vertical force, its place, and the movement of the whole body.

With the height h of the centre of mass over a foot's centre of pressure and λ = (com − cop) / h, level, forwards and to the
right, a force through a point above the centre of mass has the shear Fy · gain · λ. How people differ from that over a
contact is nearly the same in all of them: the template adds it. What the moments about the centre of mass lack then,

    F_M = (dH/dt + Σ Fy λ h) / h,        d = F_M − Σ F

is given to the feet in part. The share that follows from the net force alone is there to be compared with.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter1d

from gonio.kernel.forces.contact import Contact
from gonio.kernel.forces.whole_body import WholeBody
from gonio.records import ForceCoefficients, PhaseTemplate

OTHER_CONTACT_BW = 0.18
"""Where soles and movement differ by so much, something else pushes, a chair or a hand: moments about feet tell nothing."""

OUTWARDS = np.array([1.0, -1.0])
"""Of the right and the left foot, to the right."""


class Load(NamedTuple):
    """What is known under the feet, at the movement's frames; NaN outside of contacts."""

    vertical_n: Float[np.ndarray, "frame foot"]
    cop_lab_m: Float[np.ndarray, "frame foot 3"]
    phase: Float[np.ndarray, "frame foot"]
    contacts: tuple[Contact, ...]


class Levers(NamedTuple):
    """Level directions λ from the centres of pressure to the centre of mass, over its height h above them."""

    forward: Float[np.ndarray, "frame foot"]
    right: Float[np.ndarray, "frame foot"]
    height_m: Float[np.ndarray, "frame foot"]


def find_levers(body: WholeBody, cop_lab_m: Float[np.ndarray, "frame foot 3"]) -> Levers:
    """Give λ and h of each foot; NaN where there is no centre of pressure."""
    arm = body.com_lab_m[:, None] - cop_lab_m
    height = arm[..., 1]
    forward, right = ((arm * axis[:, None]).sum(axis=-1) for axis in (body.heading_lab, body.right_lab))
    return Levers(forward / height, right / height, height)


def no_shear(load: Load) -> Float[np.ndarray, "frame foot 2"]:
    """Take the force as vertical."""
    return np.zeros((*load.vertical_n.shape, 2))


def net_share(body: WholeBody, load: Load) -> Float[np.ndarray, "frame foot 2"]:
    """Give each foot its share, by vertical force, of the level force that the whole body needs."""
    need = np.stack([(body.need_n * axis).sum(axis=1) for axis in (body.heading_lab, body.right_lab)], axis=1)
    return (load.vertical_n / np.nansum(load.vertical_n, axis=1, keepdims=True))[..., None] * need[:, None]


def through_pivot(load: Load, levers: Levers, gains: Float[np.ndarray, "2"]) -> Float[np.ndarray, "frame foot 2"]:
    """Let the force pass through a point above the centre of mass."""
    return load.vertical_n[..., None] * gains * np.stack([levers.forward, levers.right], axis=-1)


def by_template(
    load: Load, levers: Levers, template: PhaseTemplate, knots: Float[np.ndarray, " knot"], amplitude: float
) -> Float[np.ndarray, "frame foot 2"]:
    """Add the course over the contact that people have in common."""
    inside = np.isfinite(load.phase)
    splines = np.zeros((*load.phase.shape, len(knots) - 4))
    splines[inside] = BSpline.design_matrix(np.clip(load.phase[inside], 0.0, 1.0), knots, 3).toarray()
    bias = np.stack([amplitude * (splines @ template.forward), OUTWARDS * (splines @ template.sideways)], axis=-1)
    return through_pivot(load, levers, template.lever) + load.vertical_n[..., None] * bias


def find_amplitude(load: Load, levers: Levers, template: PhaseTemplate) -> float:
    """Give the template's amplitude: how far λ swings in whole contacts, by what is usual; 1 without one."""
    if np.isnan(template.reference_range):
        return 1.0
    ranges: list[float] = []
    for contact in load.contacts:
        course = levers.forward[contact.begin : contact.end, contact.foot]
        if contact.whole and np.isfinite(course).sum() > 3:
            low, high = np.nanpercentile(course, [2, 98])
            ranges.append(float(high - low))
    return float(np.median(ranges)) / template.reference_range if ranges else 1.0


def feed_back_moment(
    body: WholeBody,
    load: Load,
    levers: Levers,
    shear_n: Float[np.ndarray, "frame foot 2"],
    gain: float,
    coefficients: ForceCoefficients,
) -> Float[np.ndarray, "frame foot 2"]:
    """Give the feet, by vertical force, a part of what the whole body's turning about its right-hand axis lacks."""
    if gain == 0.0:
        return shear_n
    total_n = np.nansum(load.vertical_n, axis=1)
    standing = total_n > 0
    known = np.isfinite(levers.height_m)
    height_m = np.nansum(levers.height_m, axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    turning_nm = (body.turning_nm * body.right_lab).sum(axis=1)
    wanted_n = (turning_nm + np.nansum(load.vertical_n * levers.forward * levers.height_m, axis=1)) / height_m
    lacking_n = wanted_n - np.nansum(shear_n[..., 0], axis=1)
    lacking_n[~_alone(body, total_n) | ~np.isfinite(lacking_n)] = 0.0
    smooth_n = gaussian_filter1d(lacking_n, coefficients.moment_smooth_s * body.rate_hz, mode="nearest")
    share = load.vertical_n / np.where(standing, total_n, np.nan)[:, None]
    return np.stack([shear_n[..., 0] + gain * smooth_n[:, None] * share, shear_n[..., 1]], axis=-1)


def _alone(body: WholeBody, total_n: Float[np.ndarray, " frame"]) -> Bool[np.ndarray, " frame"]:
    """Mark where nothing but the feet carries the body."""
    return np.asarray(np.abs(total_n - body.need_n[:, 1]) <= OTHER_CONTACT_BW * body.weight_n)
