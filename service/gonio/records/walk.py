"""A steady walk whose every moment is known."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records.body import BodyModel
from gonio.records.record import record

FEET = ("right", "left")
"""The order of the foot axis, here and in wrenches."""


@record
class Steps:
    """When and where the feet stand in a steady walk towards +X; shares are of the stride, heels at z = ``heel_z_m``.

    A foot's phase is 0 when its heel strikes, which first happens ``strike`` after the stride's beginning. Its whole sole
    is down from the phase ``flat`` to the phase ``heel_off``, and it leaves the ground at the phase ``stance``. Its first
    strike is at x = ``speed_m_s`` · ``stride_s`` · ``strike``, the next ones a stride's length further on; the foot points
    outwards by ``toe_out_rad``.
    """

    stride_s: float
    speed_m_s: float
    strike: Float[np.ndarray, " foot"]
    flat: Float[np.ndarray, " foot"]
    heel_off: Float[np.ndarray, " foot"]
    stance: Float[np.ndarray, " foot"]
    heel_z_m: Float[np.ndarray, " foot"]
    toe_out_rad: float

    def __post_init__(self) -> None:
        share = (self.flat < self.heel_off) & (self.heel_off < self.stance) & (0.5 < self.stance) & (self.stance < 0.8)
        if len(self.strike) != len(FEET) or not share.all():
            raise InputError(
                "These steps are no walk.", hint="Each foot stands for 50 to 80 % of the stride, the right one first."
            )

    def phase(self, foot: int, stride_phase: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Give a foot's own phase, 0 to 1, where the stride's phase is as given."""
        return np.mod(stride_phase - self.strike[foot], 1.0)


@record
class Walk:
    """A periodic walk of a body: the truth of the virtual laboratory, at any time.

    ``harmonics`` holds, for each coordinate (rad, m), its mean, the amplitudes of the cosines of 1, 2, … times the stride's
    frequency, and those of the sines; ``pelvis_tx`` has the steady speed on top. At time 0 a stride begins, and the
    right heel strikes at x = ``start_m``.
    """

    body: BodyModel
    steps: Steps
    start_m: float
    harmonics: Float[np.ndarray, "harmonic coordinate"]


@record
class FootEvents:
    """When a foot strikes the ground and when it leaves it, in frames with a fraction."""

    strike_frames: Float[np.ndarray, " strike"]
    lift_frames: Float[np.ndarray, " lift"]


@record
class WalkTruth:
    """Everything about a walk at the frames' times: rad, m, N, Nm.

    ``wrench`` is what the ground does to each foot, in the lab, its moment about the lab's origin; ``cop_lab_m`` where it
    presses (NaN while the foot is in the air). ``generalized_forces`` are those of the coordinates with these wrenches:
    joint moments, and zero, to rounding, for the pelvis, which nothing holds.
    """

    times_s: Float[np.ndarray, " frame"]
    coordinate_names: tuple[str, ...]
    q: Float[np.ndarray, "frame coordinate"]
    velocity: Float[np.ndarray, "frame coordinate"]
    acceleration: Float[np.ndarray, "frame coordinate"]
    generalized_forces: Float[np.ndarray, "frame coordinate"]
    wrench: Float[np.ndarray, "frame foot 6"]
    cop_lab_m: Float[np.ndarray, "frame foot 3"]
    com_lab_m: Float[np.ndarray, "frame 3"]
    events: tuple[FootEvents, FootEvents]

    def of(self, name: str) -> Float[np.ndarray, " frame"]:
        """Give the course of one coordinate by name."""
        return self.q[:, self.coordinate_names.index(name)]

    def moment_of(self, name: str) -> Float[np.ndarray, " frame"]:
        """Give the generalized force of one coordinate by name, Nm (N for a slide)."""
        return self.generalized_forces[:, self.coordinate_names.index(name)]
