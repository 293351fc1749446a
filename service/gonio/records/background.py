"""What stands still behind an articulated body: marks of it tell where the one camera was for each picture, and its zoom."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.records.articulated import KnownLength
from gonio.records.camera import Camera
from gonio.records.record import record


@record
class Lens:
    """What is known of the lens before the pictures are looked at; all pictures share it but for the focal length.

    Standard deviations of 0 hold a value as it is. ``focal_px`` is NaN for a picture whose zoom is not known.
    """

    image_size_px: tuple[int, int]
    focal_px: Float[np.ndarray, " picture"]
    focal_sd_px: float
    principal_px: Float[np.ndarray, "2"]
    principal_sd_px: float
    distortion: Float[np.ndarray, "5"]
    k1_sd: float


@record
class CameraHeight:
    """How high above the floor the camera was for one picture, by its index, and the standard deviation."""

    picture: int
    height_m: float
    sd_m: float = 0.01


@record
class Background:
    """Marks of what stands still, in pixels as photographed, NaN where a point is not seen, and what gives them a measure.

    ``floor_points`` are the indices of points on the floor: three or more tell its plane; the first becomes the world's
    origin, the second lies in the direction of its X axis. Without them the world is the reference picture's camera,
    turned so that Y is up in the picture. The last ``found`` points were found in the pictures and not marked by hand: their
    noise is another.
    """

    pictures: tuple[str, ...]
    uv_px: Float[np.ndarray, "picture point 2"]
    lens: Lens
    floor_points: tuple[int, ...] = ()
    lengths: tuple[KnownLength, ...] = ()
    heights: tuple[CameraHeight, ...] = ()
    reference: int = 0
    found: int = 0

    def __post_init__(self) -> None:
        if len(self.pictures) < 2:
            raise InputError(
                "There is one picture only: it can't tell where the camera was.",
                hint="Give two pictures or more, better four.",
                code="too-few-pictures",
            )
        if not self.lengths and not self.heights:
            raise InputError(
                "Nothing gives the background a measure.",
                hint="Give the distance of two of its points, or the camera's height above three points of the floor.",
                code="background-scale-missing",
            )
        if self.floor_points and len(self.floor_points) < 3:
            raise InputError(
                f"The floor has too few points: {len(self.floor_points)}.",
                hint="Mark three points of the floor or more, not on one line.",
                code="floor-points-few",
            )
        if self.heights and not self.floor_points:
            raise InputError(
                "The camera's height is given, but no points of the floor.",
                hint="Mark three points of the floor or more, not on one line.",
                code="floor-points-few",
            )


@record
class LocatedPictures:
    """Where the camera was for each picture, and all that is known of how well that is known.

    ``covariance`` is that of all cameras' :data:`~gonio.records.UNKNOWNS`, in the order camera, unknown, 0 for what was
    held; what all pictures share is fully correlated. ``uv_px`` are the marks, ``xyz_m`` the background's points (NaN: fewer
    than two pictures show it), ``used`` the marks that were believed, ``sigma_px`` the noise of a hand's mark per axis (of
    a found one where there are none).
    """

    cameras: tuple[Camera, ...]
    covariance: Float[np.ndarray, "unknown unknown"]
    uv_px: Float[np.ndarray, "picture point 2"]
    xyz_m: Float[np.ndarray, "point 3"]
    used: Bool[np.ndarray, "picture point"]
    residual_px: Float[np.ndarray, "picture point 2"]
    sigma_px: float
