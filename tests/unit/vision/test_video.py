import weakref
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from gonio.errors import InputError
from gonio.vision.video import iterate_frames, probe_video

MakeVideo = Callable[..., Path]


def corners(path: Path) -> list[str]:
    """The colours of the first frame's corners, as it is viewed: top left, top right, bottom left, bottom right."""
    rgb = next(iterate_frames(path)).rgb()
    return ["".join("RGB"[i] for i in range(3) if rgb[y, x, i] > 128) for y in (3, -4) for x in (3, -4)]


def test_probe(make_video: MakeVideo) -> None:
    info = probe_video(make_video(frames=12))
    assert info.file_name == "video.mp4"
    assert (info.codec, info.image_size_px, info.rotation_deg) == ("h264", (64, 48), 0)
    assert (info.frame_count, info.rate_hz, info.duration_s) == (12, 30.0, 0.4)
    assert not info.is_variable_rate
    assert info.largest_deviation_s < 1e-9


def test_frames_come_in_order_with_their_times(make_video: MakeVideo) -> None:
    path = make_video(frames=12, options={"movflags": "faststart"})  # H.264 stores them out of order
    frames = [(frame.index, frame.time_s) for frame in iterate_frames(path)]
    np.testing.assert_allclose(frames, [(i, i / 30) for i in range(12)], atol=1e-9)


@pytest.mark.parametrize(
    ("counter_clockwise_deg", "clockwise_deg", "expected"),
    [
        (0, 0, ["R", "G", "B", "RGB"]),
        (-90, 90, ["B", "R", "RGB", "G"]),  # a phone held upright
        (180, 180, ["RGB", "B", "G", "R"]),
        (90, 270, ["G", "RGB", "R", "B"]),
    ],
)
def test_a_phones_rotation_is_honoured(
    make_video: MakeVideo, counter_clockwise_deg: int, clockwise_deg: int, expected: list[str]
) -> None:
    path = make_video(counter_clockwise_deg=counter_clockwise_deg)
    info = probe_video(path)
    assert info.rotation_deg == clockwise_deg
    assert info.image_size_px == ((48, 64) if clockwise_deg in (90, 270) else (64, 48))
    assert corners(path) == expected


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt", "size_px"),
    [
        ("full_range.mp4", "libx264", "yuvj420p", (64, 48)),
        ("no_subsampling.mp4", "libx264", "yuv444p", (64, 48)),
        ("ten_bits.mp4", "libx264", "yuv420p10le", (64, 48)),
        ("motion_jpeg.avi", "mjpeg", "yuvj422p", (64, 48)),
        ("rgb.mkv", "ffv1", "bgr0", (64, 48)),
        ("odd.mkv", "ffv1", "yuv420p", (65, 49)),
        ("browser.webm", "libvpx-vp9", "yuv420p", (64, 48)),
    ],
)
def test_every_kind_of_pixel_keeps_its_colour(
    make_video: MakeVideo, name: str, codec: str, pix_fmt: str, size_px: tuple[int, int]
) -> None:
    path = make_video(name, codec=codec, pix_fmt=pix_fmt, size_px=size_px)
    info = probe_video(path)
    assert (info.image_size_px, info.frame_count) == (size_px, 12)
    rgb = next(iterate_frames(path)).rgb().astype(int)
    assert rgb.shape == (size_px[1], size_px[0], 3)
    # 8 bits, twice rounded on the way to YUV and back, gain up to 2, and the codec's own loss.
    for (x, y), colour in {
        (5, 5): (255, 0, 0),
        (50, 5): (0, 255, 0),
        (5, 40): (0, 0, 255),
        (50, 40): (255,) * 3,
    }.items():
        assert np.abs(rgb[y, x] - colour).max() <= 8


