"""Forces under the feet from pressure and movement: contact, gain, place in the lab, task, shear."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from gonio.errors import InputError
from gonio.kernel.forces.contact import find_contacts, mark, phases
from gonio.kernel.forces.shear import (
    Levers,
    Load,
    by_template,
    feed_back_moment,
    find_amplitude,
    find_levers,
    net_share,
    no_shear,
    through_pivot,
)
from gonio.kernel.forces.task import Course, find_course, outside_range, recognise_task, sits
from gonio.kernel.forces.whole_body import WholeBody, cop_in_lab
from gonio.kernel.smoothing.filters import runs
from gonio.records import FEET, FootForces, FootPressure, ForceCoefficients, ForceMethod, GroundForces, Task

LONGEST_GAP_S = 0.16
"""Nothing is interpolated across a longer time without a sample: at 20 Hz, more than two lost ones."""

LEAST_COP_N = 20.0
"""A centre of pressure under less force is noise."""

GAIN_SD = 0.1
"""How far a sole's gain is from 1, before anything is known of it."""

GAIN_NOISE_BW = 0.1
"""How far soles and movement differ otherwise, and..."""

GAIN_MEMORY_S = 0.1
"""...how long such a difference lasts: so far apart frames count as independent."""

OTHER_BW = 0.3
"""A larger difference is a chair, or a foot of which nothing is known: it tells nothing of gains."""

EDGE_S = 0.05
"""At the ends of a recording accelerations are distorted by the filter."""


@dataclass(frozen=True)
class ForceChoice:
    """What was asked for; None: gonio recognises the task. ``calibrate`` finds the soles' gains from the body's weight."""

    method: ForceMethod = "template"
    task: Task | None = None
    calibrate: bool = True


def estimate_forces(
    pressure: FootPressure, body: WholeBody, coefficients: ForceCoefficients, choice: ForceChoice | None = None
) -> GroundForces:
    """Find the wrenches under both feet.

    Args:
        pressure: On the movement's clock, N. Lost samples are NaN; across short gaps there is interpolation, in long ones
            and outside of the stream the foot's wrench is NaN.
        body: The movement; frames with NaN give NaN in contact.
        coefficients: The numbers of the methods.
        choice: The method and the task.

    Raises:
        InputError: ``forces-no-contact``: no foot carries anything.
    """
    choice = choice or ForceChoice()
    vertical_n, cop_foot_m = resample(pressure, body.times_s)
    gain = find_gain(vertical_n, body) if choice.calibrate else np.ones(len(FEET))
    vertical_n = vertical_n * gain
    contacts = find_contacts(vertical_n, body.rate_hz, body.weight_n)
    if not contacts:
        raise InputError(
            "The pressure stream shows no contact of a foot with the ground.",
            hint="Check the unit of the forces, and that the stream covers the trial.",
            code="forces-no-contact",
        )
    contact = mark(contacts, len(body.times_s))
    cop_lab_m = np.where(contact[..., None], cop_in_lab(body, cop_foot_m), np.nan)
    load = Load(
        vertical_n=np.where(contact, vertical_n, np.nan),
        cop_lab_m=cop_lab_m,
        phase=phases(contacts, len(body.times_s)),
        contacts=contacts,
    )
    task = choice.task or recognise_task(body, contacts)
    if choice.task is None and task == "squat" and sits(body, vertical_n, contacts):
        task = "sit_to_stand"
    course, levers = find_course(body, contacts), find_levers(body, cop_lab_m)
    method, fallback = _choose(choice.method, task, course, coefficients)
    shear_n, amplitude = _shear(body, load, levers, coefficients, method, task)
    return _assemble(
        body,
        load,
        shear_n,
        np.isnan(vertical_n),
        GroundForces(
            times_s=body.times_s,
            wrench=np.zeros((len(contact), len(FEET), 6)),
            cop_lab_m=cop_lab_m,
            contact=contact,
            phase=load.phase,
            sd_n=force_sd(load.phase, body.weight_n, coefficients, method, task),
            heading_lab=body.heading_lab,
            methods=(method, method),
            asked=choice.method,
            task=task,
            fallback=fallback,
            expected_nm_kg=coefficients.tasks[task].expected_nm_kg[method],
            gain=gain,
            amplitude=amplitude,
            speed_m_s=course.speed_m_s,
            stance_s=course.stance_s,
        ),
    )


