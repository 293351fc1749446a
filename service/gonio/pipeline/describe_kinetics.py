"""Describe forces and torques in the words of the report's schema."""

import numpy as np

from gonio.kernel.kinematics.clinical import find_clinical_angles
from gonio.pipeline.forces import TASK_WORDS
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.pressure import Measured
from gonio.pipeline.report_base import Side
from gonio.pipeline.report_kinetics import FootForce, JointTorque, Kinetics, PressureReport
from gonio.pipeline.rounding import number, series
from gonio.records import GroundForces, Torques

SIDES: tuple[Side, Side] = ("right", "left")

JOINTS = {
    "hip_flexion": ("hip", "extending"),
    "knee_flexion": ("knee", "extending"),
    "ankle_dorsiflexion": ("ankle", "plantarflexing"),
}


def describe_pressure(measured: Measured) -> PressureReport | None:
    """Describe the clock of the pressure soles, used or not; None where there are no soles or no movement to compare with."""
    clock = measured.clock
    if clock is None:
        return None
    return PressureReport(
        used=measured.pressure is not None,
        offset_ms=number(1e3 * clock.offset_s),
        offset_sd_ms=number(1e3 * clock.sd_s),
        force_offset_ms=number(1e3 * clock.force_offset_s),
        force_offset_sd_ms=number(1e3 * clock.force_sd_s),
        contact_offset_ms=number(1e3 * clock.contact_offset_s),
        contact_offset_sd_ms=number(1e3 * clock.contact_sd_s),
        contacts=clock.events,
        refused=clock.refused,
    )


def describe_kinetics(
    forces: GroundForces | None, torques: Torques | None, found: BodyMotion, coefficients_source: str
) -> Kinetics | None:
    """Describe forces and torques; None where there are none. Torques extend, as the report's moments do."""
    if forces is None or torques is None:
        return None
    known = torques.residual[np.isfinite(torques.residual).all(axis=1), :3]
    return Kinetics(
        task=TASK_WORDS.get(forces.task, forces.task),
        asked=forces.asked,
        fallback=forces.fallback,
        expected_error_nm_kg=number(forces.expected_nm_kg, 3),
        speed_m_s=number(forces.speed_m_s),
        stance_s=number(forces.stance_s, 3),
        coefficients_source=coefficients_source,
        amplitude=number(forces.amplitude),
        residual_rms_n=number(np.sqrt((known**2).sum(axis=1).mean()), 1) if known.size else None,
        feet=[
            FootForce(
                side=side,
                method=forces.methods[foot],
                gain=number(forces.gain[foot], 3),
                forward_n=series(forces.wrench[:, foot, 0]),
                up_n=series(forces.wrench[:, foot, 1]),
                right_n=series(forces.wrench[:, foot, 2]),
                cop_x_m=series(forces.cop_lab_m[:, foot, 0]),
                cop_z_m=series(forces.cop_lab_m[:, foot, 2]),
            )
            for foot, side in enumerate(SIDES)
        ],
        torques=[
            JointTorque.model_validate(
                {
                    "joint": JOINTS[angle.name][0],
                    "side": angle.side,
                    "positive": JOINTS[angle.name][1],
                    "values_nm": series(-angle.sign * torques.values[:, torques.index(angle.coordinate)]),
                    "band_nm": series(torques.band[:, torques.index(angle.coordinate)]),
                    "values_nm_kg": series(
                        -angle.sign * torques.values[:, torques.index(angle.coordinate)] / found.model.mass_kg
                    ),
                    "power_w": series(torques.power_w[:, torques.index(angle.coordinate)]),
                }
            )
            for angle in find_clinical_angles(found.model)
        ],
    )
