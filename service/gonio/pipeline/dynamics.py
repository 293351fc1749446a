"""Stage ``dynamics``: joint torques and powers with their error bands, judged by what the pelvis has left over."""

from collections.abc import Callable
from functools import partial

import numpy as np

from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.recursive import Wrench
from gonio.kernel.dynamics.zero_lag import differentiate
from gonio.kernel.forces.torque import (
    SoleDoubt,
    doubtful_soles,
    find_torques,
    foot_wrenches,
    sample_errors,
)
from gonio.kernel.kinematics.clinical import ClinicalAngle, find_clinical_angles
from gonio.pipeline.findings import finding
from gonio.pipeline.forces import CUTOFF_HZ, SLOW_HZ, force_choice, smooth_motion
from gonio.pipeline.moments import worst_moment
from gonio.pipeline.motion import BodyMotion, complete, covariance_of
from gonio.pipeline.params import Parameters
from gonio.pipeline.pressure import Measured
from gonio.pipeline.run import Outcome
from gonio.records import ForceCoefficients, GroundForces, TimeCurve, Torques

LARGEST_RESIDUAL = 0.20
"""Root mean square of the force that the movement needs beyond what the feet give, by the body's weight: the virtual demo's
walk, with the errors of real keypoints and soles, has 0.13."""

MOMENTS = {
    "hip_flexion": ("hip_extension_moment", "hip_power", -1.0),
    "knee_flexion": ("knee_extension_moment", "knee_power", -1.0),
    "ankle_dorsiflexion": ("ankle_plantarflexion_moment", "ankle_power", -1.0),
}
"""What the report calls the moment and the power about an angle; its moments extend, the angles flex."""


def find_joint_torques(
    found: BodyMotion,
    measured: Measured,
    forces: GroundForces | None,
    parameters: Parameters,
    coefficients: ForceCoefficients,
) -> Outcome[Torques | None]:
    """Compute torques with bands; None without forces.

    Args:
        found: The motion, with its covariance.
        measured: The soles, whose errors the bands contain.
        forces: Under the feet.
        parameters: The method and the task.
        coefficients: By which the forces were found.
    """
    if forces is None:
        return Outcome(None)
    model, q, motion = found.model, complete(found), smooth_motion(found, forces.task)
    wrenches_of = _fixed(forces)
    if measured.pressure is not None and forces.methods != ("plates", "plates"):
        clock_s = measured.clock.sd_s if measured.clock is not None else SoleDoubt.clock_s
        doubt = SoleDoubt(clock_s=clock_s if np.isfinite(clock_s) else SoleDoubt.clock_s)
        choice = force_choice(parameters.forces, forces.task)
        wrenches_of = doubtful_soles(measured.pressure, model, coefficients, choice, doubt)
    smoother = partial(differentiate, cutoff_hz=CUTOFF_HZ.get(forces.task, SLOW_HZ))
    rest, covariance = None, covariance_of(found)
    if covariance is not None:  # without it nobody knows how wide a band is
        rest = sample_errors(model, found.motion.times_s, q, covariance, smoother, wrenches_of)
    torques = find_torques(model, motion, forces, coefficients, rest)
    known = np.isfinite(torques.residual).all(axis=1)
    residual = (
        float(np.sqrt((torques.residual[known, :3] ** 2).sum(axis=1).mean())) / model.weight_n if known.any() else 0.0
    )
    if residual <= LARGEST_RESIDUAL:
        return Outcome(torques)
    span_s = worst_moment(np.linalg.norm(torques.residual[:, :3], axis=1), torques.times_s)
    return Outcome(torques, (finding("residuals-high", value=100 * residual, span_s=span_s),))


def moment_curves(found: BodyMotion, torques: Torques | None) -> tuple[TimeCurve, ...]:
    """Give the report's moments (Nm/kg) and powers (W/kg); 1.96 of their standard deviations are the 95 % band."""
    if torques is None:
        return ()
    return tuple(curve for angle in find_clinical_angles(found.model) for curve in _curves(angle, found, torques))


def _curves(angle: ClinicalAngle, found: BodyMotion, torques: Torques) -> tuple[TimeCurve, TimeCurve]:
    moment, power, turn = MOMENTS[angle.name]
    index, mass_kg = torques.index(angle.coordinate), found.model.mass_kg
    sd = torques.band[:, index] / 1.96 / mass_kg
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.abs(torques.power_w[:, index] / torques.values[:, index])
    return (
        TimeCurve(
            quantity=moment,
            side=angle.side,
            unit="Nm/kg",
            values=turn * angle.sign * torques.values[:, index] / mass_kg,
            sd=sd,
        ),
        TimeCurve(
            quantity=power,
            side=angle.side,
            unit="W/kg",
            values=torques.power_w[:, index] / mass_kg,
            sd=sd * rate,
        ),
    )


def _fixed(forces: GroundForces) -> Callable[[SmoothMotion, np.random.Generator], tuple[Wrench, ...]]:
    """Take measured wrenches as they are, whatever the movement."""
    return lambda _motion, _rng: foot_wrenches(forces)
