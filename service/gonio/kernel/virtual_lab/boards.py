"""A calibration board that somebody waves about between the cameras."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.chance import stream
from gonio.kernel.virtual_lab.rig import Clocks, camera_times_s
from gonio.records import Camera, Rig, Timebase, VirtualBoard

REACH_M = np.array([1.0, 0.5, 1.0])
MIDDLE_M = np.array([0.0, 1.2, 0.0])
"""Where the board is carried: the middle of the walkway, from the knees to over the head."""

STEEPEST_RAD = np.deg2rad(65.0)
"""Detectors lose a board that is seen from further aside."""

FEWEST_CORNERS = 6


def wave_board(
    corners_board_m: Float[np.ndarray, "corner 3"],
    rig: Rig,
    *,
    poses: int = 60,
    rate_hz: float = 2.0,
    noise_px: float = 0.3,
    whole: bool = True,
    clocks: Clocks | None = None,
    seed: int = 0,
) -> VirtualBoard:
    """Let the cameras of a rig see the corners of a moving board.

    The board turns once around in the recording, so that every camera sees its front for a while, tilts by up to 40° and
    rolls; it moves by some decimetres a second.

    Args:
        corners_board_m: The corners in the board's frame, whose Z axis points into the paper as seen from the front.
        rig: The cameras as they really are.
        poses: How many pictures each camera takes.
        rate_hz: How often.
        noise_px: Standard deviation of a corner, per axis.
        whole: The detector finds a board only if it is wholly in the picture (a checkerboard), not also parts of it.
        clocks: Delays and drift of the cameras.
        seed: Of everything random.

    Raises:
        InputError: fewer than two pictures.
    """
    if poses < 2:
        raise InputError(f"{poses} pictures of a board calibrate nothing.", hint="Ask for at least two.")
    timebase = Timebase(rate_hz=rate_hz)
    taken_s = camera_times_s(timebase, poses, len(rig.cameras), clocks or Clocks(), seed)
    centred = corners_board_m - corners_board_m.mean(axis=0)
    reported, exact = [], []
    for number, (camera, times_s) in enumerate(zip(rig.cameras, taken_s, strict=True)):
        T_lab_centre = _wave(times_s, poses / rate_hz, seed)
        corners_m = np.einsum("fij,cj->fci", T_lab_centre[:, :3, :3], centred) + T_lab_centre[:, None, :3, 3]
        uv_px = project(camera, corners_m)
        seen = _sees(camera, T_lab_centre, uv_px, whole)
        noise = noise_px * stream(seed, "corners", number).standard_normal(uv_px.shape)
        reported.append(np.where(seen[..., None], uv_px + noise, np.nan))
        exact.append(uv_px)
    times_s = timebase.times_s(poses)
    T_lab_board = _wave(times_s, poses / rate_hz, seed)
    T_lab_board[:, :3, 3] -= T_lab_board[:, :3, :3] @ corners_board_m.mean(axis=0)
    return VirtualBoard(
        times_s=times_s,
        camera_times_s=taken_s,
        T_lab_board=T_lab_board,
        uv_px=np.stack(reported),
        exact_px=np.stack(exact),
    )


def _wave(times_s: Float[np.ndarray, " frame"], duration_s: float, seed: int) -> Float[np.ndarray, "frame 4 4"]:
    """Give the pose of the board's middle at any times: smooth, the same for all cameras."""
    rng = stream(seed, "board", 0)
    # Three slow waves for each of three places and three angles, within bounds; the periods share no rhythm.
    rates = 2 * np.pi / rng.uniform(8.0, 20.0, (3, 6))
    phases = rng.uniform(0, 2 * np.pi, (3, 6))
    waves = np.sin(rates * times_s[:, None, None] + phases).mean(axis=1) * np.sqrt(2.0)
    tilt, roll, wobble = np.clip(waves[:, 3:], -1.0, 1.0).T
    heading = 2 * np.pi * times_s / duration_s + phases[0, 0] + 0.5 * wobble
    tilt, roll = np.deg2rad(40.0) * tilt, np.deg2rad(45.0) * roll
    front = np.stack([np.cos(heading) * np.cos(tilt), np.sin(tilt), np.sin(heading) * np.cos(tilt)], axis=-1)
    across = np.stack([-np.sin(heading), np.zeros_like(heading), np.cos(heading)], axis=-1)
    down = np.cross(-front, across)
    T_lab_centre = np.tile(np.eye(4), (len(times_s), 1, 1))
    T_lab_centre[:, :3, 0] = np.cos(roll)[:, None] * across + np.sin(roll)[:, None] * down
    T_lab_centre[:, :3, 1] = np.cos(roll)[:, None] * down - np.sin(roll)[:, None] * across
    T_lab_centre[:, :3, 2] = -front
    T_lab_centre[:, :3, 3] = MIDDLE_M + REACH_M * np.clip(waves[:, :3], -1.0, 1.0)
    return T_lab_centre


def _sees(
    camera: Camera,
    T_lab_centre: Float[np.ndarray, "frame 4 4"],
    uv_px: Float[np.ndarray, "frame corner 2"],
    whole: bool,
) -> Bool[np.ndarray, "frame corner"]:
    towards = camera.centre_lab_m - T_lab_centre[:, :3, 3]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    faces = (-T_lab_centre[:, :3, 2] * towards).sum(axis=-1) > np.cos(STEEPEST_RAD)
    inside = (uv_px > 1.0).all(axis=-1) & (uv_px < np.array(camera.image_size_px) - 2.0).all(axis=-1)
    enough = inside.sum(axis=1) >= (uv_px.shape[1] if whole else FEWEST_CORNERS)
    return inside & (faces & enough)[:, None]
