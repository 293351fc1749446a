"""Share what the ground must do to the body between the feet.

Newton and Euler say what both feet together must do: six numbers. With one foot on the ground that is the whole truth; its
centre of pressure is where the moment leaves no turning about a horizontal axis. With two, six numbers are missing, and
are chosen as people do: the vertical force passes smoothly from foot to foot; both centres of pressure stay as near to their
usual way as the sum allows; the horizontal forces keep their published ratio to the vertical ones (the front foot brakes
while the rear one pushes), and what is then lacking of the sum is shared like the weight.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from gonio.kernel.body.soles import measure_sole
from gonio.kernel.dynamics.recursive import Dynamics
from gonio.kernel.virtual_lab.feet import load_shares
from gonio.kernel.virtual_lab.normal_gait import NormalGait, normal_gait
from gonio.kernel.virtual_lab.steps import pace_of
from gonio.kernel.virtual_lab.wanted import TOWARDS_BODY, cop_lead, normal_phase
from gonio.records import FEET, Walk


class GroundForces(NamedTuple):
    """What the ground does to the feet: forces, where they press on the floor, and free moments about the vertical."""

    force_n: Float[np.ndarray, "time foot 3"]
    cop_lab_m: Float[np.ndarray, "time foot 3"]
    free_moment_nm: Float[np.ndarray, "time foot"]

    @property
    def wrench(self) -> Float[np.ndarray, "time foot 6"]:
        """Force, then moment about the lab's origin."""
        moment = np.cross(self.cop_lab_m, self.force_n)
        moment[..., 1] += self.free_moment_nm
        return np.concatenate([self.force_n, moment], axis=-1)


def share_out(walk: Walk, times_s: Float[np.ndarray, " time"], dynamics: Dynamics) -> GroundForces:
    """Share the net wrench of the motion (from inverse dynamics without outer forces) between the feet.

    Their sum is the net wrench, to rounding. A foot in the air gets nothing.
    """
    phase = times_s / walk.steps.stride_s
    share = load_shares(walk.steps, phase)
    net_n, net_nm, com_m = dynamics.net_force_n, dynamics.net_moment_nm, dynamics.com_lab_m
    vertical_n = share * net_n[:, 1:2]

    cop_m = cop_lead(walk.steps, measure_sole(walk.body), phase)
    cop_m[..., 0] += (walk.start_m + walk.steps.speed_m_s * times_s)[:, None]
    pressure_m = np.stack([net_nm[:, 2], -net_nm[:, 0]], axis=-1) / net_n[:, 1:2]  # where no horizontal moment is left
    across = cop_m[..., [0, 2]]
    lacking_m = pressure_m - (share[..., None] * across).sum(axis=1)
    weight = share / (share**2).sum(axis=1, keepdims=True)
    cop_m[..., [0, 2]] = across + weight[..., None] * lacking_m[:, None]

    gait = normal_gait(pace_of(walk.body, walk.steps.speed_m_s))
    shear_n = np.empty((*share.shape, 2))
    for foot in range(len(FEET)):
        ratio = _forward_ratio(gait)(normal_phase(walk.steps, gait, foot, phase))
        shear_n[:, foot, 0] = ratio * vertical_n[:, foot]
        tilt = (com_m[:, 2] - cop_m[:, foot, 2]) / com_m[:, 1]
        shear_n[:, foot, 1] = TOWARDS_BODY * tilt * vertical_n[:, foot]
    shear_n += share[..., None] * (net_n[:, [0, 2]] - shear_n.sum(axis=1))[:, None]
    force_n = np.stack([shear_n[..., 0], vertical_n, shear_n[..., 1]], axis=-1)
    free_nm = net_nm[:, 1] - np.cross(cop_m, force_n)[..., 1].sum(axis=1)
    return GroundForces(force_n, cop_m, share * free_nm[:, None])


def _forward_ratio(gait: NormalGait) -> PchipInterpolator:
    """Give the published forward over vertical force by phase; held where the foot is hardly loaded."""
    phase = np.arange(0, 50) / 50
    vertical, forward = gait.at("vertical_force", phase), gait.at("forward_force", phase)
    loaded = (vertical > 0.2) & (phase > 0.03)
    knots = np.concatenate([[-1.0], phase[loaded], [2.0]])
    ratio = (forward / np.maximum(vertical, 0.2))[loaded]
    return PchipInterpolator(knots, np.concatenate([ratio[:1], ratio, ratio[-1:]]))