def test_a_varying_rate_is_told(make_video: MakeVideo) -> None:
    times_ms = [33 * i + (200 if i > 6 else 0) for i in range(12)]
    info = probe_video(make_video(times_ms=times_ms))
    assert info.is_variable_rate
    mean_ms = times_ms[-1] / 11
    late_ms = np.array(times_ms) - mean_ms * np.arange(12)
    assert info.rate_hz == pytest.approx(1000 / mean_ms)
    assert info.largest_deviation_s == pytest.approx(np.ptp(late_ms) / 2000)


def test_rounded_timestamps_are_no_varying_rate(make_video: MakeVideo) -> None:
    """WebM and Matroska count in milliseconds."""
    info = probe_video(make_video("a.webm", codec="libvpx-vp9", frames=31))
    assert info.rate_hz == 30.0
    assert not info.is_variable_rate
    assert 0 < info.largest_deviation_s <= 0.5e-3


def test_memory_is_given_back(make_video: MakeVideo) -> None:
    frames = iterate_frames(make_video(frames=12))
    first = weakref.ref(next(frames).planes[0])
    kept = next(frames)
    before = kept.planes[0].copy()
    for _ in frames:
        pass
    assert first() is None
    np.testing.assert_array_equal(kept.planes[0], before)  # and what is kept stays valid


def _cut(path: Path, share: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def _moov_missing(make: MakeVideo) -> Path:
    return _cut(make(frames=60, size_px=(320, 240)), 0.7)


def _frames_missing(make: MakeVideo) -> Path:
    return _cut(make(frames=60, size_px=(320, 240), options={"movflags": "faststart"}), 0.8)


def _matroska_cut(make: MakeVideo) -> Path:
    return _cut(make("video.mkv", frames=300, size_px=(320, 240)), 0.6)


def _unknown_codec(make: MakeVideo) -> Path:
    path = make()
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    return path


def _scrambled(make: MakeVideo) -> Path:
    path = make(frames=60, size_px=(320, 240))
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    end = data.index(b"moov") - 4
    data[start:end] = bytes(end - start)
    path.write_bytes(data)
    return path


def _text(make: MakeVideo) -> Path:
    path = make()
    path.write_text("Dear diary,\n" * 100)
    return path


def _playlist(make: MakeVideo) -> Path:
    target = make("secret.mp4")
    path = target.with_name("upload.mp4")
    path.write_text(f"ffconcat version 1.0\nfile {target}\n")
    return path


def _empty(make: MakeVideo) -> Path:
    path = make()
    path.write_bytes(b"")
    return path


def _no_frames(make: MakeVideo) -> Path:
    return make(frames=0)


def _one_frame(make: MakeVideo) -> Path:
    return make(frames=1)


def _missing(make: MakeVideo) -> Path:
    path = make()
    path.unlink()
    return path


def _sound_only(make: MakeVideo) -> Path:
    path = make()
    with av.open(path, "w") as container:
        stream = container.add_stream("aac", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("make", "code", "words"),
    [
        (_missing, "video-missing", "does not exist"),
        (_text, "not-a-video", "not a video"),
        (_playlist, "not-a-video", "not a video"),
        (_sound_only, "no-video-stream", "audio"),
        (_empty, "video-empty", "nothing at all"),
        (_no_frames, "video-empty", "no frame"),
        (_one_frame, "video-empty", "a single frame"),
        (_moov_missing, "video-truncated", "moov"),
        (_frames_missing, "video-truncated", "of its 60 frames"),
        (_matroska_cut, "video-truncated", "should last 10.0 s"),
        (_unknown_codec, "video-codec-unsupported", "can't decode"),
        (_scrambled, "video-damaged", "frame 0"),
    ],
)
def test_a_bad_video_is_refused_by_name_with_a_remedy(
    make_video: MakeVideo, make: Callable[[MakeVideo], Path], code: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = make(make_video)
    with pytest.raises(InputError) as caught:
        probe_video(path)
    assert caught.value.code == code
    assert path.name in caught.value.message
    assert words in caught.value.message
    assert caught.value.hint
    assert capfd.readouterr() == ("", "")  # FFmpeg's own messages stay out of the log
