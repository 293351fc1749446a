"""Stage ``forces``: the wrenches under both feet, measured by plates or found from soles and movement, and judged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gonio.errors import InputError
from gonio.formats.force_coefficients import builtin_force_coefficients, read_force_coefficients
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.zero_lag import FEWEST_FRAMES, differentiate
from gonio.kernel.forces.estimate import ForceChoice, estimate_forces, measured_forces, with_plates
from gonio.kernel.forces.whole_body import observe
from gonio.pipeline.body import only_file
from gonio.pipeline.findings import finding
from gonio.pipeline.motion import BodyMotion, complete
from gonio.pipeline.params import ForceParameters, Parameters
from gonio.pipeline.pressure import Measured
from gonio.pipeline.run import CaptureFile, Outcome
from gonio.records import FEET, BodyModel, Finding, ForceCoefficients, GroundForces

CUTOFF_HZ = {"running": 15.0, "landing": 12.0}
"""Of the movement's low-pass by task, where it is not :data:`SLOW_HZ`: impacts are faster."""

SLOW_HZ = 6.0
TASK_WORDS = {"sit_to_stand": "sit-to-stand", "squat": "squats and other slow tasks"}
"""The words for tasks that are not their names."""

NEEDED = ("pelvis", "calcn_r", "calcn_l", "toes_r", "toes_l")


def choose_coefficients(files: Sequence[CaptureFile]) -> ForceCoefficients:
    """Read the lab's own coefficients of the shear if there are any, else gonio's.

    Raises:
        InputError: ``force-coefficients-invalid``, or the session has several.
    """
    own = only_file(files, "force_coefficients")
    return read_force_coefficients(own) if own is not None else builtin_force_coefficients()


def find_forces(
    found: BodyMotion, measured: Measured, parameters: Parameters, coefficients: ForceCoefficients
) -> Outcome[GroundForces | None]:
    """Find what the ground does to the feet; None where nothing was measured, or the mass is not known.

    Args:
        found: The motion and its body.
        measured: What soles and plates measured.
        parameters: The method, the task, and the subject's mass.
        coefficients: Of the shear.
    """
    soles, plates, model = measured.pressure, measured.plates, found.model
    if soles is None and plates is None:
        return Outcome(None)
    if parameters.subject.mass_kg is None:
        return Outcome(None, (finding("torque-mass-missing"),))
    q = complete(found)
    if not set(NEEDED) <= set(model.bodies.names) or np.isfinite(q).all(axis=1).sum() < FEWEST_FRAMES:
        return Outcome(None, (finding("forces-missing", where="the movement of pelvis and feet is not known"),))
    choice = force_choice(parameters.forces)
    cutoff_hz = CUTOFF_HZ.get(choice.task or "", SLOW_HZ)
    body = observe(model, differentiate(found.motion.times_s, q, cutoff_hz))
    if soles is None:
        assert plates is not None
        forces = measured_forces(plates, body)
        return Outcome(forces, judge_forces(forces, model))
    try:
        forces = estimate_forces(soles, body, coefficients, choice)
        faster_hz = CUTOFF_HZ.get(forces.task, cutoff_hz)
        if faster_hz != cutoff_hz:
            body = observe(model, differentiate(found.motion.times_s, q, faster_hz))
            forces = estimate_forces(soles, body, coefficients, force_choice(parameters.forces, forces.task))
    except InputError as error:
        return Outcome(None, (finding("forces-missing", where=error.message.rstrip(".")),))
    if plates is not None:
        forces = with_plates(forces, plates)
    return Outcome(forces, judge_forces(forces, model))


def force_choice(asked: ForceParameters, task: str = "") -> ForceChoice:
    """Give the kernel what the request asks for; ``task`` is what was recognised."""
    choice = ForceChoice(method=asked.method)
    named = task or asked.task
    if named != "recognise":
        choice = replace(choice, task=named)
    return choice


def smooth_motion(found: BodyMotion, task: str) -> SmoothMotion:
    """Filter and differentiate the motion as its task needs."""
    return differentiate(found.motion.times_s, complete(found), CUTOFF_HZ.get(task, SLOW_HZ))


def judge_forces(forces: GroundForces, model: BodyModel) -> tuple[Finding, ...]:
    """Say how forces were found and how far that is right, and what makes them worse."""
    task = TASK_WORDS.get(forces.task, forces.task)
    estimated = next((method for method in forces.methods if method != "plates"), "")
    findings: list[Finding] = []
    if estimated:
        findings.append(finding("forces-method", where=f"{estimated}, for {task}", value=forces.expected_nm_kg))
        gains = ", ".join(f"{side} {gain:.2f}" for side, gain in zip(FEET, forces.gain, strict=True))
        findings.append(finding("forces-gain", where=gains, value=100 * float(np.abs(forces.gain - 1).max())))
    if forces.fallback and forces.task == "walking":
        findings.append(finding("forces-outside-range", where=forces.fallback))
    if estimated and forces.task == "landing":
        findings.append(finding("forces-indicative", value=forces.expected_nm_kg))
    loaded = np.nanmax(np.nan_to_num(forces.wrench[..., 1]), axis=0) > 0.06 * model.weight_n
    for side, carries in zip(FEET, loaded, strict=True):
        if not carries:
            findings.append(finding("forces-one-foot", where=side))
    return tuple(findings)