def with_plates(forces: GroundForces, plates: FootForces) -> GroundForces:
    """Put what plates measured in the place of what was found: contact by contact, wherever a plate knows all of it.

    A foot's method is "plates" if they measured all its contacts.
    """
    wrench, cop, sd_n = forces.wrench.copy(), forces.cop_lab_m.copy(), forces.sd_n.copy()
    methods = list(forces.methods)
    for foot in range(len(FEET)):
        measured = np.isfinite(plates.wrench[:, foot]).all(axis=1) & (plates.wrench[:, foot, 1] > 0)
        touched = runs(forces.contact[:, foot] | measured)
        known = [run for run in touched if measured[run[0] : run[1]].any()]
        known = [run for run in known if np.isfinite(plates.wrench[run[0] : run[1], foot]).all()]
        for begin, end in known:
            wrench[begin:end, foot] = plates.wrench[begin:end, foot]
            cop[begin:end, foot] = plates.cop_lab_m[begin:end, foot]
            sd_n[begin:end, foot] = 0.0
        if known and len(known) == len(touched):
            methods[foot] = "plates"
    return replace(forces, wrench=wrench, cop_lab_m=cop, sd_n=sd_n, methods=(methods[0], methods[1]))


def measured_forces(plates: FootForces, body: WholeBody) -> GroundForces:
    """Give plates' wrenches the form of those that were found; NaN where a foot stands beside the plates."""
    vertical_n = plates.wrench[..., 1]
    contacts = find_contacts(vertical_n, body.rate_hz, body.weight_n)
    course = find_course(body, contacts)
    return GroundForces(
        times_s=plates.times_s,
        wrench=plates.wrench,
        cop_lab_m=plates.cop_lab_m,
        contact=mark(contacts, len(vertical_n)),
        phase=phases(contacts, len(vertical_n)),
        sd_n=np.zeros((len(vertical_n), len(FEET), 2)),
        heading_lab=body.heading_lab,
        methods=("plates", "plates"),
        asked="plates",
        task=recognise_task(body, contacts) if contacts else "walking",
        fallback="",
        expected_nm_kg=0.0,
        gain=np.ones(len(FEET)),
        amplitude=1.0,
        speed_m_s=course.speed_m_s,
        stance_s=course.stance_s,
    )


def resample(
    pressure: FootPressure, times_s: Float[np.ndarray, " frame"]
) -> tuple[Float[np.ndarray, "frame foot"], Float[np.ndarray, "frame foot 2"]]:
    """Bring a stream to the movement's times, places on the sole's own frame; NaN in long gaps and outside.

    Forces follow a curve that keeps their monotony, so that none overshoots or falls below zero; places follow straight
    lines between samples under load, and rest outside of those.
    """
    vertical_n = np.full((len(times_s), len(FEET)), np.nan)
    cop_m = np.full((len(times_s), len(FEET), 2), np.nan)
    for foot in range(len(FEET)):
        known = np.isfinite(pressure.vertical_n[:, foot])
        if known.sum() < 2:
            continue
        sample_s, force_n = pressure.times_s[known], pressure.vertical_n[known, foot]
        vertical_n[:, foot] = PchipInterpolator(sample_s, force_n)(np.clip(times_s, sample_s[0], sample_s[-1]))
        half_s = 0.5 * float(np.median(np.diff(sample_s)))  # a sample stands for its period
        vertical_n[(times_s < sample_s[0] - half_s) | (times_s > sample_s[-1] + half_s), foot] = np.nan
        after = np.clip(np.searchsorted(sample_s, times_s), 1, len(sample_s) - 1)
        lost = sample_s[after] - sample_s[after - 1] > LONGEST_GAP_S
        lost &= (times_s > sample_s[after - 1] + 1e-9) & (times_s < sample_s[after] - 1e-9)
        vertical_n[lost, foot] = np.nan
        placed = known & np.isfinite(pressure.cop_foot_m[:, foot]).all(axis=1)
        placed &= np.nan_to_num(pressure.vertical_n[:, foot]) > LEAST_COP_N
        if placed.any():
            for axis in range(2):
                cop_m[:, foot, axis] = np.interp(
                    times_s, pressure.times_s[placed], pressure.cop_foot_m[placed, foot, axis]
                )
    return vertical_n, cop_m


