"""Bring keypoints that cameras took at different moments to common ones."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.kernel.smoothing.filters import low_pass
from gonio.records import ImagePoints, Timebase

VELOCITY_HZ = 6.0
"""Noise in the velocities makes every delay look smaller than it is; so they are taken from smoothed tracks."""


def shift(keypoints: ImagePoints, delay_s: Float[np.ndarray, " camera"]) -> ImagePoints:
    """Put all cameras on the first one's clock.

    Each observation goes to the frame nearest to the moment that it shows, and is moved there along its track by the rest of
    a frame; where its velocity is not known it stays as it is, right to half a frame. Whole frames change nothing but the
    place. What comes to lie beyond the ends is left out.
    """
    frames, rate_hz = keypoints.uv_px.shape[1], keypoints.timebase.rate_hz
    velocity = np.full_like(keypoints.uv_px, np.nan)
    sampled = keypoints.sampled
    velocity[:, :: keypoints.stride] = image_velocity(sampled.uv_px, sampled.timebase.rate_hz)
    uv_px, confidence = np.full_like(keypoints.uv_px, np.nan), np.zeros_like(keypoints.confidence)
    for camera, delay in enumerate(delay_s * rate_hz):
        shown = np.arange(frames) - delay  # the moment that each frame shows, in frames of the first camera
        place = np.rint(shown + 1e-9).astype(int)
        inside = (place >= 0) & (place < frames)
        rest_s = ((place - shown) / rate_hz)[inside, None, None]
        moved = keypoints.uv_px[camera, inside] + np.nan_to_num(velocity[camera, inside]) * rest_s
        uv_px[camera, place[inside]] = moved
        confidence[camera, place[inside]] = keypoints.confidence[camera, inside]
    return replace(keypoints, uv_px=uv_px, confidence=confidence)


def image_velocity(
    uv_px: Float[np.ndarray, "camera frame keypoint 2"], rate_hz: float
) -> Float[np.ndarray, "camera frame keypoint 2"]:
    """Give how fast keypoints move in the images, px/s, from smoothed tracks; NaN beside gaps."""
    return velocity_of(smooth_tracks(uv_px, rate_hz), rate_hz)


def smooth_tracks(
    uv_px: Float[np.ndarray, "camera frame keypoint 2"], rate_hz: float
) -> Float[np.ndarray, "camera frame keypoint 2"]:
    """Low-pass keypoints over time in each picture, each run without a gap by itself."""
    return np.stack([low_pass(of_camera, rate_hz, min(VELOCITY_HZ, 0.4 * rate_hz)) for of_camera in uv_px])


def velocity_of(
    smooth_px: Float[np.ndarray, "camera frame keypoint 2"], rate_hz: float
) -> Float[np.ndarray, "camera frame keypoint 2"]:
    """Differentiate smooth tracks by central differences of fourth order, px/s; of second order beside an end or a gap.

    At 30 Hz those of second order lose 6 % of a movement of 3 Hz.
    """
    velocity = np.full_like(smooth_px, np.nan)
    near = smooth_px[:, 2:] - smooth_px[:, :-2]
    velocity[:, 1:-1] = near * rate_hz / 2
    if smooth_px.shape[1] > 4:
        far = smooth_px[:, 4:] - smooth_px[:, :-4]
        exact = (8 * near[:, 1:-1] - far) * rate_hz / 12
        velocity[:, 2:-2] = np.where(np.isfinite(exact), exact, velocity[:, 2:-2])
    return velocity


def thin(keypoints: ImagePoints, stride: int) -> ImagePoints:
    """Give every ``stride``-th frame, from the first, as a stream of its own rate.

    A camera that found nothing in such a frame gives the nearest one less than half a stride away in which it did, moved to
    the frame's moment along its track: cameras that were looked at in turn, or run late, keep what they saw.
    """
    frames, rate_hz = keypoints.uv_px.shape[1], keypoints.timebase.rate_hz
    grid = np.arange(0, frames, stride)
    uv_px, confidence = [], []
    for track, trust in zip(keypoints.uv_px, keypoints.confidence, strict=True):
        looked = (trust > 0).any(axis=1)
        source = grid.copy()
        for away in sorted(range(-(stride // 2), stride // 2 + 1), key=abs, reverse=True):
            near = np.clip(grid + away, 0, frames - 1)
            source = np.where(looked[near], near, source)
        moved = track[source]
        if (source != grid).any():
            first = int(np.argmax(looked)) % keypoints.stride
            own = image_velocity(track[None, first :: keypoints.stride], rate_hz / keypoints.stride)[0]
            velocity = np.zeros_like(track)
            velocity[first :: keypoints.stride] = np.nan_to_num(own)
            moved = moved + velocity[source] * ((grid - source) / rate_hz)[:, None, None]
        uv_px.append(moved)
        confidence.append(trust[source])
    return replace(
        keypoints,
        timebase=Timebase(rate_hz=rate_hz / stride, start_s=keypoints.timebase.start_s),
        uv_px=np.stack(uv_px),
        confidence=np.stack(confidence),
        stride=1,
    )
