"""Find by how much each camera runs late, together with where it stands, from the subject's own movement.

A wrong pose and a wrong clock look alike in a single frame: a calibration that has drifted makes a synchronous camera seem
frames late. So the delays are never found alone. For each hypothesis of whole frames the poses are adjusted anew and the
disagreement that remains is compared; what is left of a frame is solved for along with the poses.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from gonio.kernel.calibration.bundle import MAX_ITERATIONS, Bundle, adjust_poses
from gonio.kernel.calibration.person import SAMPLE_HZ, SCALE_M, SIGMA_PX, held_out_error_px
from gonio.kernel.geometry.cameras import undistort_rig
from gonio.kernel.synchronization.looks import shift, smooth_tracks, velocity_of
from gonio.records import ImagePoints, Rig, record

Status = Literal["synchronous", "corrected", "unknown", "trusted"]

MAX_DELAY_S = 0.5
"""Half a gait cycle: a walk looks nearly the same a whole cycle later, and nothing in it could tell."""

SMALLEST_DELAY_FRAMES = 0.3
"""Delays below this are left alone: they shift a foot at 5 m/s by less than the detector's own error."""

LARGEST_SD_FRAMES = 0.4
SMALLEST_GAIN = 0.03
"""A correction must be known to less than half a frame, and lower the held-out error by this share."""

MOST_FRAMES = 60
SEARCH_ITERATIONS = 6  # of the pose adjustment for a hypothesis: its cost is then within a few per cent of the end
COARSE_STEPS = 12


@record
class Synchronization:
    """The cameras' delays against the first one, seconds; positive runs late.

    ``status`` is ``synchronous`` (measured, and too small to matter), ``corrected``, ``unknown`` (the movement does not
    tell, and the delays are 0) or ``trusted`` (not looked at). ``sd_s`` says how well each is known; the errors are mean
    reprojection errors of moments that were not used, before and after.
    """

    status: Status
    delay_s: Float[np.ndarray, " camera"]
    sd_s: Float[np.ndarray, " camera"]
    error_before_px: float
    error_after_px: float


@dataclass(frozen=True)
class _Streams:
    """The keypoints on their way through the search: undistorted, weighted, with their image velocities."""

    rig: Rig
    uv_px: Float[np.ndarray, "camera frame keypoint 2"]
    velocity_px_s: Float[np.ndarray, "camera frame keypoint 2"]
    weight: Float[np.ndarray, "camera frame keypoint"]
    rate_hz: float
    reach: int  # the largest lag in frames, so that every hypothesis is judged on the same frames

    def frames(self, held_out: bool) -> Int[np.ndarray, " chosen"]:
        """Choose the frames to solve on, or those to judge on: every other one of a sample."""
        inner = np.arange(self.reach, self.uv_px.shape[1] - self.reach)
        stride = max(1, round(self.rate_hz / SAMPLE_HZ / 2), int(np.ceil(len(inner) / (2 * MOST_FRAMES))))
        return inner[::stride][int(held_out) :: 2]

    def at(
        self, values: np.ndarray, lags: Int[np.ndarray, " camera"], frames: Int[np.ndarray, " chosen"]
    ) -> np.ndarray:
        """Take each camera's values where it shows the given frames: ``lag`` frames later for a camera that runs late."""
        return np.stack([of_camera[frames + lag] for of_camera, lag in zip(values, lags, strict=True)])


