"""Fuse what the cameras saw at different moments into one smooth track a keypoint.

Detector errors last for a tenth of a second: frames that are closer than that mostly repeat them, and a track that is
estimated over time from half of the frames is as good as one from all of them. So each keypoint is one maximum a posteriori
problem over the whole trial: robust reprojection errors of all observations, whenever they were made, and a penalty on the
third difference, which leaves constant acceleration alone. Points of frames without any observation follow from their
neighbours in time, within stated limits.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from gonio.kernel.body.tree import Array
from gonio.kernel.optimize.banded import factorise, invert_within, substitute
from gonio.kernel.parallel import over_blocks
from gonio.kernel.smoothing.correlation import repeats
from gonio.kernel.smoothing.filters import median_filter
from gonio.records import FILLED, MEASURED, MISSING, LabPoints, record

SIGMA_PX = 6.0
"""A detector's error at confidence 1: it weighs the observations against the smoothness, as the cutoff below says."""

SCALES_M = (0.05, 0.03, 0.03, 0.03)
"""Cauchy's scale in the rounds of reweighting, at the point's depth.

The start is robust already. Beginning wider (0.15 m, eight rounds) lets a burst of outliers draw a track away from where the
later rounds, which trust what is near, can find back: it made the root mean square error of virtual arms and legs 5 to 44 %
larger, by preset.
"""

BAND = 12  # three coordinates a frame, coupled with the three frames before: 3 · 3 + 3
LOWEST_INFORMATION = 1e-6  # 1/m²: a track without any observation stays where it started

AGREE_M = 0.05
"""A camera agrees with a point that it misses by less: the narrowest loss above then leaves it a quarter of its weight."""

JUMP_M, JUMP_TAPS, JUMP_STEP_S = 0.15, 11, 0.05
"""A point that is so far from the median of the half second around it is no start: outliers last for up to a third of one."""

KEPT = 0.25
"""A camera counts as having seen a point where the loss leaves it more than this share of its weight."""

MOST_JUDGED = 200
"""Moments of which it is computed what they would say alone."""

LONGEST_SPAN_S = 0.2
"""Observations that are farther apart leave a gap: the track between them would be invented."""


@record
class FusedTracks:
    """Tracks in the lab, their covariance, and which observations the loss kept.

    ``covariance_m2`` is the posterior's, made as large as the residuals say (:func:`_inflation`). ``camera_weight`` is 0 to 1,
    0 where nothing was observed.
    """

    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"]
    camera_weight: Float[np.ndarray, "camera frame keypoint"]


def fuse(
    projections: Float[np.ndarray, "camera 3 4"],
    focal_px: Float[np.ndarray, " camera"],
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    confidence: Float[np.ndarray, "camera frame keypoint"],
    start: Float[np.ndarray, "frame keypoint 3"],
    *,
    rate_hz: float,
    cutoff_hz: float,
) -> FusedTracks:
    """Estimate all tracks.

    Args:
        projections: ``K [R|t]`` of each camera.
        focal_px: Mean focal length of each camera.
        uv_px: Undistorted observations; NaN is missing.
        confidence: Theirs; an observation weighs by its square, as in ``robust`` triangulation; 0 is missing.
        start: Points to start from, as triangulated frame by frame. NaN is filled by straight lines, and so is what only
            half of the cameras support, or what jumps: there the rest of the track decides which cameras are right.
        rate_hz: Of the frames.
        cutoff_hz: Where the penalty begins to win over the observations of one camera: about the bandwidth of the track.

    A keypoint that was triangulated in fewer than two frames is NaN.
    """
    frames, keypoints = confidence.shape[1:]
    weight = np.where(np.isfinite(uv_px).all(axis=-1) & (confidence > 0), confidence, 0.0) ** 2
    xyz = _filled(_plausible(start, projections, focal_px, uv_px, weight, rate_hz))
    depth_m = np.einsum("ci,fki->cfk", projections[:, 2, :3], xyz) + projections[:, 2, 3, None, None]
    px_per_m = focal_px[:, None, None] / np.maximum(depth_m, 0.1)
    # One camera's information at the usual distance, spread over three directions, balanced against the penalty at cutoff.
    usual = 2.0 * float(np.nanmedian(px_per_m) ** 2) / SIGMA_PX**2
    stiffness = usual / (2.0 * np.sin(np.pi * min(cutoff_hz, 0.45 * rate_hz) / rate_hz)) ** 6
    covariance = np.full((frames, keypoints, 3, 3), np.nan)
    kept = np.zeros(weight.shape)
    seen = np.where(weight[..., None] > 0, uv_px, 0.0)
    P = projections.astype(float, order="C")
    scales = np.array(SCALES_M)

    def solve(first: int, last: int) -> None:
        for k in range(first, last):
            if np.isfinite(xyz[:, k]).all():
                observed = (np.ascontiguousarray(values[:, :, k]) for values in (px_per_m, seen, weight))
                fused = _fuse_track(_Track(P, *observed), np.ascontiguousarray(xyz[:, k]), stiffness, scales)
                xyz[:, k], covariance[:, k], kept[:, :, k] = fused

    over_blocks(solve, keypoints, 1)
    covariance *= _inflation(projections, seen, weight, xyz, covariance, kept)[:, None, None]
    return FusedTracks(xyz_lab_m=xyz, covariance_m2=covariance, camera_weight=kept)


