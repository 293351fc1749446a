"""Fuse what the cameras saw at different moments into one smooth track a keypoint.

Detector errors last for a tenth of a second: frames that are closer than that mostly repeat them, and a track that is
estimated over time from half of the frames is as good as one from all of them. So each keypoint is one maximum a posteriori
problem over the whole trial: robust reprojection errors of all observations, whenever they were made, and a penalty on the
third difference, which leaves constant acceleration alone. Points of frames without any observation follow from their
neighbours in time, within stated limits.

A camera also errs about a keypoint in all frames alike: the detector has its habits from that side, and the calibration left
some error. A track that does not know this jumps where a camera comes in or drops out. So these constant errors are unknown,
too; how large they may be, the trial's own residuals say.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.kernel.parallel import over_blocks
from gonio.kernel.smoothing.correlation import repeats
from gonio.kernel.smoothing.filters import median_filter
from gonio.kernel.triangulation.fusion_track import KEPT, SIGMA_PX, Track, descend
from gonio.records import FILLED, MEASURED, MISSING, LabPoints, record

ROUGH_SCALES_M, SCALES_M = (0.05, 0.03), (0.03, 0.03)
"""Cauchy's scale in the rounds of reweighting, at the point's depth: first without, then with the constant errors.

The start is robust already. Beginning wider (0.15 m, eight rounds) lets a burst of outliers draw a track away from where the
later rounds, which trust what is near, can find back: it made the root mean square error of virtual arms and legs 5 to 44 %
larger, by preset.
"""

AGREE_M = 0.05
"""A camera agrees with a point that it misses by less: the narrowest loss above then leaves it a quarter of its weight."""

JUMP_M, JUMP_TAPS, JUMP_STEP_S = 0.15, 11, 0.05
"""A point that is so far from the median of the half second around it is no start: outliers last for up to a third of one."""

LEAST_BIAS_M, SHARPEST_PX = 1e-4, 0.1
"""Neither constant errors nor the others are ever believed to be smaller than this: exact points must not make the equations
singular."""

LARGEST_BIAS_M = 0.0045
"""Nor are constant errors believed to be larger, at confidence 1: a habit that changes slowly, as the person turns, looks
constant in a short trial; with a looser belief every other look finds other constants. In the covariance they count in full."""

LONGEST_SPAN_S = 0.2
"""Observations that are farther apart leave a gap: the track between them would be invented."""


@record
class FusedTracks:
    """Tracks in the lab, their covariance, and which observations the loss kept.

    ``covariance_m2`` is the posterior's, made as large as the residuals say. ``camera_weight`` is 0 to 1,
    0 where nothing was observed. ``bias_m`` is by how much a camera sees a keypoint off in all frames, right and down in its
    picture, in metres at the keypoint's depth.
    """

    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"]
    camera_weight: Float[np.ndarray, "camera frame keypoint"]
    bias_m: Float[np.ndarray, "camera keypoint 2"]


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
    weight = np.where(np.isfinite(uv_px).all(axis=-1) & (confidence > 0), confidence, 0.0) ** 2
    xyz = _filled(_plausible(start, projections, focal_px, uv_px, weight, rate_hz))
    depth_m = np.einsum("ci,fki->cfk", projections[:, 2, :3], xyz) + projections[:, 2, 3, None, None]
    px_per_m = focal_px[:, None, None] / np.maximum(depth_m, 0.1)
    # One camera's information at the usual distance, spread over three directions, balanced against the penalty at cutoff.
    usual = 2.0 * float(np.nanmedian(px_per_m) ** 2) / SIGMA_PX**2
    stiffness = usual / (2.0 * np.sin(np.pi * min(cutoff_hz, 0.45 * rate_hz) / rate_hz)) ** 6
    seen = np.where(weight[..., None] > 0, uv_px, 0.0)
    count = (weight > 0).sum(axis=1)
    trust = np.where(count, weight.sum(axis=1) / np.maximum(count, 1), 1.0)
    trial = _Trial(projections.astype(float, order="C"), px_per_m, seen, weight, trust, stiffness)
    tracks = _Tracks(
        xyz_lab_m=xyz,
        covariance_m2=np.full((*xyz.shape[:2], 3, 3), np.nan),
        camera_weight=np.zeros(weight.shape),
        bias_m=np.zeros((len(projections), xyz.shape[1], 2)),
    )
    _solve(trial, tracks, ROUGH_SCALES_M)
    _solve(_with_biases(trial, tracks), tracks, SCALES_M)
    return FusedTracks(**tracks._asdict())


class _Tracks(NamedTuple):
    """What :class:`FusedTracks` are made of, as it comes into being."""

    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]
    covariance_m2: Float[np.ndarray, "frame keypoint 3 3"]
    camera_weight: Float[np.ndarray, "camera frame keypoint"]
    bias_m: Float[np.ndarray, "camera keypoint 2"]


class _Trial(NamedTuple):
    """All keypoints' observations: see :class:`gonio.kernel.triangulation.fusion_track.Track`."""

    projections: Float[np.ndarray, "camera 3 4"]
    px_per_m: Float[np.ndarray, "camera frame keypoint"]
    uv_px: Float[np.ndarray, "camera frame keypoint 2"]
    weight: Float[np.ndarray, "camera frame keypoint"]
    trust: Float[np.ndarray, "camera keypoint"]
    stiffness: float
    bias_sd_m: float = 0.0
    spread: float = 1.0
    lasting: float = 1.0
    excess: float = 1.0

    def track(self, keypoint: int) -> Track:
        """Give one keypoint's observations."""
        observed = (self.px_per_m[:, :, keypoint], self.uv_px[:, :, keypoint], self.weight[:, :, keypoint])
        px_per_m, uv_px, weight = map(np.ascontiguousarray, observed)
        trust = np.ascontiguousarray(self.trust[:, keypoint])
        believed = (self.stiffness, self.bias_sd_m, self.spread, self.lasting, self.excess)
        return Track(self.projections, px_per_m, uv_px, weight, trust, *believed)


