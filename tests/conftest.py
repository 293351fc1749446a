"""Where the tests find real recordings, and the rigs and walkers that several of them share."""

from pathlib import Path

import numpy as np
import pytest

from gonio.kernel.geometry.transforms import transform
from gonio.records import Camera, Rig

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def balancing() -> Path:
    """The four-camera balancing trial; skips where the recordings are not at hand."""
    folder = SHARED_DATA / "pose2sim_balancing"
    if not folder.is_dir():
        pytest.skip(f"the recordings are not at hand ({folder.name} beside the checkout, in shared/data)")
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
