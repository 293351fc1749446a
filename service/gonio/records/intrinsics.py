"""A camera's optics as they were found, with how well they are known."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from gonio.records.record import record

LensModel = Literal["k1", "k1k2", "k1k2_aspect", "brown"]
"""The lens models, each with one more freedom: what is not named is square pixels, and no distortion of that kind."""

Origin = Literal["recording", "file", "session"]
"""Where intrinsics come from: a recording of their own, a file that may not say how well they are known, or the very
session that is to be calibrated."""

INTRINSIC_NAMES = ("focal_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


@record
class Intrinsics:
    """The optics of one camera: ``parameters`` and their ``covariance`` in the order of :data:`INTRINSIC_NAMES`.

    ``focal_px`` is that of the rows, ``aspect`` times it that of the columns; the distortion is OpenCV's. A parameter
    that the model leaves out has its neutral value and no variance. ``held_out_px`` is the reprojection error per corner
    in views that were not used (NaN where there were too few to hold any out), ``views`` how many pictures were used;
    ``covered`` is the part of the picture, in a grid of 6 × 4 cells, that corners were seen in. ``origin`` decides
    how far they are believed, ``source`` names the recording or the file.
    """

    camera_name: str
    image_size_px: tuple[int, int]
    model: LensModel
    parameters: Float[np.ndarray, "9"]
    covariance: Float[np.ndarray, "9 9"]
    held_out_px: float
    rms_px: float
    views: int
    tilted_views: int
    covered: Bool[np.ndarray, "4 6"]
    origin: Origin
    source: str

    @property
    def intrinsic_px(self) -> Float[np.ndarray, "3 3"]:
        """The 3 × 3 camera matrix, the centre of the top-left pixel at (0, 0)."""
        focal, aspect, cx, cy = self.parameters[:4]
        return np.array([[focal, 0.0, cx], [0.0, focal * aspect, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Float[np.ndarray, "5"]:
        """OpenCV's ``(k1, k2, p1, p2, k3)``."""
        return self.parameters[4:].copy()

    @property
    def sd(self) -> Float[np.ndarray, "9"]:
        """The parameters' standard deviations."""
        return np.sqrt(np.diag(self.covariance))
