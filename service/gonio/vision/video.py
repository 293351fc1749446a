# pyright: standard
# (PyAV's stubs leave much open: streams without a codec context, frames without a time.)
"""Read videos: what a file contains, and its frames one after the other.

Frames are streamed: memory does not grow with the length of the video. Decoding uses one thread; cameras are decoded
side by side, which keeps all cores busy without the 3 to 26 % that FFmpeg's own threads cost.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange
from av.video.stream import VideoStream

from gonio.errors import InputError
from gonio.records import record
from gonio.vision.frame import BT601, BT709, BT2020, Colour, Frame

OPEN_OPTIONS = {
    # An upload may call itself .mp4 and be a playlist that names other files or addresses: nothing but containers.
    "format_whitelist": "mov,matroska,webm,avi,mpegts,mpeg,asf",
    "protocol_whitelist": "file",
}
MP4_FIRST_BOXES = {b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"}
VARIABLE_RATE_FRACTION = 0.25
"""A clock that is off by more than this part of a frame is no uniform clock; a dropped frame is off by a whole one."""

LUMA_WEIGHTS = {1: BT709, 9: BT2020, 10: BT2020}
"""By FFmpeg's AVColorSpace (ITU-T H.273, table 4); all others, and what says nothing, is BT.601, as FFmpeg has it."""


@record
class VideoInfo:
    """What a video file contains.

    ``image_size_px`` is width and height as the picture is viewed; ``rotation_deg`` is how far, clockwise, the coded
    picture is turned for that. ``frame_count`` is counted, not believed. ``rate_hz`` is the container's rate if the
    frames' times agree with it, else their mean rate; ``largest_deviation_s`` is the largest deviation of a frame from
    that uniform clock, and ``is_variable_rate`` says that it is too large to be ignored.
    """

    file_name: str
    codec: str
    image_size_px: tuple[int, int]
    rotation_deg: int
    frame_count: int
    rate_hz: float
    duration_s: float
    is_variable_rate: bool
    largest_deviation_s: float


def probe_video(path: Path) -> VideoInfo:
    """Find out what a video file contains, without decoding more than its first frame.

    Raises:
        InputError: The file is not there (``video-missing``), is no video (``not-a-video``), has no video stream
            (``no-video-stream``), ends too early (``video-truncated``), holds fewer than two frames (``video-empty``),
            can't be decoded at all (``video-codec-unsupported``) or not at its first frame (``video-damaged``).
    """
    with _open(path) as (container, stream):
        times_s = _frame_times_s(path, container, stream)
    with _open(path) as (container, stream):
        frame = next(_decode(path, container, stream), None)
        if frame is None:
            raise _damaged(path, 0, "the decoder gave no picture")
        size_px, codec = _as_frame(frame, 0, 0.0).image_size_px, stream.codec_context.name
        nominal_hz = float(stream.average_rate or 0)
    rate_hz, deviation_s = _fit_rate(times_s, nominal_hz)
    return VideoInfo(
        file_name=path.name,
        codec=codec,
        image_size_px=size_px,
        rotation_deg=_rotation_deg(frame),
        frame_count=len(times_s),
        rate_hz=rate_hz,
        duration_s=len(times_s) / rate_hz,
        is_variable_rate=bool(deviation_s > VARIABLE_RATE_FRACTION / rate_hz),
        largest_deviation_s=deviation_s,
    )


def iterate_frames(path: Path) -> Iterator[Frame]:
    """Decode a video frame by frame, in the order of viewing.

    Each frame's planes stay valid as long as the frame is kept; a caller that keeps none needs memory for a handful.

    Raises:
        InputError: As :func:`probe_video`; ``video-damaged`` also in the middle, naming the frame.
    """
    with _open(path) as (container, stream):
        start_s = None
        for index, picture in enumerate(_decode(path, container, stream)):
            time_s = float(picture.time) if picture.pts is not None else index / float(stream.average_rate or 1)
            start_s = time_s if start_s is None else start_s
            yield _as_frame(picture, index, time_s - start_s)


@contextmanager
def _open(path: Path) -> Generator[tuple[InputContainer, VideoStream]]:
    """Open a video file and choose its first stream of moving pictures (a cover picture is none)."""
    if not path.is_file():
        raise InputError(
            f"The video {path.name} does not exist.",
            hint=f"Check the path {path}.",
            code="video-missing",
        )
    try:
        container = av.open(str(path.resolve()), options=OPEN_OPTIONS)
    except av.error.FFmpegError as error:
        raise _unreadable(path) from error
    with container:
        covers = [s for s in container.streams.video if s.disposition & Disposition.attached_pic]
        streams = [s for s in container.streams.video if s not in covers]
        if not container.streams:  # FFmpeg drops an MP4's stream that has no frame
            raise _empty(path, "no frame")
        if not streams:
            kinds = sorted({"cover" if stream in covers else stream.type for stream in container.streams})
            raise InputError(
                f"{path.name} has no video stream, only {', '.join(kinds)}.",
                hint="Upload the file that the camera recorded, not its sound.",
                code="no-video-stream",
            )
        if streams[0].codec_context is None:
            raise InputError(
                f"The pictures of {path.name} are coded in a way that gonio can't decode.",
                hint="Convert the file to H.264, for instance with: ffmpeg -i IN -c:v libx264 -crf 18 OUT.mp4",
                code="video-codec-unsupported",
            )
        streams[0].codec_context.thread_count = 1
        yield container, streams[0]


