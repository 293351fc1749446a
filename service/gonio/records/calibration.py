"""A calibrated rig with all that is known about how good it is."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.records.camera import Rig
from gonio.records.finding import Finding
from gonio.records.intrinsics import Intrinsics
from gonio.records.record import record

Level = Literal["accept", "warn", "reject"]
LabSource = Literal["board", "points", "walker", "cameras"]
"""What told where the lab is: a board on the floor, points that were named, somebody who walked, or only the cameras'
own upright posture, which is a guess."""

UNKNOWNS = (
    "rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "shift_x_m", "shift_y_m", "shift_z_m",
    "focal_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "delay_s",
)  # fmt: skip
"""A camera's unknowns, in the order of covariances: ``T_cam_lab ← [exp(rotation), shift] T_cam_lab``, optics, delay."""


@record
class Judgement:
    """One criterion's outcome: the measured value against its limits; ``where`` names the camera."""

    name: str
    level: Level
    value: float
    accept: float
    warn: float
    where: str = ""


@record
class Verdict:
    """All judgements, and the worst of them."""

    level: Level
    judgements: tuple[Judgement, ...]

    def of(self, name: str) -> tuple[Judgement, ...]:
        """Give the judgements by one criterion."""
        return tuple(judgement for judgement in self.judgements if judgement.name == name)


@record
class Volume:
    """The box that the board was swept through, along the lab's axes, and the error to expect of a point in it.

    ``error_m`` is the root mean square over a grid of 3 × 3 × 3 points of what the cameras' uncertainty alone does to a
    point that they see exactly, after the best rigid alignment: a common shift or turn is a matter of the lab frame, and
    camera poses, centres and focal lengths make up for each other. NaN where fewer than two cameras see any of it.
    """

    lower_lab_m: Float[np.ndarray, "3"]
    upper_lab_m: Float[np.ndarray, "3"]
    error_m: float


@record
class LabFrame:
    """Where the lab is: ``T_lab_ref`` takes the first camera's frame to the lab.

    ``misfit_m`` is how far what told it disagrees with itself (NaN where it can't); ``tilt_sd_rad`` is how well the
    vertical is known, about the axis that is known worst.
    """

    T_lab_ref: Float[np.ndarray, "4 4"]
    source: LabSource
    misfit_m: float
    tilt_sd_rad: float


@record
class RigCheck:
    """How an earlier calibration fits a new sweep; arrays run over the cameras that both have.

    ``shift_px`` is by how much a camera's picture of the board is off from its old place, in the median. ``turned_rad`` and
    ``shifted_m`` say how far each camera is from where it was, against the steady ones; of those that is the comparison's
    own uncertainty. Their standard deviations are half of how far two halves of the sweep differ (NaN where a half can't
    stand alone); what the earlier calibration was off by is not in them. ``T_lab_cam1`` takes the
    first of these cameras' frame to the earlier calibration's lab.
    """

    camera_names: tuple[str, ...]
    shift_px: Float[np.ndarray, " camera"]
    moved: Bool[np.ndarray, " camera"]
    turned_rad: Float[np.ndarray, " camera"]
    shifted_m: Float[np.ndarray, " camera"]
    shift_sd_px: Float[np.ndarray, " camera"]
    turned_sd_rad: Float[np.ndarray, " camera"]
    shifted_sd_m: Float[np.ndarray, " camera"]
    T_lab_cam1: Float[np.ndarray, "4 4"]


@record
class Calibration:
    """A calibrated rig: where the cameras stand, how late they run, and how well all of it is known.

    ``delay_s`` is by how much each camera runs late against the first (positive: it shows what was). ``covariance`` is
    that of all cameras' :data:`UNKNOWNS`, in the order camera, unknown, 0 for what was held; ``sigma_px`` the noise of
    a corner. ``left_out`` names cameras that could not be connected; ``findings`` are what its report says in words.
    """

    rig: Rig
    intrinsics: tuple[Intrinsics, ...]
    delay_s: Float[np.ndarray, " camera"]
    covariance: Float[np.ndarray, "unknown unknown"]
    sigma_px: float
    lab: LabFrame
    volume: Volume
    verdict: Verdict
    board: str
    left_out: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.rig.cameras)
        if len(self.intrinsics) != count or len(self.delay_s) != count or len(self.covariance) != 16 * count:
            raise InputError(
                f"The calibration has {count} cameras, but intrinsics of {len(self.intrinsics)} and delays of "
                f"{len(self.delay_s)}.",
                hint="Give all of it for each camera, and a covariance of 16 unknowns a camera.",
                code="calibration-incomplete",
            )

    @property
    def delay_sd_s(self) -> Float[np.ndarray, " camera"]:
        """How well each delay is known."""
        return np.sqrt(np.diag(self.covariance)[15::16])