def _solve(trial: _Trial, tracks: _Tracks, scales_m: tuple[float, ...]) -> None:
    """Go on with all tracks, in place; where constant errors are unknown, with those, and covariances."""
    scales = np.array(scales_m)

    def solve(first: int, last: int) -> None:
        for k in range(first, last):
            if not np.isfinite(tracks.xyz_lab_m[:, k]).all():
                continue
            track = trial.track(k)
            xyz, bias_m = np.ascontiguousarray(tracks.xyz_lab_m[:, k]), np.ascontiguousarray(tracks.bias_m[:, k])
            xyz, bias_m, kept, covariance_m2 = descend(track, xyz, bias_m, scales)
            tracks.xyz_lab_m[:, k], tracks.covariance_m2[:, k] = xyz, covariance_m2
            tracks.camera_weight[:, :, k], tracks.bias_m[:, k] = kept, bias_m

    over_blocks(solve, tracks.xyz_lab_m.shape[1], 4)


def _with_biases(trial: _Trial, tracks: _Tracks) -> _Trial:
    """Find from tracks that know nothing of constant errors how large those are, and how long the others last.

    The constant errors' spread is that of the residuals' means, less what those would vary by without them. A track goes
    along with three of the means' degrees of freedom, which are two for each camera.
    """
    kept = tracks.camera_weight > KEPT
    inlier = kept & (kept.sum(axis=0) >= 2)
    homogeneous = tracks.xyz_lab_m @ trial.projections[:, None, :, :3].swapaxes(-2, -1)
    homogeneous += trial.projections[:, None, None, :, 3]
    # In standard deviations: the errors, and how much of them a constant error of 1 m would be.
    slope = np.where(inlier, np.sqrt(trial.weight) / SIGMA_PX, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = (trial.uv_px - homogeneous[..., :2] / homogeneous[..., 2:]) * slope[..., None]
    error, slope = np.where(inlier[..., None], error, 0.0), slope * trial.px_per_m
    information = (slope**2).sum(axis=1)
    seen = information > 0
    if not seen.any():
        return trial._replace(bias_sd_m=LEAST_BIAS_M)
    mean_m = (slope[..., None] * error).sum(axis=1) / np.where(seen, information, 1.0)[..., None]
    left = error - slope[..., None] * mean_m[:, None]
    lasting = repeats(left, inlier)
    level = float(np.median((left[inlier] ** 2).sum(axis=-1))) / 1.386
    excess = lasting * max(level, (SHARPEST_PX / SIGMA_PX) ** 2)
    # By how many cameras: those that look at other moments see the same track.
    known = seen.any(axis=0)
    cameras = (information.sum(axis=0)[known] ** 2 / (information**2).sum(axis=0)[known]).mean()
    freedom = max(2.0 * float(cameras), 4.0)
    variances_m2 = (mean_m[seen] ** 2).mean(axis=-1) - excess / information[seen]
    variance_m2 = float(np.mean(variances_m2 * trial.trust[seen]))
    spread_m = np.sqrt(max(variance_m2 * freedom / (freedom - 3.0), LEAST_BIAS_M**2))
    bias_sd_m = min(spread_m, LARGEST_BIAS_M)
    return trial._replace(bias_sd_m=bias_sd_m, spread=spread_m / bias_sd_m, lasting=lasting, excess=excess)


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
