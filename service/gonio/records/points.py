"""Keypoints in the images and in the lab."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from gonio.errors import InputError
from gonio.records.record import record
from gonio.records.timebase import Timebase

MISSING, MEASURED, FILLED, REJECTED = 0, 1, 2, 3
"""How a lab point came to be: the values of ``LabPoints.origin``."""


def look_frames(count: int, stride: int) -> Int[np.ndarray, " look"]:
    """Give every ``stride``-th frame, from the first, and the last one."""
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


@record
class ImagePoints:
    """Keypoints of one person in all cameras.

    In pixels of the distorted image; (0, 0) is the centre of the top-left pixel. A point that was not found is NaN, and
    its confidence is then 0. Keypoints were looked for in every ``stride``-th frame, from the first, and in the last one.
    """

    camera_names: tuple[str, ...]
    keypoint_names: tuple[str, ...]
    timebase: Timebase
    uv_px: Float[np.ndarray, "camera frame keypoint 2"]
    confidence: Float[np.ndarray, "camera frame keypoint"]
    stride: int = 1

    def __post_init__(self) -> None:
        if len(self.camera_names) != self.uv_px.shape[0] or len(self.keypoint_names) != self.uv_px.shape[2]:
            raise InputError(
                f"{len(self.camera_names)} cameras and {len(self.keypoint_names)} keypoints are named, "
                f"but the points have shape {self.uv_px.shape}.",
                hint="Name each camera and each keypoint.",
            )
        if np.any(np.isnan(self.uv_px).any(axis=-1) & (self.confidence != 0)):
            raise InputError("A missing point has a confidence.", hint="Set the confidence of missing points to 0.")

    @property
    def looks(self) -> Int[np.ndarray, " look"]:
        """The frames in which keypoints were looked for."""
        return look_frames(self.uv_px.shape[1], self.stride)

    @property
    def sampled(self) -> "ImagePoints":
        """The frames in which keypoints were looked for, as a stream of their own rate."""
        if self.stride == 1:
            return self
        return ImagePoints(
            camera_names=self.camera_names,
            keypoint_names=self.keypoint_names,
            timebase=Timebase(rate_hz=self.timebase.rate_hz / self.stride, start_s=self.timebase.start_s),
            uv_px=self.uv_px[:, :: self.stride],
            confidence=self.confidence[:, :: self.stride],
        )


@record
class LabPoints:
    """Keypoints of one person in the lab, metres, Y up; NaN is missing, ``origin`` says how each value came to be.

    ``covariance_m2`` is each point's covariance from the solver (NaN where missing). ``residual_px`` is each
    observation's reprojection residual (observed minus projected, undistorted pixels), NaN where there was none.
    """

    camera_names: tuple[str, ...]
    keypoint_names: tuple[str, ...]
    timebase: Timebase
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]
    origin: UInt8[np.ndarray, "frame keypoint"]
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"]
    residual_px: Float[np.ndarray, "camera frame keypoint 2"]

    def index(self, name: str) -> int:
        """Give the position of a keypoint by name."""
        return self.keypoint_names.index(name)

    def of(self, name: str) -> Float[np.ndarray, "frame 3"]:
        """Give the trajectory of a keypoint by name."""
        return self.xyz_lab_m[:, self.index(name)]