def _unreadable(path: Path) -> InputError:
    """Say why a file can't be opened: it is empty, an MP4 without its end, or something else altogether."""
    with path.open("rb") as file:
        head = file.read(8)
    if not head:
        return _empty(path, "nothing at all")
    if head[4:] in MP4_FIRST_BOXES:
        return _truncated(path, "its index (the `moov` box) is missing, which cameras write when they stop")
    return InputError(
        f"{path.name} is not a video.",
        hint="Upload the camera's own file: MP4, MOV, MKV, WebM, AVI or MTS.",
        code="not-a-video",
    )


def _empty(path: Path, what: str) -> InputError:
    return InputError(
        f"{path.name} contains {what}.",
        hint="The camera was stopped at once, or the copy failed: copy it again, or record again.",
        code="video-empty",
    )


def _truncated(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} is cut off: {reason}.",
        hint="Copy it from the camera again, and stop the recording before the camera is switched off or unplugged.",
        code="video-truncated",
    )


def _damaged(path: Path, index: int, reason: str) -> InputError:
    return InputError(
        f"{path.name} can't be decoded at frame {index}: {reason}.",
        hint="Copy it from the camera again; if that does not help, convert it with ffmpeg, which may mend it.",
        code="video-damaged",
        frame=index,
    )


def _frame_times_s(path: Path, container: InputContainer, stream: VideoStream) -> np.ndarray:
    """Give the presentation time of each frame, in order, by walking through the packets without decoding any."""
    ticks: list[int] = []
    try:
        for packet in container.demux(stream):
            stamp = packet.dts if packet.pts is None else packet.pts
            if packet.size and not packet.is_discard and stamp is not None:
                ticks.append(stamp)
    except av.error.FFmpegError as error:
        raise _truncated(path, f"after {len(ticks)} frames: {error.strerror}") from error
    times_s = np.sort(ticks) * float(stream.time_base or 1)
    _refuse_truncated(path, container, stream, times_s)
    if len(times_s) < 2:
        raise _empty(path, "a single frame" if len(times_s) else "no frame")
    return times_s


def _refuse_truncated(path: Path, container: InputContainer, stream: VideoStream, times_s: np.ndarray) -> None:
    """Refuse a file whose container promises more than there is."""
    size = path.stat().st_size
    # An MP4's index knows where each frame lies. Durations prove nothing: sound may run on, edits may cut frames off.
    if container.format.name.startswith("mov"):
        missing = sum(entry.pos + entry.size > size for entry in stream.index_entries)
        if missing:
            raise _truncated(path, f"{missing} of its {len(stream.index_entries)} frames lie beyond its end")
        return
    stated_s = (container.duration or 0) / av.time_base
    end_s = float(times_s[-1]) if len(times_s) else 0.0
    if end_s < stated_s - 1.0:  # sound may run on for a moment
        raise _truncated(path, f"it should last {stated_s:.1f} s, but its pictures end after {end_s:.1f} s")


def _fit_rate(times_s: np.ndarray, nominal_hz: float) -> tuple[float, float]:
    """Find the uniform clock behind the frames' times: its rate, and the largest deviation from it in seconds."""

    def deviation_from(rate_hz: float) -> float:
        late_s = times_s - np.arange(len(times_s)) / rate_hz
        return float(np.ptp(late_s)) / 2

    mean_hz = (len(times_s) - 1) / max(float(np.ptp(times_s)), 1e-9)
    if nominal_hz > 0 and deviation_from(nominal_hz) <= VARIABLE_RATE_FRACTION / nominal_hz:
        return nominal_hz, deviation_from(nominal_hz)
    return mean_hz, deviation_from(mean_hz)


def _decode(path: Path, container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    index = 0
    try:
        for frame in container.decode(stream):
            yield frame
            index += 1
    except av.error.FFmpegError as error:
        raise _damaged(path, index, error.strerror or "invalid data") from error


def _rotation_deg(frame: VideoFrame) -> int:
    """Give the clockwise rotation for viewing (FFmpeg counts counter-clockwise), to the nearest right angle."""
    return round(-frame.rotation / 90) * 90 % 360


def _as_frame(picture: VideoFrame, index: int, time_s: float) -> Frame:
    rotation_deg = _rotation_deg(picture)
    if picture.format.name not in ("yuv420p", "yuvj420p"):
        picture = picture.reformat(format="yuv420p")
    luma, blue_chroma, red_chroma = (
        np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]
        for plane in picture.planes
    )
    full_range = picture.color_range == ColorRange.JPEG or picture.format.name == "yuvj420p"
    red, blue = LUMA_WEIGHTS.get(picture.colorspace, BT601)
    return Frame(
        index=index,
        time_s=time_s,
        planes=(luma, blue_chroma, red_chroma),
        rotation_deg=rotation_deg,
        colour=Colour.of(red, blue, full_range=full_range),
    )
