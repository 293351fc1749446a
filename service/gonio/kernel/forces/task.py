"""Which task a recording shows, from the contacts of its feet and the movement's need of force."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.forces.contact import Contact, mark, median_frames
from gonio.kernel.forces.shear import OTHER_CONTACT_BW
from gonio.kernel.forces.whole_body import WholeBody
from gonio.kernel.smoothing.filters import runs
from gonio.records import ForceCoefficients, Task

FLIGHT_BW = 0.5
"""In flight the body needs next to no force: without contact, but with a need, a foot stands where nothing measures it."""

FLIGHT_S = 0.04
STEP_SHARE = 0.15
"""Who stands on one foot for a smaller share of the time takes no steps."""

TOGETHER_S = 0.12
"""After a jump both feet land within this time."""


class Course(NamedTuple):
    """How somebody moves over the ground: speed over the standing foot, m/s, and the median contact, s; NaN if not known."""

    speed_m_s: float
    stance_s: float


def recognise_task(body: WholeBody, contacts: tuple[Contact, ...]) -> Task:
    """Tell the task from the contacts; what is none of the others is a squat, which has the constants of slow tasks."""
    marked = mark(contacts, len(body.times_s))
    flights = find_flights(body, marked)
    if any(_land_together(body, contacts, end) for _, end in flights):
        return "landing"
    single = float((marked.sum(axis=1) == 1).mean())
    if flights and single > STEP_SHARE:
        return "running"
    if single > STEP_SHARE and {contact.foot for contact in contacts} == {0, 1}:
        return "walking"
    return "squat"


def sits(body: WholeBody, vertical_n: Float[np.ndarray, "frame foot"], contacts: tuple[Contact, ...]) -> bool:
    """Say whether something else than the feet carries part of the body for a while, as a chair does."""
    lacking = body.need_n[:, 1] - np.nansum(vertical_n, axis=1) > 2 * OTHER_CONTACT_BW * body.weight_n
    lacking &= mark(contacts, len(lacking)).all(axis=1)
    return any(end - begin > 0.3 * body.rate_hz for begin, end in runs(lacking))


def find_flights(body: WholeBody, marked: Bool[np.ndarray, "frame foot"]) -> list[tuple[int, int]]:
    """Find when the body flies: runs of frames without contact and without a need of force."""
    flying = ~marked.any(axis=1) & (body.need_n[:, 1] < FLIGHT_BW * body.weight_n)
    return [run for run in runs(flying) if run[1] - run[0] >= FLIGHT_S * body.rate_hz]


def find_course(body: WholeBody, contacts: tuple[Contact, ...]) -> Course:
    """Find speed and median contact.

    The speed is the body's mean in the lab minus that of heels in mid-stance, which a treadmill carries back.
    """

    def forward_m_s(place_m: Float[np.ndarray, "frame 3"]) -> Float[np.ndarray, " frame"]:
        return (np.gradient(place_m, body.times_s, axis=0) * body.heading_lab).sum(axis=1)

    heel_m_s = [forward_m_s(body.T_lab_heel[:, foot, :3, 3]) for foot in range(2)]
    belt_m_s: list[float] = []
    for contact in contacts:
        if contact.whole:
            length = contact.end - contact.begin
            middle = slice(contact.begin + round(0.25 * length), contact.begin + round(0.55 * length) + 1)
            belt_m_s.append(float(np.mean(heel_m_s[contact.foot][middle])))
    known = [speed for speed in belt_m_s if np.isfinite(speed)]
    body_m_s = forward_m_s(body.com_lab_m)
    seen = np.isfinite(body_m_s)
    speed = float(body_m_s[seen].mean() - np.median(known)) if known and seen.any() else np.nan
    return Course(speed, median_frames(contacts) / body.rate_hz)


def outside_range(course: Course, coefficients: ForceCoefficients) -> str:
    """Say why a walk is none of those that the template was made of; empty if it is one, or if that can't be told."""
    for value, (low, high), digits, what, unit in (
        (course.speed_m_s, coefficients.speed_range_m_s, 2, "the speed", "m/s"),
        (course.stance_s, coefficients.stance_range_s, 2, "the stance", "s"),
    ):
        if np.isfinite(value) and not low <= round(value, digits) <= high:
            return f"{what} is {value:.2f} {unit}, and the template was made from {low:g} to {high:g} {unit}"
    return ""


def _land_together(body: WholeBody, contacts: tuple[Contact, ...], end: int) -> bool:
    """Say whether both feet come down at the end of a flight, and stay."""
    near = [c.foot for c in contacts if abs(c.begin - end) <= TOGETHER_S * body.rate_hz]
    overlap = mark(contacts, len(body.times_s))[end : end + max(round(2 * TOGETHER_S * body.rate_hz), 1)]
    return set(near) == {0, 1} and bool(overlap.all(axis=1).mean() > 0.4)