def _inflation(
    projections: Float[np.ndarray, "camera 3 4"],
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    weight: Float[np.ndarray, "camera frame keypoint"],
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"],
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"],
    kept: Float[np.ndarray, "camera frame keypoint"],
) -> Float[np.ndarray, " keypoint"]:
    """Give the factor by which each keypoint's posterior covariance is too small, or too large.

    The posterior takes every observation for one of :data:`SIGMA_PX` that errs by itself. The residuals tell how large the
    errors are, each camera's constant ones included: their level, by keypoint. They also tell how long errors last: a mean
    over less than that is no better than one moment. Of each moment's degrees of freedom the track has drawn off three where
    it is no better than one moment, and as much less as it is better: an error that it does not follow is still there to see.
    """
    keypoints = xyz_lab_m.shape[1]
    chosen = np.arange(0, len(xyz_lab_m), max(1, len(xyz_lab_m) // MOST_JUDGED))
    homogeneous = xyz_lab_m @ projections[:, None, :, :3].swapaxes(-2, -1) + projections[:, None, None, :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = (uv_px - homogeneous[..., :2] / homogeneous[..., 2:]) * np.sqrt(weight)[..., None] / SIGMA_PX
    inlier = (kept > KEPT) & ((kept > KEPT).sum(axis=0) >= 2)
    last = repeats(np.where(inlier[..., None], error, 0.0), inlier)
    single = _single_moment_m2(projections, homogeneous[:, chosen], (weight * kept)[:, chosen])
    fused = np.trace(covariance_m2[chosen], axis1=2, axis2=3)
    factor = np.ones(keypoints)
    for k in range(keypoints):
        seen = inlier[..., k]
        if not seen.any() or not np.isfinite(covariance_m2[:, k]).all():
            continue
        cameras = seen.sum() / seen.any(axis=0).sum()
        level = np.median((error[:, :, k][seen] ** 2).sum(axis=-1)) / 1.386  # half of all |e|² of two normals lie below
        judged = seen[:, chosen].any(axis=0)
        if judged.any():
            most = max(1.0, float(np.median((single / fused)[judged, k])))
            lasting = float(np.clip(last, 1.0, most))
            factor[k] = level * lasting * 2.0 * cameras / (2.0 * cameras - 3.0 * lasting / most)
    return factor


def _single_moment_m2(
    projections: Float[np.ndarray, "camera 3 4"],
    homogeneous: Float[np.ndarray, "camera moment keypoint 3"],
    weight: Float[np.ndarray, "camera moment keypoint"],
) -> Float[np.ndarray, "moment keypoint"]:
    """Give the variance (its trace) that points would have from one moment's observations alone; NaN for what is nowhere."""
    P = projections[:, None, None]
    slope = P[..., :2, :3] - (homogeneous[..., :2] / homogeneous[..., 2:])[..., None] * P[..., 2:, :3]
    slope *= np.sqrt(weight)[..., None, None] / (SIGMA_PX * homogeneous[..., 2:, None])
    rows = np.moveaxis(slope, 0, 2).reshape(*weight.shape[1:], -1, 3)  # of all cameras
    information = rows.swapaxes(-2, -1) @ rows + LOWEST_INFORMATION * np.eye(3)
    return np.trace(np.linalg.inv(information), axis1=2, axis2=3)


def mark_spans(points: LabPoints, tracks: FusedTracks) -> LabPoints:
    """Put the tracks into the points, with gaps where observations are too far apart and marks where they were filled.

    A frame counts as observed where at least two cameras keep more than a quarter of their weight. Between two observed
    frames that are at most :data:`LONGEST_SPAN_S` apart a track is filled; in a longer span, and before the first and after
    the last observed frame, there is nothing.
    """
    observed = (tracks.camera_weight > KEPT).sum(axis=0) >= 2
    lost = _span_frames(observed) > LONGEST_SPAN_S * points.timebase.rate_hz + 1e-6
    origin = np.where(observed, MEASURED, np.where(lost, MISSING, FILLED)).astype(np.uint8)
    return replace(
        points,
        xyz_lab_m=np.where(lost[..., None], np.nan, tracks.xyz_lab_m),
        covariance_m2=np.where(lost[..., None, None], np.nan, tracks.covariance_m2),
        origin=np.where(np.isnan(tracks.xyz_lab_m[..., 0]), MISSING, origin).astype(np.uint8),
    )


def _span_frames(observed: np.ndarray) -> Float[np.ndarray, "frame keypoint"]:
    """Give how far the observed frames on both sides of each frame are apart: 0 on one, infinite beyond the ends."""
    frames = np.arange(len(observed))[:, None]
    before = np.maximum.accumulate(np.where(observed, frames, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(observed, frames, np.inf)[::-1], axis=0)[::-1]
    return after - before


def _plausible(
    start: Float[np.ndarray, "frame keypoint 3"],
    projections: Float[np.ndarray, "camera 3 4"],
    focal_px: Float[np.ndarray, " camera"],
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    weight: Float[np.ndarray, "camera frame keypoint"],
    rate_hz: float,
) -> Float[np.ndarray, "frame keypoint 3"]:
    """Leave out of a start what may be an outlier's explanation, unless that is most of the track.

    Two cameras that err together can be as consistent as the two that don't; then a single frame can't tell who is right.
    """
    agreeing, seeing = np.zeros(start.shape[:2]), (weight > 0).sum(axis=0)
    for P, focal, uv, used in zip(projections, focal_px, uv_px, weight, strict=True):
        homogeneous = start @ P[:, :3].T + P[:, 3]
        miss_px = np.linalg.norm(uv - homogeneous[..., :2] / homogeneous[..., 2:], axis=-1)
        agreeing += (used > 0) & (miss_px * homogeneous[..., 2] < AGREE_M * focal)
    kept = np.where((agreeing > seeing / 2)[..., None], start, np.nan)
    step = max(1, round(JUMP_STEP_S * rate_hz))
    for phase in range(step):
        points = kept[phase::step]
        away = np.linalg.norm(points - median_filter(points, JUMP_TAPS), axis=-1)
        points[away > JUMP_M] = np.nan
    few = np.isfinite(kept[..., 0]).sum(axis=0) < np.isfinite(start[..., 0]).sum(axis=0) / 2
    return np.where(few[:, None], start, kept)


def _filled(start: Float[np.ndarray, "frame keypoint 3"]) -> Float[np.ndarray, "frame keypoint 3"]:
    """Fill gaps by straight lines, and ends by their nearest value, for a start only; NaN if fewer than two are known."""
    filled = np.full_like(start, np.nan)
    time = np.arange(len(start))
    for k in range(start.shape[1]):
        known = np.isfinite(start[:, k, 0])
        if known.sum() >= 2:
            for axis in range(3):
                filled[:, k, axis] = np.interp(time, time[known], start[known, k, axis])
    return filled


class _Track(NamedTuple):
    """One keypoint's observations, for compiled code."""

    projections: Array  # (camera, 3, 4)
    px_per_m: Array  # (camera, frame)
    uv_px: Array  # (camera, frame, 2)
    weight: Array  # (camera, frame)


@njit(cache=True, nogil=True, error_model="numpy")
def _fuse_track(track: _Track, start: Array, stiffness: float, scales: Array) -> tuple[Array, Array, Array]:
    """Estimate one keypoint's track from ``start`` (frame, 3); also give its covariance and the weights that are kept."""
    frames = len(start)
    x = start.copy()
    band, right = np.zeros((3 * frames, BAND)), np.zeros(3 * frames)
    kept = np.zeros(track.weight.shape)
    for scale_m in scales:
        _assemble(track, x, stiffness, scale_m, band, right, kept)
        if not factorise(band):
            break
        substitute(band, right)
        for t in range(frames):
            for i in range(3):
                x[t, i] += right[3 * t + i]
    _assemble(track, x, stiffness, scales[-1], band, right, kept)
    covariance = np.full((frames, 3, 3), np.nan)
    if factorise(band):
        inverse = np.zeros_like(band)
        invert_within(band, inverse)
        for t in range(frames):
            for i in range(3):
                for j in range(i + 1):
                    covariance[t, i, j] = covariance[t, j, i] = inverse[3 * t + i, i - j]
    return x, covariance, kept


@njit(cache=True, nogil=True, error_model="numpy")
def _assemble(
    track: _Track, x: Array, stiffness: float, scale_m: float, band: Array, right: Array, kept: Array
) -> None:
    """Fill the normal equations at ``x``: the observations' and the penalty's."""
    band[:] = 0.0
    right[:] = 0.0
    frames, error, slope = len(x), np.empty(2), np.empty((2, 3))
    for t in range(frames):
        for i in range(3):
            band[3 * t + i, 0] += LOWEST_INFORMATION
        for c in range(len(track.projections)):
            kept[c, t] = 0.0
            if track.weight[c, t] > 0.0:
                kept[c, t] = _add_observation(track, c, t, x[t], scale_m, band, right, error, slope)
    signs = (-1.0, 3.0, -3.0, 1.0)
    for t in range(frames - 3):
        for i in range(3):
            jerk = x[t + 3, i] - 3.0 * x[t + 2, i] + 3.0 * x[t + 1, i] - x[t, i]
            for a in range(4):
                right[3 * (t + a) + i] -= stiffness * signs[a] * jerk
                for b in range(a + 1):
                    band[3 * (t + a) + i, 3 * (a - b)] += stiffness * signs[a] * signs[b]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_observation(  # noqa: PLR0913 - scratch arrays are arguments of compiled code
    track: _Track, c: int, t: int, x: Array, scale_m: float, band: Array, right: Array, error: Array, slope: Array
) -> float:
    """Add one camera's observation of one frame; give the share of its weight that the loss leaves.

    ``error`` (2,) and ``slope`` (2, 3) are scratch.
    """
    p, row = track.projections[c], 3 * t
    depth = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3]
    if depth <= 0.05:  # m
        return 0.0
    per_depth = 1.0 / depth
    for axis in range(2):
        projected = (p[axis, 0] * x[0] + p[axis, 1] * x[1] + p[axis, 2] * x[2] + p[axis, 3]) * per_depth
        error[axis] = track.uv_px[c, t, axis] - projected
        for i in range(3):
            slope[axis, i] = (p[axis, i] - projected * p[2, i]) * per_depth
    share = 1.0 / (1.0 + (error[0] ** 2 + error[1] ** 2) / (track.px_per_m[c, t] * scale_m) ** 2)
    precision = track.weight[c, t] * share / SIGMA_PX**2
    for axis in range(2):
        for i in range(3):
            right[row + i] += precision * slope[axis, i] * error[axis]
            for j in range(i + 1):
                band[row + i, i - j] += precision * slope[axis, i] * slope[axis, j]
    return share
