"""What the walker must obey: feet that stand, forces that the ground can give, toes that clear the floor.

Each term is a residual at moments of the stride (the nodes), in units of its own tolerance, with its derivatives with
respect to the free coordinates, their rates, and the rates' rates at the same node.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.body.forward import marker_jacobian, marker_positions
from gonio.kernel.body.soles import BALL, EDGE, HEEL, TIP, Sole
from gonio.kernel.dynamics.recursive import Dynamics, solve_dynamics
from gonio.kernel.virtual_lab.feet import directions, heels_on_floor, load_shares
from gonio.kernel.virtual_lab.harmonics import Course
from gonio.kernel.virtual_lab.wanted import Wanted
from gonio.records import FEET, BodyModel, Steps

STAND_M = 0.0005
"""Tolerance of a foot that carries the body: it then slides and sinks by less than 3 mm, at all speeds (tests/laws)."""

LIGHTEST = 0.01
"""A foot that carries little may move: its tolerance is divided by its share of the load, or by this where that is less."""

LEVEL_M = 0.0005  # of the edge against the toe joint, 30 mm apart: 1°
ROLL_M = 0.004  # the same while the heel rises
TOES_DOWN_M = 0.0005
CLEARANCE_M = 0.013  # of toes and heel in mid-swing; 13 mm is the mean minimum of Winter 1992, Phys Ther 72:45-53
CLEAR_M = 0.001
BEND_M = 0.001

FORCE_BW = (0.04, 0.04, 0.10)  # of the net ground force, forwards, up, to the right
PRESSURE_M = 0.012  # of the centre of pressure of both feet together
FREE_MOMENT_BW_M = 0.0075  # 6 Nm of a man's weight, as feet on a floor show


class Term(NamedTuple):
    """A residual and its derivatives, at some of the nodes; None where it does not depend on the rates."""

    residual: Float[np.ndarray, "chosen row"]
    by_q: Float[np.ndarray, "chosen row free"]
    nodes: Bool[np.ndarray, " node"]
    by_velocity: Float[np.ndarray, "chosen row free"] | None = None
    by_acceleration: Float[np.ndarray, "chosen row free"] | None = None


class Soles(NamedTuple):
    """The points of both soles at the nodes, and how they move with the free coordinates."""

    place_m: Float[np.ndarray, "node foot point 3"]
    jacobian: Float[np.ndarray, "node foot point 3 free"]


def see_soles(marked: BodyModel, q: Float[np.ndarray, "node coordinate"], free: Int[np.ndarray, " free"]) -> Soles:
    """Find the points that :func:`gonio.kernel.body.soles.mark_soles` has put on a body."""
    shape = (len(q), len(FEET), 4, 3)
    jacobian = marker_jacobian(marked, q)[..., free]
    return Soles(marker_positions(marked, q).reshape(shape), jacobian.reshape(*shape, len(free)))


def stand(steps: Steps, sole: Sole, stride_phase: Float[np.ndarray, " node"], soles: Soles) -> list[Term]:
    """Hold the heel in place until it rises, the toe joint from when the sole is down, the sole level in between.

    All in the frame that walks along, where places on the floor move back at the walking speed.
    """
    heels = heels_on_floor(steps, stride_phase)
    terms: list[Term] = []
    for foot, turn in enumerate(directions(steps)):
        phase = steps.phase(foot, stride_phase)
        firm = np.sqrt(np.maximum(load_shares(steps, stride_phase)[:, foot], LIGHTEST))
        down, risen = phase >= steps.flat[foot], phase > steps.heel_off[foot]
        on_toes = down & (phase <= steps.stance[foot])
        place, jacobian = soles.place_m[:, foot], soles.jacobian[:, foot]
        heel = heels[:, foot]
        terms.append(_hold(place[:, HEEL] - heel, jacobian[:, HEEL], ~risen, STAND_M / firm))
        ball = place[:, BALL] - heel - turn @ sole.ball_m[foot]
        terms.append(_hold(ball, jacobian[:, BALL], on_toes, STAND_M / firm))
        edge = (place[:, EDGE] - place[:, BALL])[:, 1:2], (jacobian[:, EDGE] - jacobian[:, BALL])[:, 1:2]
        terms.append(_hold(*edge, down & ~risen, LEVEL_M / firm))
        terms.append(_hold(*edge, risen & on_toes, ROLL_M / firm))
        tip = (place[:, TIP, 1] - sole.ball_m[foot, 1])[:, None]
        terms.append(_hold(tip, jacobian[:, TIP, 1:2], on_toes, TOES_DOWN_M / firm))
    return terms


def _hold(
    error_m: Float[np.ndarray, "node row"],
    jacobian: Float[np.ndarray, "node row free"],
    when: Bool[np.ndarray, " node"],
    tolerance_m: Float[np.ndarray, " node"],
) -> Term:
    scale = 1.0 / tolerance_m[when, None]
    return Term(scale * error_m[when], scale[..., None] * jacobian[when], when)


def clear(steps: Steps, sole: Sole, stride_phase: Float[np.ndarray, " node"], soles: Soles) -> list[Term]:
    """Keep the soles out of the floor, and clear of it in swing: a cost where a point comes too low, and hardly else.

    The residual (√(d² + ε²) − d) / 2 of the clearance d to spare is −d below and 0 above, bent smoothly over ε.
    """
    terms: list[Term] = []
    for foot in range(len(FEET)):
        swing = (steps.phase(foot, stride_phase) - steps.stance[foot]) / (1.0 - steps.stance[foot])
        resting_m = np.where(np.arange(4) == HEEL, 0.0, sole.ball_m[foot, 1])
        least_m = resting_m + CLEARANCE_M * np.sin(np.pi * np.clip(swing, 0.0, 1.0))[:, None] ** 2
        spare_m = soles.place_m[:, foot, :, 1] - least_m
        bent_m = np.hypot(spare_m, BEND_M)
        slope = (spare_m / bent_m - 1.0)[..., None] * soles.jacobian[:, foot, :, 1]
        everywhere = np.ones(len(stride_phase), dtype=bool)
        terms.append(Term((bent_m - spare_m) / (2.0 * CLEAR_M), slope / (2.0 * CLEAR_M), everywhere))
    return terms


def carry(body: BodyModel, course: Course, wanted: Wanted, free: Int[np.ndarray, " free"]) -> Term:
    """Let the motion need the ground force that is wanted, at the place where it is wanted.

    The six rows are the net force, and its moment about the wanted centre of pressure.
    """
    weight_n = -body.mass_kg * body.gravity_m_s2[1]
    force_n = wanted.force_n.sum(axis=1)
    moment_nm = np.cross(wanted.cop_m, wanted.force_n).sum(axis=1)
    pressure_m = (wanted.cop_m * wanted.force_n[..., 1:2]).sum(axis=1) / force_n[:, 1:2]
    tolerance = weight_n * np.array([*FORCE_BW, PRESSURE_M, FREE_MOMENT_BW_M, PRESSURE_M])

    def about_pressure(net: Float[np.ndarray, "node *rest 6"], place: Float[np.ndarray, "node *ones 3"]) -> np.ndarray:
        turned = net[..., 3:] - np.cross(place, net[..., :3])
        return np.concatenate([net[..., :3], turned], axis=-1) / tolerance

    net, slopes = _differentiate(body, course, free)
    lacking = net - np.hstack([force_n, moment_nm])
    by_q, by_velocity, by_acceleration = (
        np.moveaxis(about_pressure(slope, pressure_m[:, None]), 1, 2) for slope in slopes
    )
    everywhere = np.ones(len(course.q), dtype=bool)
    return Term(about_pressure(lacking, pressure_m), by_q, everywhere, by_velocity, by_acceleration)


def _differentiate(
    body: BodyModel, course: Course, free: Int[np.ndarray, " free"]
) -> tuple[Float[np.ndarray, "node 6"], tuple[Float[np.ndarray, "node free 6"], ...]]:
    """Give the net wrench that the motion needs about the origin, and its derivatives by q, velocity and acceleration.

    Central differences. The wrench is quadratic in the rates and linear in their rates, so that those steps may be long.
    """
    nodes, columns = course.q.shape
    shifts = np.zeros((2 * 3 * len(free), 3, columns))
    for part, step in enumerate((1e-5, 1.0, 1.0)):
        for number, coordinate in enumerate(free):
            row = 2 * (part * len(free) + number)
            shifts[row, part, coordinate], shifts[row + 1, part, coordinate] = step, -step
    q, velocity, acceleration = (
        (values[None] + shifts[:, part, None]).reshape(-1, columns) for part, values in enumerate(course)
    )
    stacked = _net(solve_dynamics(body, q, velocity, acceleration)).reshape(3, len(free), 2, nodes, 6)
    differences = (stacked[:, :, 0] - stacked[:, :, 1]) / np.array([2e-5, 2.0, 2.0])[:, None, None, None]
    by_q, by_velocity, by_acceleration = (np.moveaxis(difference, 0, 1) for difference in differences)
    return _net(solve_dynamics(body, *course)), (by_q, by_velocity, by_acceleration)


def _net(dynamics: Dynamics) -> Float[np.ndarray, "node 6"]:
    return np.hstack([dynamics.net_force_n, dynamics.net_moment_nm])
