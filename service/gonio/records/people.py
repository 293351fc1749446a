"""Several people: what the cameras report of all of them, and who they are."""

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.errors import InputError
from gonio.records.points import ImagePoints, look_frames
from gonio.records.record import record
from gonio.records.timebase import Timebase


@record
class Sightings:
    """Everybody whom each camera reports, frame by frame.

    A camera has some places for people; who is in which place may change from frame to frame and means nothing. Pixels,
    confidence and ``stride`` as in :class:`gonio.records.ImagePoints`; an empty place is NaN.
    """

    camera_names: tuple[str, ...]
    keypoint_names: tuple[str, ...]
    timebase: Timebase
    uv_px: Float[np.ndarray, "camera frame place keypoint 2"]
    confidence: Float[np.ndarray, "camera frame place keypoint"]
    stride: int = 1

    def __post_init__(self) -> None:
        if len(self.camera_names) != self.uv_px.shape[0] or len(self.keypoint_names) != self.uv_px.shape[3]:
            raise InputError(
                f"{len(self.camera_names)} cameras and {len(self.keypoint_names)} keypoints are named, "
                f"but the people have shape {self.uv_px.shape}.",
                hint="Name each camera and each keypoint.",
            )

    @property
    def looks(self) -> Int[np.ndarray, " look"]:
        """The frames in which people were looked for."""
        return look_frames(self.uv_px.shape[1], self.stride)


@record
class Person:
    """One person through all cameras and the whole trial.

    ``place`` is where the person is among a camera's :class:`Sightings` (-1: not seen); ``points`` are those sightings.
    ``centre_lab_m`` is the median of the keypoints in the frames where two cameras agree, NaN elsewhere.
    """

    place: Int[np.ndarray, "camera frame"]
    points: ImagePoints
    centre_lab_m: Float[np.ndarray, "frame 3"]

    @property
    def met(self) -> Bool[np.ndarray, " frame"]:
        """The frames in which cameras agree on the person."""
        return np.isfinite(self.centre_lab_m[:, 0])

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last frame in which cameras agree on the person."""
        frames = np.flatnonzero(self.met)
        return int(frames[0]), int(frames[-1])

    @property
    def sightings(self) -> int:
        """In how many pictures, of all cameras and frames, the person was seen."""
        return int((self.place >= 0).sum())
