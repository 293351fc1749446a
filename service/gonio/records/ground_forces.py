"""What the ground does to the feet, and the numbers by which its shear is found."""

from collections.abc import Mapping
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from gonio.records.record import record

ForceMethod: TypeAlias = Literal["vertical", "newton_euler", "pivot", "template"]
"""How shear is found: there is none; a share of what the whole body needs; a force through a point above the centre of
mass; that with the course over the contact that people have in common."""

Task: TypeAlias = Literal["walking", "running", "squat", "sit_to_stand", "landing"]


@record
class PhaseTemplate:
    """Shear = Fy · (lever · λ + amplitude · Σ weight · spline(phase)), forwards and sideways (spline: outwards).

    The amplitude, forwards only, is the range of λ over ``reference_range``; NaN: it is 1.
    """

    lever: Float[np.ndarray, "2"]
    forward: Float[np.ndarray, " spline"]
    sideways: Float[np.ndarray, " spline"]
    reference_range: float


@record
class TaskForces:
    """What one task needs: the pivot's gains forwards and sideways, how much of the whole body's moment is fed back.

    ``template`` is None where there is none. ``expected_nm_kg`` is the root mean square error of the knee's flexion moment
    by method, with perfect soles and good movement.
    """

    pivot: Float[np.ndarray, "2"]
    moment_gain: float
    template: PhaseTemplate | None
    expected_nm_kg: Mapping[str, float]


@record
class ForceCoefficients:
    """The numbers by which forces are found, and where they come from.

    ``sd_bw`` is the standard deviation of the template's shear forwards and sideways, in body weights, by equal parts of
    the contact; ``band_factor`` takes the place of 1.96 in 95 % bands, because a person's errors are one offset mostly.
    """

    source: str
    knots: Float[np.ndarray, " knot"]
    tasks: Mapping[str, TaskForces]
    speed_range_m_s: tuple[float, float]
    stance_range_s: tuple[float, float]
    moment_smooth_s: float
    sd_bw: Float[np.ndarray, "2 part"]
    band_factor: float


@record
class GroundForces:
    """What the ground does to each foot (right, left), in the lab.

    ``wrench`` is force, then moment about the lab's origin; zero in the air, NaN where nothing is known. ``cop_lab_m`` is on
    the floor, NaN without contact. ``phase`` runs from 0 to 1 over each contact, NaN outside. ``sd_n`` is the standard
    deviation of the force along ``heading_lab`` (level, unit length) and to its right; 0 in the air and where plates measured.

    ``methods`` says how each foot's shear was found ("plates": measured); ``asked`` is the method that was wanted and
    ``fallback`` why it was not taken, empty if it was. ``expected_nm_kg`` is the error of the knee's flexion moment that the
    method had in people with plates. ``gain`` is the factor that the soles' forces were multiplied by; ``amplitude`` the
    template's; ``speed_m_s`` how fast the body passes over the standing foot, ``stance_s`` the median contact, NaN if there
    is no whole one.
    """

    times_s: Float[np.ndarray, " frame"]
    wrench: Float[np.ndarray, "frame foot 6"]
    cop_lab_m: Float[np.ndarray, "frame foot 3"]
    contact: Bool[np.ndarray, "frame foot"]
    phase: Float[np.ndarray, "frame foot"]
    sd_n: Float[np.ndarray, "frame foot 2"]
    heading_lab: Float[np.ndarray, "frame 3"]
    methods: tuple[str, str]
    asked: str
    task: str
    fallback: str
    expected_nm_kg: float
    gain: Float[np.ndarray, " foot"]
    amplitude: float
    speed_m_s: float
    stance_s: float
