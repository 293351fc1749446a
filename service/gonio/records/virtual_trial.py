"""A recording of the virtual laboratory, beside its truth."""

import numpy as np
from jaxtyping import Float, UInt8

from gonio.records.camera import Rig
from gonio.records.points import ImagePoints
from gonio.records.record import record
from gonio.records.timebase import Timebase
from gonio.records.walk import Walk, WalkTruth

HIDDEN, PULLED, BURST, SWAPPED, DROPPED, OUTSIDE = 1, 2, 4, 8, 16, 32
"""What was done to an observation; ``VirtualTrial.cause`` holds their sum: behind a limb, drawn to the near limb, an outlier,
on the wrong leg, lost, outside the picture."""


@record
class VirtualTrial:
    """What the cameras report of a walk, and what is true.

    ``points`` and ``rig`` are what a laboratory would have: keypoints on the nominal clock ``points.timebase``, and cameras
    as calibrated. The rest nobody knows outside: ``truth`` at the nominal times, ``xyz_lab_m``, where the keypoints then
    sit in the *model* (joint centres), ``seen_lab_m``, where they sit on the person (other if the person is not the model),
    the cameras as they are, the times at which each really took its frames, the exact pictures of the keypoints at those
    times, and the cause of each error.
    """

    walk: Walk
    seed: int
    rig: Rig
    points: ImagePoints
    truth: WalkTruth
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]
    seen_lab_m: Float[np.ndarray, "frame keypoint 3"]
    rig_true: Rig
    camera_times_s: Float[np.ndarray, "camera frame"]
    exact_px: Float[np.ndarray, "camera frame keypoint 2"]
    cause: UInt8[np.ndarray, "camera frame keypoint"]

    @property
    def timebase(self) -> Timebase:
        """The nominal clock of the frames."""
        return self.points.timebase
