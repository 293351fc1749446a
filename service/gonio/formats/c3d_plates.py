"""Force plates of C3D files, types 1 to 4: from a plate's channels to the force on the foot, in the file's axes.

A plate's own frame: the origin in the middle of its surface, x and y along its edges, z downwards; the corners are listed
from the one at +x +y on: −x +y, −x −y, +x −y. Whether a file holds what the foot does to the plate or what the plate does to
the foot depends on who wrote it; the ground can only push, and so the load itself tells. [C3D User Guide, "Force platforms"]
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError


@dataclass(frozen=True)
class Plate:
    """One force plate as a file declares it, lengths in metres in the file's axes.

    ``origin_m`` is where the middle of the surface lies in the frame of the transducers; for type 3, half the distances
    between its sensors, and their depth. ``moment_scale`` takes moments to Nm, ``length_scale`` lengths of channels to m.
    """

    kind: int
    corners_m: Float[np.ndarray, "4 3"]
    origin_m: Float[np.ndarray, "3"]
    moment_scale: float
    length_scale: float
    calibration: Float[np.ndarray, "6 6"] | None = None


def plate_wrench(
    plate: Plate, channels: Float[np.ndarray, "sample channel"], least_n: float
) -> tuple[Float[np.ndarray, "sample 3"], Float[np.ndarray, "sample 3"], Float[np.ndarray, " sample"]]:
    """Give the force on the foot, where it pierces the surface, and the free moment about the upward axis, N, m, Nm.

    Args:
        plate: What the file says of the plate.
        channels: Its channels in their order.
        least_n: Below this vertical force, the place is NaN and the free moment zero.

    Raises:
        InputError: another type, corners that bound nothing, or type 4 without its calibration.
    """
    x_axis = plate.corners_m[0] - plate.corners_m[1] + plate.corners_m[3] - plate.corners_m[2]
    y_axis = plate.corners_m[0] - plate.corners_m[3] + plate.corners_m[1] - plate.corners_m[2]
    z_axis = np.cross(x_axis, y_axis)
    if not np.linalg.norm(z_axis) > 1e-4:
        raise InputError("the corners of a force plate bound no area.", hint="Export it with the plates' corners.")
    x_axis, z_axis = x_axis / np.linalg.norm(x_axis), z_axis / np.linalg.norm(z_axis)
    R_file_plate = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
    force, moment = _at_surface(plate, channels)
    loaded = np.abs(force[:, 2]) > least_n
    # A load presses downwards: where the plate's z force is positive under load, it is that of the foot on the plate.
    action = -1.0 if np.median(force[loaded, 2] if loaded.any() else [-1.0]) > 0 else 1.0
    force, moment = action * force, action * moment
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.stack([-moment[:, 1], moment[:, 0], np.zeros(len(force))], axis=1) / force[:, 2:]
    free = moment[:, 2] - place[:, 0] * force[:, 1] + place[:, 1] * force[:, 0]
    cop = plate.corners_m.mean(axis=0) + place @ R_file_plate.T
    # z is down: a moment about it is one about the upward axis the other way round.
    return force @ R_file_plate.T, np.where(loaded[:, None], cop, np.nan), np.where(loaded, -free, 0.0)


def _at_surface(
    plate: Plate, channels: Float[np.ndarray, "sample channel"]
) -> tuple[Float[np.ndarray, "sample 3"], Float[np.ndarray, "sample 3"]]:
    """Give force and moment about the middle of the surface, in the plate's frame, N and Nm."""
    if plate.kind == 1:  # Fx Fy Fz, where it presses on the surface, free moment
        force, place_m = channels[:, :3], plate.length_scale * channels[:, 3:5]
        arm = np.column_stack([place_m, np.zeros(len(place_m))])
        moment = np.cross(arm, force)
        moment[:, 2] += plate.moment_scale * channels[:, 5]
        return force, moment
    if plate.kind in (2, 4):
        if plate.kind == 4:
            if plate.calibration is None:
                raise InputError("a force plate of type 4 has no calibration.", hint="Export it with CAL_MATRIX.")
            channels = channels @ plate.calibration.T
        # The surface lies above the transducers, which is −z; files with the opposite vector are common.
        origin_m = -plate.origin_m if plate.origin_m[2] > 0 else plate.origin_m
        force = channels[:, :3]
        return force, plate.moment_scale * channels[:, 3:] - np.cross(origin_m, force)
    if plate.kind == 3:  # Kistler's eight: Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4
        fx12, fx34, fy14, fy23, fz1, fz2, fz3, fz4 = channels.T
        a, b, depth = abs(plate.origin_m[0]), abs(plate.origin_m[1]), -abs(plate.origin_m[2])
        force = np.stack([fx12 + fx34, fy14 + fy23, fz1 + fz2 + fz3 + fz4], axis=1)
        moment = np.stack(
            [
                b * (fz1 + fz2 - fz3 - fz4),
                a * (-fz1 + fz2 + fz3 - fz4),
                b * (fx34 - fx12) + a * (fy14 - fy23),
            ],
            axis=1,
        )
        return force, moment - np.cross([0.0, 0.0, depth], force)
    raise InputError(f"a force plate is of type {plate.kind}.", hint="Types 1 to 4 are read; export it as type 2.")
