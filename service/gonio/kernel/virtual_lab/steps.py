"""Plan the steps of a walk.

Cadence and step length follow from the speed by the walk ratio (step length over cadence), which healthy adults keep at
all speeds above about 1 m/s: 0.0065 m/(steps/min), the value of 62 m/min at 98 steps/min in Murakami R & Otaka Y 2017,
"Estimated lower speed boundary at which the walk ratio constancy is broken in healthy adults", J Phys Ther Sci 29:722-725.
It is kept below that speed, too, and scaled to other sizes as mechanics scales: lengths with the leg, times with its root.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gonio.errors import InputError
from gonio.kernel.body.forward import body_poses
from gonio.kernel.virtual_lab.normal_gait import PACES, NormalGait, normal_gait
from gonio.records import FEET, BodyModel, Steps

WALK_RATIO = 0.0065  # m/(steps/min) of a leg of REFERENCE_LEG_M, the built-in man's
REFERENCE_LEG_M = 0.907

STEP_WIDTH = 0.11  # heel to heel, over the leg's length: 0.10 m, an ordinary adult's
TOE_OUT_RAD = np.deg2rad(6.0)  # mean foot progression of the curves' source in mid-stance
FLAT = 0.15  # share of stance until the sole is down: these angles bring the built-in body's foot to 1° there


@dataclass(frozen=True)
class Limp:
    """A leg that its owner spares: it stands for less time, bends less at the knee, and so steps unevenly.

    ``stance`` and ``knee_flexion`` are shares of normal.
    """

    side: Literal["right", "left"] = "right"
    stance: float = 0.93
    knee_flexion: float = 0.65


def leg_length_m(body: BodyModel) -> float:
    """Give the height of the hip joint over the heel in the default pose."""
    T_lab_body = body_poses(body, body.coordinates.default[None])[0]
    return float(T_lab_body[body.bodies.index("femur_r"), 1, 3] - T_lab_body[body.bodies.index("calcn_r"), 1, 3])


def pace_of(body: BodyModel, speed_m_s: float) -> float:
    """Give the speed over √(gravity · leg length): equal paces are mechanically alike."""
    return speed_m_s / float(np.sqrt(-body.gravity_m_s2[1] * leg_length_m(body)))


def plan_steps(body: BodyModel, speed_m_s: float, limp: Limp | None) -> tuple[Steps, NormalGait]:
    """Choose the steps for a speed; give the curves of that speed, too.

    Raises:
        InputError: a speed at which there are no curves for this size of body.
    """
    leg_m = leg_length_m(body)
    pace = pace_of(body, speed_m_s)
    if not PACES[0] <= pace <= PACES[1]:
        slowest, fastest = (limit * speed_m_s / pace for limit in PACES)
        raise InputError(
            f"A speed of {speed_m_s} m/s is outside what published curves cover for legs of {leg_m:.2f} m.",
            hint=f"Choose {slowest:.2f} to {fastest:.2f} m/s.",
        )
    gait = normal_gait(pace)
    cadence = np.sqrt(60.0 * speed_m_s / (WALK_RATIO * (leg_m / REFERENCE_LEG_M) ** 1.5))
    strike, stance = np.array([0.0, 0.5]), np.full(2, gait.stance)
    if limp is not None:
        spared = FEET.index(limp.side)
        # Both phases of double support keep their length; what the spared leg loses, the other one stands longer.
        double = gait.stance - 0.5
        stance[spared] = limp.stance * gait.stance
        stance[1 - spared] = 1.0 + 2.0 * double - stance[spared]
        strike[1] = stance[0] - double
    return Steps(
        stride_s=120.0 / float(cadence),
        speed_m_s=speed_m_s,
        strike=strike,
        flat=FLAT * stance,
        heel_off=gait.heel_off * stance,
        stance=stance,
        heel_z_m=np.array([0.5, -0.5]) * STEP_WIDTH * leg_m,
        toe_out_rad=TOE_OUT_RAD,
    ), gait