def find_gain(vertical_n: Float[np.ndarray, "frame foot"], body: WholeBody) -> Float[np.ndarray, " foot"]:
    """Find the factors by which both feet's forces are, in sum, what the movement needs; 1 ± 0.1 before anything is known."""
    need_n, edge = body.need_n[:, 1], round(EDGE_S * body.rate_hz)
    used = np.isfinite(vertical_n).all(axis=1) & np.isfinite(need_n)
    used &= np.abs(np.nansum(vertical_n, axis=1) - need_n) < OTHER_BW * body.weight_n
    used[:edge] = False
    used[len(used) - edge :] = False
    shares, need = vertical_n[used] / body.weight_n, need_n[used] / body.weight_n
    weight = 1.0 / (GAIN_NOISE_BW**2 * max(GAIN_MEMORY_S * body.rate_hz, 1.0))
    system = weight * shares.T @ shares + np.eye(len(FEET)) / GAIN_SD**2
    return np.linalg.solve(system, weight * shares.T @ need + np.ones(len(FEET)) / GAIN_SD**2)


def force_sd(
    phase: Float[np.ndarray, "frame foot"],
    weight_n: float,
    coefficients: ForceCoefficients,
    method: ForceMethod,
    task: Task,
) -> Float[np.ndarray, "frame foot 2"]:
    """Give the standard deviation of the shear over the contact.

    It was measured for the walking template; other methods and tasks have it in proportion to the knee moments' errors.
    """
    walking, here = coefficients.tasks["walking"].expected_nm_kg, coefficients.tasks[task].expected_nm_kg
    parts = coefficients.sd_bw.shape[1]
    part = np.clip(np.nan_to_num(phase) * parts, 0, parts - 1).astype(int)
    sd = coefficients.sd_bw[:, part] * weight_n * here[method] / walking["template"]
    return np.where(np.isfinite(phase)[..., None], np.moveaxis(sd, 0, -1), 0.0)


def _choose(asked: ForceMethod, task: Task, course: Course, coefficients: ForceCoefficients) -> tuple[ForceMethod, str]:
    """Give the method that is used, and why it is not the one that was asked for."""
    if asked != "template":
        return asked, ""
    if coefficients.tasks[task].template is None:
        return "pivot", f"there is no template for {task.replace('_', ' ')}"
    why = outside_range(course, coefficients) if task == "walking" else ""
    return ("pivot", why) if why else ("template", "")


def _shear(
    body: WholeBody,
    load: Load,
    levers: Levers,
    coefficients: ForceCoefficients,
    method: ForceMethod,
    task: Task,
) -> tuple[Float[np.ndarray, "frame foot 2"], float]:
    """Give the shear forwards and to the right, N, and the template's amplitude."""
    numbers, amplitude = coefficients.tasks[task], 1.0
    if method == "vertical":
        return no_shear(load), amplitude
    if method == "newton_euler":
        return net_share(body, load), amplitude
    if method == "template" and numbers.template is not None:
        amplitude = find_amplitude(load, levers, numbers.template)
        shear_n = by_template(load, levers, numbers.template, coefficients.knots, amplitude)
    else:
        shear_n = through_pivot(load, levers, numbers.pivot)
    return feed_back_moment(body, load, levers, shear_n, numbers.moment_gain, coefficients), amplitude


def _assemble(
    body: WholeBody,
    load: Load,
    shear_n: Float[np.ndarray, "frame foot 2"],
    unknown: np.ndarray,
    forces: GroundForces,
) -> GroundForces:
    """Fill in the wrenches about the lab's origin: zero in the air, NaN where the stream knows nothing."""
    force_n = shear_n[..., :1] * body.heading_lab[:, None] + shear_n[..., 1:] * body.right_lab[:, None]
    force_n[..., 1] = load.vertical_n
    wrench = np.concatenate([force_n, np.cross(load.cop_lab_m, force_n)], axis=-1)
    wrench[~forces.contact] = 0.0
    wrench[unknown] = np.nan
    return replace(forces, wrench=wrench)
