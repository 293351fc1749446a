"""What is kept of a trial's videos for people to look at: a still picture of each camera, and a small video."""

from pathlib import Path
from typing import Self

from gonio.records import Capture
from gonio.records.points import look_frames
from gonio.vision.frame import Frame
from gonio.vision.pictures import encode_jpeg
from gonio.vision.previews import Preview

PICTURE_SIDE_PX = 960


class Album:
    """Keeps a picture and a preview of each camera while the frames go by; ``add`` may be called from several threads."""

    def __init__(self, capture: Capture, stride: int, output_dir: Path) -> None:
        self.middle = capture.frame_count // 2
        self._views = capture.views
        self._looks = set(look_frames(capture.frame_count, stride).tolist())
        self._pictures: dict[int, tuple[Path, float]] = {}
        self._folder = output_dir / "pictures"
        self._previews: list[Preview] = []
        if all(view.path is not None for view in capture.views):
            self._folder.mkdir(parents=True, exist_ok=True)
            rate_hz = capture.timebase.rate_hz / stride
            self._previews = [Preview(self._folder / f"camera{i + 1}.webm", rate_hz) for i in range(len(self._views))]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for preview in self._previews:
            preview.close()

    def add(self, index: int, camera: int, frame: Frame) -> None:
        """Take what is wanted of a frame."""
        if index in self._looks:
            self._previews[camera].add(frame)
        if index == self.middle:
            view = self._views[camera]
            rgb = frame.rgb(PICTURE_SIDE_PX)
            path = self._folder / f"{view.camera_name}.jpg"
            path.write_bytes(encode_jpeg(rgb))
            self._pictures[camera] = path, rgb.shape[1] / view.image_size_px[0]

    @property
    def pictures(self) -> tuple[Path, ...]:
        """The pictures of frame ``middle``, in the order of the cameras."""
        return tuple(self._pictures[camera][0] for camera in sorted(self._pictures))

    @property
    def scales(self) -> tuple[float, ...]:
        """The pictures' sizes against the videos'."""
        return tuple(self._pictures[camera][1] for camera in sorted(self._pictures))

    @property
    def previews(self) -> tuple[Path, ...]:
        """The previews, in the order of the cameras."""
        return tuple(preview.path for preview in self._previews)
