"""Calibrated cameras."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records.record import record


@record
class Camera:
    """One calibrated camera in OpenCV's convention (x right, y down, z forward).

    ``intrinsic_px`` is the 3 × 3 camera matrix with the centre of the top-left pixel at (0, 0); ``distortion`` holds
    OpenCV's ``(k1, k2, p1, p2, k3)``; ``T_lab_cam`` is the stored pose: it maps camera coordinates to the lab, metres.
    """

    name: str
    image_size_px: tuple[int, int]
    intrinsic_px: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    T_lab_cam: Float[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        rotation = self.T_lab_cam[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise InputError(
                f"Camera {self.name}: the rotation of its pose is no rotation matrix.",
                hint="Check the calibration file: its nine numbers must be a right-handed orthonormal matrix.",
            )
        if not (self.intrinsic_px[0, 0] > 0 and self.intrinsic_px[1, 1] > 0):
            raise InputError(
                f"Camera {self.name}: its focal length is not positive.",
                hint="Check the calibration file's focal lengths.",
            )

    @property
    def T_cam_lab(self) -> Float[np.ndarray, "4 4"]:
        """OpenCV's ``[R|t]`` with the row 0 0 0 1: maps lab coordinates to the camera's."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.T_lab_cam[:3, :3].T
        inverse[:3, 3] = -self.T_lab_cam[:3, :3].T @ self.T_lab_cam[:3, 3]
        return inverse

    @property
    def centre_lab_m(self) -> Float[np.ndarray, "3"]:
        """The optical centre in the lab."""
        return self.T_lab_cam[:3, 3]


@record
class Rig:
    """The cameras of one session, in a fixed order; ``source`` says where their calibration came from."""

    cameras: tuple[Camera, ...]
    source: str

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise InputError(
                f"Two cameras of the calibration have the same name: {', '.join(names)}.",
                hint="Give each camera a name of its own.",
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names, in order."""
        return tuple(camera.name for camera in self.cameras)
