"""Where the lab is: up, forward and the floor, from a board, from named points, from a walker, or from the cameras alone.

The lab has Y up and the subject walks towards +X. A calibration is solved in the first camera's frame, ``ref``.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, InputError
from gonio.kernel.geometry.transforms import align, apply, transform
from gonio.records import LabFrame

WALKED_M = 1.0
"""A subject whose pelvis travels less than this is standing: its heading is where it faces."""

CONTACT_SD_M = 0.012
UPRIGHT_SD_RAD = np.deg2rad(5.0)
"""Feet are found on the floor to this; people who walk, and cameras on tripods, are upright to that: it decides about what a
walk along one line can't tell, the tilt across it."""


def heading_rad(left_hip_lab_m: Float[np.ndarray, "frame 3"], right_hip_lab_m: Float[np.ndarray, "frame 3"]) -> float:
    """Give the subject's heading as an angle about the vertical (Y): 0 is +X, a quarter turn is -Z.

    For a walk it is the direction from the pelvis' first to its last known place; else the mean direction that the hip
    line faces. NaN frames are left out; without any known frame the heading is 0.
    """
    middle = (left_hip_lab_m + right_hip_lab_m) / 2
    known = np.isfinite(middle[:, 0])
    if not known.any():
        return 0.0
    travel = middle[known][-1] - middle[known][0]
    if np.hypot(travel[0], travel[2]) >= WALKED_M:
        forward = travel
    else:
        to_the_right = (right_hip_lab_m - left_hip_lab_m)[known]
        facing = np.cross([0.0, 1.0, 0.0], to_the_right)  # up × right = forward
        forward = (facing / np.linalg.norm(facing, axis=-1, keepdims=True)).mean(axis=0)
    return float(np.arctan2(-forward[2], forward[0]))


def lab_from_board(
    Ts_ref_board: Float[np.ndarray, "frame 4 4"],
    Ts_ref_cam: Float[np.ndarray, "camera 4 4"],
    *,
    middle_board_m: Float[np.ndarray, "3"],
    thickness_m: float = 0.0,
) -> LabFrame:
    """Take the lab from a board that lies on the floor: origin in its middle, X along its rows.

    Args:
        Ts_ref_board: Its pose in one or more pictures in which it lies still; their mean is taken.
        Ts_ref_cam: The cameras, which are above the floor: they tell the board's upper side, printed or not.
        middle_board_m: The middle of the corners in the board's frame.
        thickness_m: How far the printed side is above the floor.

    Raises:
        CaptureError: ``floor-contradicts``: some cameras would be below the floor that the board lies on.
    """
    rotation = Rotation.from_matrix(Ts_ref_board[:, :3, :3])
    mean = rotation.mean().as_matrix()
    places = np.stack([apply(T, middle_board_m) for T in Ts_ref_board])
    up = _upwards(mean[:, 2], places.mean(axis=0), Ts_ref_cam)
    scatter = np.atleast_1d((rotation * Rotation.from_matrix(mean).inv()).magnitude())
    return LabFrame(
        T_lab_ref=_axes_to_lab(up, mean[:, 0], places.mean(axis=0) - thickness_m * up),
        source="board",
        misfit_m=float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())),
        tilt_sd_rad=float(np.sqrt((scatter**2).mean() / len(scatter))),
    )


def lab_from_points(xyz_ref_m: Float[np.ndarray, "point 3"], xyz_lab_m: Float[np.ndarray, "point 3"]) -> LabFrame:
    """Take the lab from points whose places in it were measured, by the best rigid motion.

    Raises:
        InputError: ``floor-points-few``: fewer than three, or all on one line.
    """
    known = np.isfinite(xyz_ref_m[:, 0])
    here, there = xyz_lab_m[known], xyz_ref_m[known]
    spread = np.linalg.svd(here - here.mean(axis=0), compute_uv=False) if known.sum() >= 3 else np.zeros(3)
    if spread[1] < 0.05:
        raise InputError(
            f"{int(known.sum())} of the named points can be used, and they lie on one line or in one spot.",
            hint="Name at least three points that two cameras see, a metre apart and not on one line.",
            code="floor-points-few",
        )
    T_lab_ref = align(there, here)
    misfit = apply(T_lab_ref, there) - here
    rms = float(np.sqrt((misfit**2).sum(axis=1).mean()))
    return LabFrame(
        T_lab_ref=T_lab_ref,
        source="points",
        misfit_m=rms,
        tilt_sd_rad=float(rms / spread[1]),
    )


