"""A part's silhouettes in a few pictures, and the solid that they leave of the space."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gonio.records.camera import Camera
from gonio.records.record import record


@record
class Silhouette:
    """What one picture shows of one part.

    ``shown`` are the pixels that show the part; ``hidden`` those where something else stands before it, or may do: they say
    nothing about the part. All others are background. ``camera`` stands in the frame of the part (its corrected camera,
    eq. 20), ``rgb`` is the picture itself if the part is to have colours.
    """

    camera: Camera
    shown: Bool[np.ndarray, "height width"]
    hidden: Bool[np.ndarray, "height width"]
    rgb: UInt8[np.ndarray, "height width 3"] | None = None


@record
class Hull:
    """Voxels in the part's frame: cubes of ``step_m``, the first one's centre at ``corner_m``."""

    occupied: Bool[np.ndarray, "x y z"]
    corner_m: Float[np.ndarray, "3"]
    step_m: float

    @property
    def volume_m3(self) -> float:
        """The volume of all occupied voxels."""
        return float(np.count_nonzero(self.occupied)) * self.step_m**3


@record
class Mesh:
    """A closed surface of triangles, counter-clockwise as seen from outside; ``normals`` are unit vectors that point out.

    ``rgb`` are the vertices' colours (sRGB), grey where ``coloured`` is False because no picture sees them.
    """

    xyz_m: Float[np.ndarray, "vertex 3"]
    normals: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    rgb: UInt8[np.ndarray, "vertex 3"]
    coloured: Bool[np.ndarray, " vertex"]


@record
class CarvedPart:
    """A part as its silhouettes leave it, in its frame: the world's in the reference picture.

    ``overlap`` is the share that the reprojected surface and the silhouette have in common of what either covers, pixels
    that say nothing left out.
    """

    mesh: Mesh
    volume_m3: float
    step_m: float
    overlap: Float[np.ndarray, " picture"]
