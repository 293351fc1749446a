"""Joint torques of a movement and the ground's forces, with 95 % bands that contain the force method's own error.

Torques are linear in the wrenches, so that their slopes by shear are those of unit forces at the centres of pressure. What
the errors of the movement, of the soles and of their clock do is found by drawing them and computing all again: the feet, the
centre of mass and the torques move together, which no sum of separate parts would keep.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from gonio.errors import InputError
from gonio.kernel.body.forward import body_poses
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.recursive import Dynamics, Wrench, solve_dynamics
from gonio.kernel.forces.estimate import ForceChoice, estimate_forces
from gonio.kernel.forces.whole_body import observe
from gonio.records import FEET, BodyModel, FootPressure, ForceCoefficients, GroundForces, Torques

Smoother: TypeAlias = Callable[[Float[np.ndarray, " frame"], Float[np.ndarray, "frame coordinate"]], SmoothMotion]

DRAWS = 8
BAND = 1.96
SMOOTH_S = 0.15
"""A standard deviation of eight draws is rough: it is averaged over this time."""

LASTING = ((0.5, np.inf), (0.75, 0.2), (0.43, 0.0))
"""The parts of a movement's errors: share of the standard deviation, and for how long it lasts, s."""


@dataclass(frozen=True)
class SoleDoubt:
    """Standard deviations of what is wrong with soles: gain, centre of pressure (m, constant), clock (s)."""

    gain: float = 0.05
    cop_m: float = 0.005
    clock_s: float = 0.006


def foot_wrenches(forces: GroundForces) -> tuple[Wrench, ...]:
    """Give the wrenches as inverse dynamics takes them, on the heels' bodies."""
    return tuple(
        Wrench(body=f"calcn_{side[0]}", force_n=forces.wrench[:, foot, :3], moment_nm=forces.wrench[:, foot, 3:])
        for foot, side in enumerate(FEET)
    )


def find_torques(
    model: BodyModel,
    motion: SmoothMotion,
    forces: GroundForces,
    coefficients: ForceCoefficients,
    sd_rest: Float[np.ndarray, "frame coordinate"] | None = None,
) -> Torques:
    """Compute the torques and their bands.

    Args:
        model: The body.
        motion: The movement at the forces' times.
        forces: Under the feet. Where a foot's are not known, the torques of that leg and the residual are NaN.
        coefficients: Those by which the forces were found.
        sd_rest: From all errors but the shear's (:func:`sample_errors`); None: they are not known, and bands are NaN.
    """
    dynamics = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, foot_wrenches(forces))
    values = dynamics.forces.copy()
    unknown = np.asarray(np.isnan(forces.wrench).any(axis=2))
    for foot, side in enumerate(FEET):
        leg = np.array([name.endswith(f"_{side[0]}") for name in model.coordinates.names])
        values[unknown[:, foot, None] & leg] = np.nan
    residual = np.concatenate([dynamics.net_force_n, dynamics.net_moment_nm], axis=1) - forces.wrench.sum(axis=1)
    at_pelvis = _pelvis_place(model, motion)
    residual[:, 3:] -= np.cross(at_pelvis, residual[:, :3])
    sd_shear = shear_sd(model, motion, forces, dynamics)
    rest = np.full_like(values, np.nan) if sd_rest is None else sd_rest
    return Torques(
        coordinate_names=model.coordinates.names,
        times_s=forces.times_s,
        values=values,
        power_w=values * motion.velocity,
        sd_shear=np.where(np.isnan(values), np.nan, sd_shear),
        sd_rest=rest,
        band=np.where(np.isnan(values), np.nan, np.hypot(coefficients.band_factor * sd_shear, BAND * rest)),
        residual=residual,
    )


def shear_sd(
    model: BodyModel, motion: SmoothMotion, forces: GroundForces, dynamics: Dynamics
) -> Float[np.ndarray, "frame coordinate"]:
    """Give the standard deviation of the torques from that of the shear, by the exact slopes ∂τ/∂F."""
    right_lab = np.cross(forces.heading_lab, [0.0, 1.0, 0.0])
    variance = np.zeros_like(dynamics.forces)
    known = foot_wrenches(forces)
    for foot in range(len(FEET)):
        for axis, direction in enumerate((forces.heading_lab, right_lab)):
            force = forces.sd_n[:, foot, axis, None] * direction
            moment = np.cross(np.nan_to_num(forces.cop_lab_m[:, foot]), force)
            more = replace(known[foot], force_n=force, moment_nm=moment)
            pushed = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, (*known, more))
            variance += (pushed.forces - dynamics.forces) ** 2
    return np.sqrt(variance)


