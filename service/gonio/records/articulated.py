"""An articulated body in a few pictures of one moving camera: what was marked in them, and how each joint moved."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.records.camera import Camera
from gonio.records.record import record

JointKind = Literal["free", "spherical", "hinge", "planar", "prismatic"]
"""How a part moves against its parent: turning and shifting freely; turning about a shared centre; about an axis; turning
about the floor's normal while shifting along the floor; shifting along a line."""


STATIC_M = 1e-3


def stands_still(centres_m: Float[np.ndarray, "picture 3"]) -> bool:
    """Say whether a camera took all pictures from one place: its centres spread by less than a millimetre."""
    return bool(np.ptp(centres_m, axis=0).max() < STATIC_M)


@record
class Floor:
    """The plane ``normal · x = offset_m`` of the world, the normal a unit vector that points up."""

    normal: Float[np.ndarray, "3"]
    offset_m: float


@record
class KnownLength:
    """The distance between two points of a part, by their index, and its standard deviation."""

    first: int
    second: int
    length_m: float
    sd_m: float = 0.0


@record
class Part:
    """One part of the body: its joint to the parent (None: the part that moves against the world), and its marked points.

    ``uv_px`` are pixels as photographed, NaN where a point is not seen. ``on_floor`` says which points touch the floor in
    which picture. ``length`` is what gives a freely moving part that touches no floor its size, or any joint its own before a
    camera that stands still.
    """

    name: str
    parent: str | None
    kind: JointKind
    uv_px: Float[np.ndarray, "picture point 2"]
    on_floor: Bool[np.ndarray, "picture point"]
    length: KnownLength | None = None


@record
class JointMotion:
    """How one part moved against its parent, from the reference picture to each of them.

    The part's frame is the world's as it stood in the reference picture; ``Ts_parent_part`` maps a point of the part in
    that picture to where it is in picture i, with the parent's own motion taken away. ``Ts_world_part`` includes it.

    ``twist_covariance`` is that of small motions ``(turn_rad, shift_m)`` of all pictures, applied after ``Ts_parent_part``
    about ``pivot_m``, zero for the reference; it holds what the marks' noise and the parents' errors do, and the cameras'
    where their covariance was given.
    ``world_twist_covariance`` is the same for ``Ts_world_part``. ``centre_m`` is the shared centre (NaN but for a
    spherical joint); ``axis`` and ``axis_point_m`` a hinge's axis and its point next to the part's middle, or the line of a
    prismatic joint (NaN otherwise). ``xyz_m`` are the points in the part's frame, ``used`` the marks that were believed,
    ``residual_px`` what is left of them. ``sigma_px`` is the marks' noise as the residuals tell it. ``other`` is a second
    answer that explains the pictures nearly as well, or None.
    """

    part: str
    kind: JointKind
    Ts_parent_part: Float[np.ndarray, "picture 4 4"]
    Ts_world_part: Float[np.ndarray, "picture 4 4"]
    pivot_m: Float[np.ndarray, "3"]
    twist_covariance: Float[np.ndarray, "twist twist"]
    world_twist_covariance: Float[np.ndarray, "twist twist"]
    centre_m: Float[np.ndarray, "3"]
    centre_covariance_m2: Float[np.ndarray, "3 3"]
    axis: Float[np.ndarray, "3"]
    axis_covariance: Float[np.ndarray, "3 3"]
    axis_point_m: Float[np.ndarray, "3"]
    axis_point_covariance_m2: Float[np.ndarray, "3 3"]
    xyz_m: Float[np.ndarray, "point 3"]
    used: Bool[np.ndarray, "picture point"]
    residual_px: Float[np.ndarray, "picture point 2"]
    sigma_px: float
    found_hinge: bool
    other: Float[np.ndarray, "picture 4 4"] | None

    @property
    def rotation_sd_rad(self) -> Float[np.ndarray, " picture"]:
        """The standard deviation of each picture's rotation: of the length of its error's rotation vector."""
        variance = np.diag(self.twist_covariance).reshape(-1, 6)[:, :3].sum(axis=1)
        return np.sqrt(variance)


def check_pictures(cameras: tuple[Camera, ...], parts: tuple[Part, ...]) -> None:
    """Refuse what no solver could work on.

    Raises:
        InputError: ``too-few-pictures``, ``tracks-do-not-fit``, ``joint-tree-broken`` or ``floor-length-clash``.
    """
    if len(cameras) < 2:
        raise InputError(
            "There is one picture only: it shows no motion.",
            hint="Give two pictures or more, better four.",
            code="too-few-pictures",
        )
    still = stands_still(np.stack([camera.centre_lab_m for camera in cameras]))
    for part in parts:
        if len(part.uv_px) != len(cameras):
            raise InputError(
                f"Part {part.name} is marked in {len(part.uv_px)} pictures, but there are {len(cameras)} cameras.",
                hint="Give one camera a picture, and NaN where a point is not seen.",
                code="tracks-do-not-fit",
            )
        sizes_any = still and part.parent is None
        if part.length is not None and ((part.kind != "free" and not sizes_any) or part.on_floor.any()):
            raise InputError(
                f"Part {part.name}: a known length serves a freely moving part that no floor gives its size, or any part "
                "that moves against the world before a camera that stands still.",
                hint="Leave the length out, or the points on the floor.",
                code="length-without-use",
            )
