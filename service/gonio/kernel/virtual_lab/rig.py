"""Cameras around the walker, and what is wrong with them: their calibration and their clocks."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.virtual_lab.chance import stream
from gonio.records import Camera, Rig, Timebase

MILD_DISTORTION = (-0.05, 0.12, 0.0006, -0.0007, 0.0)
"""A machine-vision lens: k1 and k2 of the size that checkerboards show for the cameras of the balancing recording."""


@dataclass(frozen=True)
class CalibrationErrors:
    """How far a calibration is from the cameras: standard deviations, each camera and axis for itself."""

    rotation_rad: float = 0.0
    translation_m: float = 0.0
    focal: float = 0.0  # share of the focal length


@dataclass(frozen=True)
class Clocks:
    """How the cameras keep time: each one's own delay, and how far its rate is off. Standard deviations.

    The first camera is the clock: its delay and drift are 0.
    """

    delay_s: float = 0.0
    drift: float = 0.0  # share of the rate


def make_rig(
    cameras: int = 4,
    *,
    radius_m: float = 3.5 * np.sqrt(2.0),
    height_m: float = 2.4,
    image_size_px: tuple[int, int] = (720, 540),
    focal_px: float = 520.0,
    distortion: tuple[float, float, float, float, float] = MILD_DISTORTION,
    target_m: tuple[float, float, float] = (0.0, 0.9, 0.0),
) -> Rig:
    """Put cameras on a ring, upright and looking at one point. By default: in the corners of a square of 7 m.

    Raises:
        InputError: no camera, or a ring around nothing.
    """
    if cameras < 1 or radius_m <= 0:
        raise InputError(f"{cameras} cameras on a ring of {radius_m} m are no rig.", hint="Give at least one camera.")
    width, height = image_size_px
    intrinsic = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    placed: list[Camera] = []
    for number in range(cameras):
        angle = 2 * np.pi * (number + 0.5) / cameras
        centre = np.array([radius_m * np.cos(angle), height_m, radius_m * np.sin(angle)])
        forward = np.array(target_m) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        placed.append(
            Camera(
                name=f"cam{number + 1}",
                image_size_px=image_size_px,
                intrinsic_px=intrinsic,
                distortion=np.array(distortion),
                T_lab_cam=transform(np.stack([right, np.cross(forward, right), forward], axis=1), centre),
            )
        )
    return Rig(cameras=tuple(placed), source=f"virtual ring of {cameras} cameras")


def miscalibrate(rig: Rig, errors: CalibrationErrors, seed: int) -> Rig:
    """Give what a calibration with these errors would say of a rig: cameras turned and moved about their own axes."""
    wrong: list[Camera] = []
    for number, camera in enumerate(rig.cameras):
        rng = stream(seed, "calibration", number)
        turn = Rotation.from_rotvec(errors.rotation_rad * rng.standard_normal(3)).as_matrix()
        T_cam_wrong = transform(turn, errors.translation_m * rng.standard_normal(3))
        intrinsic = camera.intrinsic_px.copy()
        intrinsic[[0, 1], [0, 1]] *= 1.0 + errors.focal * rng.standard_normal()
        wrong.append(replace(camera, intrinsic_px=intrinsic, T_lab_cam=camera.T_lab_cam @ T_cam_wrong))
    return replace(rig, cameras=tuple(wrong), source=f"{rig.source}, miscalibrated")


def camera_times_s(
    timebase: Timebase, frames: int, cameras: int, clocks: Clocks, seed: int
) -> Float[np.ndarray, "camera frame"]:
    """Give when each camera really took its frames: those of a late one show a later moment."""
    times_s = np.tile(timebase.times_s(frames), (cameras, 1))
    for number in range(1, cameras):
        rng = stream(seed, "clocks", number)
        delay_s, drift = clocks.delay_s * rng.standard_normal(), clocks.drift * rng.standard_normal()
        times_s[number] += delay_s + drift * (times_s[number] - timebase.start_s)
    return times_s