def sample_errors(
    model: BodyModel,
    times_s: Float[np.ndarray, " frame"],
    q: Float[np.ndarray, "frame coordinate"],
    covariance: Float[np.ndarray, "frame coordinate coordinate"] | None,
    smoother: Smoother,
    wrenches_of: Callable[[SmoothMotion, np.random.Generator], tuple[Wrench, ...]],
    seed: int = 0,
) -> Float[np.ndarray, "frame coordinate"]:
    """Give the standard deviation of the torques from errors of the movement and of whatever ``wrenches_of`` draws.

    Args:
        model: The body.
        times_s: Of the frames.
        q: Before the smoothing, without NaN.
        covariance: Of the coordinates in each frame; None or NaN: no error.
        smoother: Filters and differentiates.
        wrenches_of: Gives the wrenches for a movement with errors, with errors of their own.
        seed: Of the draws.
    """
    rng = np.random.default_rng(seed)
    factors = None if covariance is None else _factors(covariance)
    found = np.empty((DRAWS, *q.shape))
    for draw in range(DRAWS):
        error = 0.0 if factors is None else np.einsum("fij,fj->fi", factors, lasting_errors(rng, times_s, q.shape[1]))
        motion = smoother(times_s, q + error)
        found[draw] = solve_dynamics(
            model, motion.q, motion.velocity, motion.acceleration, wrenches_of(motion, rng)
        ).forces
    variance = np.nan_to_num(np.var(found, axis=0, ddof=1))
    rate_hz = (len(times_s) - 1) / float(times_s[-1] - times_s[0])
    return np.sqrt(gaussian_filter1d(variance, SMOOTH_S * rate_hz / 2, axis=0, mode="nearest"))


def doubtful_soles(
    pressure: FootPressure,
    model: BodyModel,
    coefficients: ForceCoefficients,
    choice: ForceChoice,
    doubt: SoleDoubt,
) -> Callable[[SmoothMotion, np.random.Generator], tuple[Wrench, ...]]:
    """Make what :func:`sample_errors` asks for: forces that are found anew, from soles with errors that are drawn."""

    def draw(motion: SmoothMotion, rng: np.random.Generator) -> tuple[Wrench, ...]:
        wrong = FootPressure(
            times_s=pressure.times_s + doubt.clock_s * rng.standard_normal(),
            vertical_n=pressure.vertical_n * (1.0 + doubt.gain * rng.standard_normal(len(FEET))),
            cop_foot_m=pressure.cop_foot_m + doubt.cop_m * rng.standard_normal((len(FEET), 2)),
        )
        try:
            return foot_wrenches(estimate_forces(wrong, observe(model, motion), coefficients, choice))
        except InputError:  # a draw without contact adds no wrench
            return ()

    return draw


def lasting_errors(
    rng: np.random.Generator, times_s: Float[np.ndarray, " frame"], columns: int
) -> Float[np.ndarray, "frame column"]:
    """Draw errors of unit variance with a constant part, one that lasts, and one that is new in each frame."""
    step_s = float(np.median(np.diff(times_s)))
    total = np.zeros((len(times_s), columns))
    for share, lasts_s in LASTING:
        white = rng.standard_normal((len(times_s), columns))
        if np.isinf(lasts_s):
            white[:] = white[0]
        elif lasts_s > 0:
            decay = np.exp(-step_s / lasts_s)
            for frame in range(1, len(white)):
                white[frame] = decay * white[frame - 1] + np.sqrt(1 - decay**2) * white[frame]
        total += share * white
    return total


def _factors(
    covariance: Float[np.ndarray, "frame coordinate coordinate"],
) -> Float[np.ndarray, "frame coordinate coordinate"]:
    """Give a symmetric root of each frame's covariance: it changes smoothly from frame to frame, unlike a triangular one."""
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    return np.einsum("fij,fj,fkj->fik", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)


def _pelvis_place(model: BodyModel, motion: SmoothMotion) -> Float[np.ndarray, "frame 3"]:
    return body_poses(model, motion.q)[:, model.bodies.index("pelvis"), :3, 3]
