"""A capture: the videos of one trial, matched to calibrated cameras."""

from pathlib import Path

from gonio.errors import InputError
from gonio.records.camera import Rig
from gonio.records.record import record
from gonio.records.timebase import Timebase


@record
class View:
    """One camera's video: every ``frame_step``-th of its frames, from the first, belongs to the trial's clock.

    ``path`` is the video, None where only keypoints were uploaded; ``poses`` are the keypoints that were found in it by
    another program, None where gonio's own network is to find them.
    """

    camera_name: str
    file_name: str
    path: Path | None
    image_size_px: tuple[int, int]
    rate_hz: float
    frame_count: int
    frame_step: int = 1
    poses: Path | None = None


@record
class Capture:
    """The views of one trial in the order of the rig's cameras, on one clock; ``frame_count`` is what all of them have."""

    rig: Rig
    views: tuple[View, ...]
    timebase: Timebase
    frame_count: int

    def __post_init__(self) -> None:
        if tuple(view.camera_name for view in self.views) != self.rig.names:
            raise InputError(
                "The videos are not in the order of the cameras.", hint="Give one video for each camera of the rig."
            )
