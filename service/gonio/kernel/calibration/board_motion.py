"""How fast a board moved, in space and in the pictures: what a camera's delay shows itself by."""

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.calibration.board_terms import DELAY, move_frames
from gonio.kernel.calibration.boards import Scene
from gonio.kernel.geometry.transforms import apply

STILL_PX = 2.0
MAX_GAP_S = 0.3
"""Pictures further apart than this say nothing about the motion between them."""


def motion(
    values: Float[np.ndarray, "*batch frame value"], times_s: Float[np.ndarray, " frame"]
) -> tuple[Float[np.ndarray, "*batch frame value"], Float[np.ndarray, "*batch frame value"]]:
    """Give velocity and acceleration: by the parabola through a value and its two neighbours in time.

    The line through two where one neighbour is missing (NaN) or too far in time, with acceleration 0; NaN where both are.
    """
    step = np.diff(times_s)
    gap = np.where((step > 0) & (step <= MAX_GAP_S), step, np.nan)
    after, before = np.append(gap, np.nan)[:, None], np.insert(gap, 0, np.nan)[:, None]
    change = np.diff(values, axis=-2)
    end = np.full_like(values[..., :1, :], np.nan)
    forward, backward = np.concatenate([change, end], axis=-2) / after, np.concatenate([end, change], axis=-2) / before
    both = (forward * before + backward * after) / (before + after)
    velocity = np.where(np.isfinite(both), both, np.where(np.isfinite(forward), forward, backward))
    acceleration = 2 * (forward - backward) / (before + after)
    return velocity, np.where(np.isfinite(acceleration), acceleration, np.where(np.isfinite(velocity), 0.0, np.nan))


def advance(
    uv_px: Float[np.ndarray, "camera frame corner 2"],
    times_s: Float[np.ndarray, " frame"],
    delay_s: Float[np.ndarray, " camera"],
) -> Float[np.ndarray, "camera frame corner 2"]:
    """Give where a late camera's corners are at the frame's true instant; a corner whose motion is unknown stays."""
    velocity, acceleration = motion(uv_px.reshape(*uv_px.shape[:2], -1), times_s)
    delay = delay_s[:, None, None]
    ahead = delay * velocity + 0.5 * delay**2 * acceleration
    return uv_px + np.nan_to_num(ahead).reshape(uv_px.shape)


def corner_velocities(
    scene: Scene, corners_board_m: Float[np.ndarray, "corner 3"], times_s: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "camera frame corner 2"]:
    """Give how fast the corners move in the pictures, px/s, by the boards' own motion; NaN where that is unknown.

    A camera that is late by d shows ``u − d u' + d²/2 u''``: half the acceleration times the delay goes into the velocity,
    so that the model is right to second order.
    """
    frames, corners = len(times_s), len(corners_board_m)
    xyz = np.stack([apply(T, corners_board_m) for T in scene.Ts_ref_board])
    speed, change = motion(xyz.reshape(frames, -1), times_s)
    effective = speed - 0.5 * scene.theta[:, DELAY, None, None] * change
    velocity = np.full((len(scene.theta), frames, corners, 2), np.nan)
    move_frames(
        scene.theta, scene.Ts_cam_ref, scene.Ts_ref_board, corners_board_m,
        effective.reshape(-1, frames, corners, 3), velocity,
    )  # fmt: skip
    return velocity


def distinct_frames(uv_px: Float[np.ndarray, "camera frame corner 2"]) -> Bool[np.ndarray, " frame"]:
    """Say which frames show the board at another place than the last one that was kept, in any camera.

    A board that is held still repeats the same errors: ten pictures of it would count as ten and say one.
    """
    kept = np.zeros(uv_px.shape[1], dtype=bool)
    last = np.full((uv_px.shape[0], *uv_px.shape[2:]), np.nan)
    for frame in range(uv_px.shape[1]):
        now = uv_px[:, frame]
        seen = np.isfinite(now[..., 0])
        both = seen & np.isfinite(last[..., 0])
        moved = np.linalg.norm(np.where(both[..., None], now - last, 0.0), axis=-1).max(initial=0.0) > STILL_PX
        appeared = np.any(seen.any(axis=1) & ~both.any(axis=1))
        if moved or appeared:
            kept[frame], last = True, now
    return kept