def estimate_delays(rig: Rig, keypoints: ImagePoints, min_confidence: float) -> Synchronization:
    """Estimate the delays of all cameras against the first one.

    With fewer than three cameras a delay and a wrong pose can't be told apart, and in a clip shorter than a few tenths of a
    second nothing can be told: ``unknown``.
    """
    keypoints = keypoints.sampled
    rate_hz, frames = keypoints.timebase.rate_hz, keypoints.uv_px.shape[1]
    reach = min(round(MAX_DELAY_S * rate_hz), frames // 6)
    if len(rig.cameras) < 3 or reach < 2:
        return _unknown(rig)
    weight = np.where(keypoints.confidence >= min_confidence, keypoints.confidence, 0.0)
    uv_px = undistort_rig(rig, keypoints.uv_px)
    smooth_px = smooth_tracks(uv_px, rate_hz)
    streams = _Streams(rig, uv_px, velocity_of(smooth_px, rate_hz), weight, rate_hz, reach)
    none = np.zeros(len(rig.cameras), dtype=int)
    lags = none
    if np.abs(_solve(streams, none, delays=True).delay_s).max() * rate_hz > SMALLEST_DELAY_FRAMES:
        lags = _search(streams)
    found = _judge(streams, lags, *_resolve(streams, lags))
    if found.status != "corrected":
        return found
    # To move raw keypoints by a part of a frame averages their noise away: half a frame then looks better than none, whatever
    # the delay is. Smoothed ones gain nothing by it. Whether anything is known at all the raw ones tell, whose errors are new.
    rest_s, _ = _resolve(replace(streams, uv_px=smooth_px), lags)
    return replace(found, delay_s=lags / rate_hz + rest_s)


def confirm_delays(
    rig: Rig, keypoints: ImagePoints, delay_s: Float[np.ndarray, " camera"], min_confidence: float
) -> Synchronization:
    """Ask the movement whether delays that are known from elsewhere are its own: ``corrected`` if so, else ``unknown``.

    Two cameras can be asked too: nothing is estimated, the poses stay as they are.
    """
    keypoints = keypoints.sampled
    errors: list[float] = []
    for one in (np.zeros(len(delay_s)), delay_s):
        shifted = shift(keypoints, one)
        weight = np.where(shifted.confidence >= min_confidence, shifted.confidence, 0.0)
        errors.append(held_out_error_px(rig, undistort_rig(rig, shifted.uv_px), weight))
    before, after = errors
    found = replace(_unknown(rig), error_before_px=before, error_after_px=after)
    return replace(found, status="corrected", delay_s=delay_s) if after < (1 - SMALLEST_GAIN) * before else found


def trusted(rig: Rig) -> Synchronization:
    """Give the synchronization of cameras with a common trigger: nothing was looked at, and nothing is changed."""
    return replace(_unknown(rig), status="trusted")


def _unknown(rig: Rig) -> Synchronization:
    cameras = len(rig.cameras)
    return Synchronization(
        status="unknown",
        delay_s=np.zeros(cameras),
        sd_s=np.full(cameras, np.inf),
        error_before_px=np.nan,
        error_after_px=np.nan,
    )


def _solve(
    streams: _Streams,
    lags: Int[np.ndarray, " camera"],
    rest_s: Float[np.ndarray, " camera"] | None = None,
    *,
    delays: bool,
    max_iterations: int = MAX_ITERATIONS,
) -> Bundle:
    """Adjust the poses with each camera shifted by its lag and rest; with ``delays``, also find what is still left."""
    frames, cameras = streams.frames(held_out=False), len(lags)
    velocity = streams.at(streams.velocity_px_s, lags, frames)
    uv_px = streams.at(streams.uv_px, lags, frames)
    if rest_s is not None:
        uv_px = uv_px + rest_s[:, None, None, None] * velocity
    return adjust_poses(
        streams.rig,
        uv_px.reshape(cameras, -1, 2),
        streams.at(streams.weight, lags, frames).reshape(cameras, -1),
        sigma_px=SIGMA_PX,
        scale_m=SCALE_M,
        velocity_px_s=velocity.reshape(cameras, -1, 2) if delays else None,
        delay_prior_s=2.0 / streams.rate_hz,
        max_iterations=max_iterations,
    )


def _resolve(streams: _Streams, lags: Int[np.ndarray, " camera"]) -> tuple[Float[np.ndarray, " camera"], Bundle]:
    """Find the part of a frame that whole lags leave, in a few rounds: each finds most of what the one before left."""
    rest_s = np.zeros(len(lags))
    bundle = _solve(streams, lags, rest_s, delays=True)
    for _ in range(4):
        rest_s = rest_s + bundle.delay_s
        if np.abs(bundle.delay_s).max() * streams.rate_hz < 0.02:
            break
        bundle = _solve(streams, lags, rest_s, delays=True)
    if np.abs(rest_s).max() * streams.rate_hz < SMALLEST_DELAY_FRAMES:  # whole frames need no mixing of two
        return np.zeros(len(lags)), _solve(streams, lags, delays=True)
    return rest_s, bundle


def _search(streams: _Streams) -> Int[np.ndarray, " camera"]:
    """Find the whole-frame lags by coordinate descent: one camera at a time, coarse steps first, until none improves.

    The first camera takes its turn too: what moves it against all others moves all their lags, and one by one they would not
    go, since each would leave the rest.
    """
    lags = np.zeros(len(streams.rig.cameras), dtype=int)
    costs: dict[tuple[int, ...], float] = {}

    def cost(trial: Int[np.ndarray, " camera"]) -> float:
        key = tuple(int(lag) for lag in trial)
        if key not in costs:
            costs[key] = _solve(streams, trial, delays=False, max_iterations=SEARCH_ITERATIONS).cost
        return costs[key]

    step, span = max(1, 2 * streams.reach // COARSE_STEPS), streams.reach
    while True:
        improving = True
        while improving:
            before = lags
            for camera in range(len(lags)):
                moving = np.arange(len(lags)) != 0 if camera == 0 else np.arange(len(lags)) == camera
                start = lags
                for change in range(-span, span + 1, step):
                    trial = start + change * moving
                    if np.abs(trial).max() <= streams.reach and cost(trial) < cost(lags):
                        lags = trial
            improving = not np.array_equal(before, lags)
        if step == 1:
            return lags
        step, span = max(1, step // 3), step


def _judge(
    streams: _Streams, lags: Int[np.ndarray, " camera"], rest_s: Float[np.ndarray, " camera"], bundle: Bundle
) -> Synchronization:
    """Decide whether the movement tells the delays, and whether they matter."""
    cameras = len(lags)
    delay_s = lags / streams.rate_hz + rest_s
    # Keypoints of one limb and frames of one moment repeat each other's errors: a tenth of them are news.
    sd_s = 3.0 * bundle.delay_sd_s
    frames = streams.frames(held_out=True)

    def error(rig: Rig, lag: Int[np.ndarray, " camera"], rest_s: Float[np.ndarray, " camera"]) -> float:
        uv = streams.at(streams.uv_px, lag, frames)
        uv = uv + rest_s[:, None, None, None] * np.nan_to_num(streams.at(streams.velocity_px_s, lag, frames))
        return held_out_error_px(rig, uv, streams.at(streams.weight, lag, frames))

    none = np.zeros(cameras, dtype=int)
    before = error(_solve(streams, none, delays=False).rig, none, np.zeros(cameras))
    after = error(bundle.rig, lags, rest_s)
    known = bool((sd_s[1:] * streams.rate_hz < LARGEST_SD_FRAMES).all())
    large = bool(np.abs(delay_s).max() * streams.rate_hz > SMALLEST_DELAY_FRAMES)
    if not known or (large and not after < (1 - SMALLEST_GAIN) * before):
        return replace(_unknown(streams.rig), error_before_px=before, error_after_px=after, sd_s=sd_s)
    return Synchronization(
        status="corrected" if large else "synchronous",
        delay_s=delay_s if large else np.zeros(cameras),
        sd_s=sd_s,
        error_before_px=before,
        error_after_px=after,
    )