def lab_from_walker(
    contacts_ref_m: Float[np.ndarray, "contact 3"],
    is_left: Bool[np.ndarray, " contact"],
    upright_ref: Float[np.ndarray, "3"],
) -> LabFrame:
    """Take the lab from the places where somebody's feet stood, in the order of time: floor, heading and origin.

    The floor is the plane through the contacts. A walk along one line says nothing about the tilt across it, so what is
    upright as a rule, the walker or the cameras, has a small say. X is the direction of the line half-way between the feet, for
    which the side is a regressor of its own: the plain principal axis zigzags with left and right. The origin is the first
    contact's foot point on that line.

    Args:
        contacts_ref_m: The places.
        is_left: Which of them are the left foot's.
        upright_ref: About where up is, a unit vector: to :data:`UPRIGHT_SD_RAD`.

    Raises:
        CaptureError: ``walk-too-short``: fewer than four contacts, or none of one foot, or less than a metre.
    """
    if len(contacts_ref_m) < 4 or is_left.all() or not is_left.any():
        raise _short_walk()
    upright = upright_ref
    middle = contacts_ref_m.mean(axis=0)
    centred = contacts_ref_m - middle
    # Minimise Σ (n·x)²/s² + (n × u)²/σ² over unit n: an eigenvector.
    scatter = centred.T @ centred / CONTACT_SD_M**2 + (np.eye(3) - np.outer(upright, upright)) / UPRIGHT_SD_RAD**2
    values, vectors = np.linalg.eigh(scatter)
    up = vectors[:, 0] * np.sign(vectors[:, 0] @ upright)
    time, side = np.arange(len(centred)) - (len(centred) - 1) / 2.0, np.where(is_left, 1.0, -1.0)
    regressors = np.column_stack([np.ones_like(time), time, side])
    coefficients = np.linalg.lstsq(regressors, centred, rcond=None)[0]
    forward = coefficients[1]
    if np.linalg.norm(forward) * (len(time) - 1) < WALKED_M:
        raise _short_walk()
    start = middle + coefficients[0] + coefficients[1] * time[0]
    return LabFrame(
        T_lab_ref=_axes_to_lab(up, forward, start - (start - middle) @ up * up),
        source="walker",
        misfit_m=float(np.sqrt(((centred @ up) ** 2).mean())),
        tilt_sd_rad=float(1.0 / np.sqrt(values[1] - values[0])),
    )


def lab_from_cameras(Ts_ref_cam: Float[np.ndarray, "camera 4 4"], seen_ref_m: Float[np.ndarray, "point 3"]) -> LabFrame:
    """Guess the lab from how the cameras stand: up is their mean upward direction, X the first camera's right.

    Args:
        Ts_ref_cam: The cameras.
        seen_ref_m: Where the board was; the lowest of it is taken as the floor.
    """
    up = camera_up(Ts_ref_cam)
    heights = seen_ref_m @ up
    middle = seen_ref_m.mean(axis=0)
    origin = middle - (middle @ up - np.percentile(heights, 1)) * up
    return LabFrame(
        T_lab_ref=_axes_to_lab(up, Ts_ref_cam[0, :3, 0], origin),
        source="cameras",
        misfit_m=np.nan,
        tilt_sd_rad=float(UPRIGHT_SD_RAD),
    )


def camera_up(Ts_ref_cam: Float[np.ndarray, "camera 4 4"]) -> Float[np.ndarray, "3"]:
    """Give the cameras' mean upward direction: level cameras that look down lose nothing, opposite ones cancel that."""
    up = -Ts_ref_cam[:, :3, 1].mean(axis=0)
    length = np.linalg.norm(up)
    return up / length if length > 1e-9 else -Ts_ref_cam[0, :3, 1]


def _upwards(
    normal: Float[np.ndarray, "3"], origin: Float[np.ndarray, "3"], Ts_ref_cam: Float[np.ndarray, "camera 4 4"]
) -> Float[np.ndarray, "3"]:
    """Turn a floor's normal to the side on which the cameras are."""
    heights = (Ts_ref_cam[:, :3, 3] - origin) @ normal
    if heights.min() * heights.max() < 0:
        raise CaptureError(
            "Some cameras would stand below the floor that the board lies on: it does not lie on the floor there.",
            hint="Choose a moment in which the board lies flat on the floor, and all cameras are higher than it.",
            code="floor-contradicts",
        )
    return normal if heights.mean() > 0 else -normal


def _axes_to_lab(up: np.ndarray, forward: np.ndarray, origin: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Give ``T_lab_ref`` for the lab whose Y is ``up`` and whose X is ``forward`` without its vertical part."""
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    R_lab_ref = np.stack([x, up, np.cross(x, up)])
    return transform(R_lab_ref, -R_lab_ref @ origin)


def _short_walk() -> CaptureError:
    return CaptureError(
        "The walk is too short to tell the floor and the direction: it needs four steps over at least a metre.",
        hint="Walk through the middle of the room once, and best across it once more.",
        code="walk-too-short",
    )
