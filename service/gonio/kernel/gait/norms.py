"""How far a walk is from that of healthy people.

The Gait Variable Score of an angle is the root mean square difference over the cycle between a person's mean curve and the
healthy mean; the score of a side is the root mean square over its angles [Baker et al. 2009, Gait & Posture 30:265-269].
Baker's Gait Profile Score takes nine angles of pelvis, hip, knee, ankle and foot. With the sagittal ones alone it is a part
of that, and its numbers must not be compared with published ones.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from gonio.records import NormCondition, Norms

GRAVITY_M_S2 = 9.80665


def dimensionless_speed(speed_m_s: float, leg_length_m: float) -> float:
    """Give speed / √(gravity · leg length) [Hof 1996, Gait & Posture 4:222-223]."""
    return speed_m_s / float(np.sqrt(GRAVITY_M_S2 * leg_length_m))


def condition_at(norms: Norms, speed: float) -> NormCondition:
    """Choose the curves for a dimensionless speed; those of the middle condition where it is not known."""
    if not np.isfinite(speed):
        return norms.conditions[len(norms.conditions) // 2]
    fitting = [c for c in norms.conditions if c.slowest <= speed < c.fastest]
    return fitting[0] if fitting else norms.conditions[-1]


def gait_variable_score(curve: Float[np.ndarray, " point"], norm_mean: Float[np.ndarray, " point"]) -> float:
    """Give the root mean square difference over the known points, in the curves' unit; NaN if none is known."""
    difference = (curve - norm_mean)[np.isfinite(curve)]
    return float(np.sqrt(np.mean(difference**2))) if difference.size else np.nan


def profile_score(scores: Sequence[float]) -> float:
    """Give the root mean square of the known scores of a side; NaN if none is known."""
    known = np.array([s for s in scores if np.isfinite(s)])
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan
