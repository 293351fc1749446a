"""Where the tests find real recordings, and the rigs and videos that several of them share."""

import os
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

# Before numpy is loaded: test workers share the cores, and the threads of its linear algebra would spin against each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import av
import numpy as np
import pytest

from gonio.kernel.geometry.transforms import transform
from gonio.records import Camera, Rig

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def balancing() -> Path:
    """The four-camera balancing trial; skips where the recordings are not at hand."""
    return _recording("pose2sim_balancing")


@pytest.fixture(scope="session")
def insole_iscas() -> Path:
    """A stream of real insoles; skips where the recordings are not at hand."""
    return _recording("insole_iscas")


@pytest.fixture(scope="session")
def opensim_gait2354() -> Path:
    """OpenSim's walking example; skips where the recordings are not at hand."""
    return _recording("opensim_gait2354")


@pytest.fixture(scope="session")
def normative() -> Path:
    """Published curves of healthy walking."""
    return _recording("normative")


@pytest.fixture(scope="session")
def vicon_pig() -> Path:
    """C3D files of a marker laboratory; skips where the recordings are not at hand."""
    return _recording("vicon_pig")


def _recording(name: str) -> Path:
    folder = SHARED_DATA / name
    if not folder.is_dir():
        pytest.skip(f"the recordings are not at hand ({name} beside the checkout, in shared/data)")
    return folder


def camera_looking_at(name: str, centre_m: np.ndarray, target_m: np.ndarray, focal_px: float = 1000.0) -> Camera:
    """A camera with a picture of 1280 × 720 and a mild lens distortion, upright."""
    forward = (target_m - centre_m) / np.linalg.norm(target_m - centre_m)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Camera(
        name=name,
        image_size_px=(1280, 720),
        intrinsic_px=np.array([[focal_px, 0, 640.0], [0, focal_px, 360.0], [0, 0, 1]]),
        distortion=np.array([-0.05, 0.12, 0.0006, -0.0007, 0.0]),
        T_lab_cam=transform(rotation, centre_m),
    )


@pytest.fixture(scope="session")
def rig() -> Rig:
    """Four cameras in the corners of a square of 7 m, 2 m high, looking at the middle at hip height."""
    corners = [(3.5, 2.0, 3.5), (3.5, 2.0, -3.5), (-3.5, 2.0, -3.5), (-3.5, 2.0, 3.5)]
    target = np.array([0.0, 0.9, 0.0])
    return Rig(
        cameras=tuple(camera_looking_at(f"cam{i + 1}", np.array(c), target) for i, c in enumerate(corners)),
        source="four corners",
    )


RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)


def quadrants(width: int, height: int) -> np.ndarray:
    """A picture that shows which way up it is: red, green / blue, white."""
    picture = np.empty((height, width, 3), np.uint8)
    picture[: height // 2, : width // 2], picture[: height // 2, width // 2 :] = RED, GREEN
    picture[height // 2 :, : width // 2], picture[height // 2 :, width // 2 :] = BLUE, WHITE
    return picture


@pytest.fixture
def make_video(tmp_path: Path) -> Callable[..., Path]:
    """Writes a video of the quadrants (H.264 in MP4, 12 frames, 30 Hz) and gives its path."""

    def make(
        name: str = "video.mp4",
        *,
        frames: int = 12,
        size_px: tuple[int, int] = (64, 48),
        codec: str = "libx264",
        pix_fmt: str = "yuv420p",
        counter_clockwise_deg: int = 0,
        times_ms: Sequence[int] | None = None,
        options: dict[str, str] | None = None,
    ) -> Path:
        path = tmp_path / name
        with av.open(path, "w", options=options or {}) as container:
            stream = container.add_stream(codec, rate=30)
            stream.width, stream.height = size_px
            stream.pix_fmt = pix_fmt
            stream.thread_count = 1
            stream.codec_context.time_base = Fraction(1, 3000)
            if counter_clockwise_deg:
                stream.set_display_rotation(counter_clockwise_deg)
            container.start_encoding()  # writes a header even if no frame follows
            for index in range(frames):
                frame = av.VideoFrame.from_ndarray(quadrants(*size_px), "rgb24")
                frame.time_base = Fraction(1, 3000)
                frame.pts = 3 * times_ms[index] if times_ms else 100 * index
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path

    return make
