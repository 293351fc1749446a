"""The feet of a walk: where they stand, which way they point, and how they share the load."""

import numpy as np
from jaxtyping import Float

from gonio.records import FEET, Steps


def directions(steps: Steps) -> Float[np.ndarray, "foot 3 3"]:
    """Give the turn R_lab_foot of each foot that stands flat: outwards by the toe-out angle."""
    turns = np.zeros((len(FEET), 3, 3))
    for foot, outwards in enumerate((1.0, -1.0)):
        c, s = np.cos(steps.toe_out_rad), outwards * np.sin(steps.toe_out_rad)
        turns[foot] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    return turns


def heels_on_floor(steps: Steps, stride_phase: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node foot 3"]:
    """Give where the heels stand, in the frame that walks along at the mean speed: they drift back from each strike on."""
    places = np.zeros((len(stride_phase), len(FEET), 3))
    for foot in range(len(FEET)):
        places[:, foot, 0] = -steps.speed_m_s * steps.stride_s * steps.phase(foot, stride_phase)
        places[:, foot, 2] = steps.heel_z_m[foot]
    return places


def load_shares(steps: Steps, stride_phase: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node foot"]:
    """Give each foot's share of the vertical force: 0 in swing, 1 alone, a smooth exchange while both feet stand.

    The exchange is the polynomial 10 u³ − 15 u⁴ + 6 u⁵ of the time u since the strike, over the time of double support:
    its first and second derivatives vanish at both ends, so that forces start and end without a jerk.
    """
    shares = np.empty((len(stride_phase), len(FEET)))
    for foot in range(len(FEET)):
        phase, other = steps.phase(foot, stride_phase), steps.phase(1 - foot, stride_phase)
        # The other foot's double support with this one begins at this foot's strike and ends when the other leaves.
        rise_time = np.mod(steps.strike[1 - foot] + steps.stance[1 - foot] - steps.strike[foot], 1.0)
        fall_time = np.mod(steps.strike[foot] + steps.stance[foot] - steps.strike[1 - foot], 1.0)
        falling = np.where(other <= phase, _exchange(other / fall_time), 0.0)
        shares[:, foot] = _exchange(phase / rise_time) * (1.0 - falling)
        shares[phase >= steps.stance[foot], foot] = 0.0
    return shares


def _exchange(u: Float[np.ndarray, " node"]) -> Float[np.ndarray, " node"]:
    u = np.clip(u, 0.0, 1.0) ** 0.7
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
