"""The walker: a body that walks, with joint angles, joint moments and ground forces that belong to each other."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.scaling import scale_model
from gonio.kernel.body.soles import measure_sole
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.virtual_lab.fit import fit_harmonics, node_phases
from gonio.kernel.virtual_lab.ground import share_out
from gonio.kernel.virtual_lab.harmonics import coordinates_at
from gonio.kernel.virtual_lab.steps import Limp, plan_steps
from gonio.kernel.virtual_lab.wanted import lead
from gonio.records import FEET, BodyModel, FootEvents, Steps, Walk, WalkTruth

START_M = -1.8


def grow(body: BodyModel, stature_m: float, mass_kg: float) -> BodyModel:
    """Scale a built-in body to a stature, alike in all directions, and to a mass.

    Raises:
        InputError: an impossible stature or mass, or a body without the marker ``vertex``.
    """
    if not 0.5 < stature_m < 2.5:
        raise InputError(f"A stature of {stature_m} m is impossible.", hint="Give the person's height in metres.")
    place = marker_positions(body, body.coordinates.default[None])[0]
    tall_m = place[body.markers.index("vertex"), 1] - place[body.markers.index("heel_r"), 1]
    return scale_model(body, np.full((len(body.bodies.names), 3), stature_m / tall_m), mass_kg=mass_kg)


def walk(body: BodyModel, speed_m_s: float = 1.25, *, limp: Limp | None = None, start_m: float = START_M) -> Walk:
    """Make a body walk, steadily and straight on, towards +X.

    Angles, forces and steps follow published curves as nearly as mechanics allows; see
    :mod:`gonio.kernel.virtual_lab.wanted` for the curves, :mod:`gonio.kernel.virtual_lab.fit` for the mechanics. The same
    arguments give the same walk: nothing is random.

    Args:
        body: One of the built-in bodies, of any size.
        speed_m_s: How fast. Published curves cover about 0.7 to 1.7 m/s for an adult.
        limp: A leg that is spared.
        start_m: Where the right heel strikes at time 0.

    Raises:
        InputError: a speed without curves, or a body that lacks a bone or coordinate of the built-in ones.
        SolverError: no walk was found near the curves.
    """
    steps, gait = plan_steps(body, speed_m_s, limp)
    sole = measure_sole(body)
    wanted = lead(body, steps, gait, sole, limp, node_phases())
    return Walk(body=body, steps=steps, start_m=start_m, harmonics=fit_harmonics(body, steps, sole, wanted))


def truth_at(walk: Walk, times_s: Float[np.ndarray, " frame"]) -> WalkTruth:
    """Give everything about a walk at any times; events as frames of these times, which are evenly spread."""
    course = coordinates_at(walk, times_s)
    free = solve_dynamics(walk.body, *course)
    ground = share_out(walk, times_s, free)
    wrench = ground.wrench
    pushed = tuple(
        Wrench(body=f"calcn_{side[0]}", force_n=wrench[:, foot, :3], moment_nm=wrench[:, foot, 3:])
        for foot, side in enumerate(FEET)
    )
    loaded = ground.force_n[..., 1:2] > 0
    right, left = (_events(walk.steps, foot, times_s) for foot in range(len(FEET)))
    return WalkTruth(
        times_s=times_s,
        coordinate_names=walk.body.coordinates.names,
        q=course.q,
        velocity=course.velocity,
        acceleration=course.acceleration,
        generalized_forces=solve_dynamics(walk.body, *course, pushed).forces,
        wrench=wrench,
        cop_lab_m=np.where(loaded, ground.cop_lab_m, np.nan),
        com_lab_m=free.com_lab_m,
        events=(right, left),
    )


def _events(steps: Steps, foot: int, times_s: Float[np.ndarray, " frame"]) -> FootEvents:
    def frames_at(phase: float) -> Float[np.ndarray, " event"]:
        first, last = np.array([times_s[0], times_s[-1]]) / steps.stride_s - phase
        at_s = (np.arange(np.ceil(first), np.floor(last) + 1) + phase) * steps.stride_s
        return np.interp(at_s, times_s, np.arange(len(times_s)))

    strike = float(steps.strike[foot])
    return FootEvents(strike_frames=frames_at(strike), lift_frames=frames_at(strike + float(steps.stance[foot])))
