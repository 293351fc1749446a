"""Find the camera that was moved while it recorded.

A tripod that is knocked shifts everything that camera sees, at one moment and for good. Just before and just after that
moment the person stands at nearly the same place, so that nothing but the camera explains the step: neither a calibration
that is off, nor a keypoint network that sees a joint elsewhere from behind, nor a late clock steps so.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.lib.stride_tricks import sliding_window_view

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.triangulation.points import triangulate
from gonio.records import ImagePoints, Rig, record

SAMPLE_HZ = 10.0
"""Frames closer than 0.1 s repeat the same detector errors."""

WINDOW_S = 0.5
"""The medians of this long before and after a moment are compared."""

LASTING_S = 1.5
"""A camera that was moved stays so: half of the step must still be there between windows this long."""

SMALLEST_STEP_M = 0.04
"""Half a degree at 5 m. Against what the others see, the step of a camera that stands still reaches 30 mm where few see."""

TIMES_USUAL = 3.0
"""The step must be this many times the lower quartile of what that camera's residuals change by in the trial."""

CLEARLY = 0.6
"""Leaving out the right camera must leave less than this share of the step that leaving out any other one leaves."""

FEWEST_KEYPOINTS = 8
SCALE_M = 0.03  # of Cauchy's loss over the keypoints: one that is on the wrong leg for a while does not count


@record
class Movement:
    """A camera that was moved.

    ``cameras`` holds its position in the rig; more than one where the geometry can't tell which of them it was. The movement
    happened between the frames ``frame`` − ``unsure_frames`` and ``frame`` + ``unsure_frames``. ``step_m`` is by how
    much everything it sees jumped, at the person. ``keep_before`` says which side of the movement agrees
    better with the calibration.
    """

    cameras: tuple[int, ...]
    frame: int
    unsure_frames: int
    step_m: float
    keep_before: bool


class _Trial(NamedTuple):
    """A sample of the trial's frames, undistorted."""

    rig: Rig
    uv_px: Float[np.ndarray, "camera frame keypoint 2"]
    weight: Float[np.ndarray, "camera frame keypoint"]
    rate_hz: float


def find_movement(rig: Rig, keypoints: ImagePoints, min_confidence: float) -> Movement | None:
    """Find the camera that was moved most, and when; None if all stood still.

    The first and the last half second of the trial are not searched. With two cameras it can be seen that one was moved, but
    not which.

    Args:
        rig: The calibrated cameras.
        keypoints: The person's keypoints, synchronous.
        min_confidence: Keypoints below it are not looked at.
    """
    stride = keypoints.stride * max(1, round(keypoints.timebase.rate_hz / keypoints.stride / SAMPLE_HZ))
    confidence = keypoints.confidence[:, ::stride]
    trial = _Trial(
        rig=rig,
        uv_px=undistort_rig(rig, keypoints.uv_px[:, ::stride]),
        weight=np.where(confidence >= min_confidence, confidence, 0.0),
        rate_hz=keypoints.timebase.rate_hz / stride,
    )
    reach = round(WINDOW_S * trial.rate_hz)
    if reach < 3 or confidence.shape[1] < 3 * reach:
        return None
    residual_m = _misses_m(trial)
    found = _largest_lasting_step(trial, residual_m, reach)
    if found is None:
        return None
    first, step_m = found
    around = slice(first - reach, first + reach)
    moved = _moved(trial._replace(uv_px=trial.uv_px[:, around], weight=trial.weight[:, around]))
    before_m, after_m = (_median_m(residual_m[moved[0], side]) for side in (slice(0, first), slice(first, None)))
    return Movement(
        cameras=moved,
        frame=first * stride,
        unsure_frames=2 * stride,
        step_m=step_m,
        keep_before=before_m <= after_m,
    )


def _largest_lasting_step(
    trial: _Trial, residual_m: Float[np.ndarray, "camera frame keypoint 2"], reach: int
) -> tuple[int, float] | None:
    """Give the first sampled frame after the largest step that stays, and its size in metres."""
    frames = residual_m.shape[1]
    step_m = _steps_m(residual_m, trial.uv_px, reach)
    known = np.isfinite(step_m)
    usual_m = np.array([np.percentile(s[k], 25) if k.any() else np.inf for s, k in zip(step_m.T, known.T, strict=True)])
    telling = np.where(known & (step_m > np.maximum(SMALLEST_STEP_M, TIMES_USUAL * usual_m)), step_m, 0.0)
    while telling.any():
        at, camera = (int(i) for i in np.unravel_index(np.argmax(telling), telling.shape))
        first = at + reach
        lasting = min(round(LASTING_S * trial.rate_hz), first, frames - first)
        around = slice(first - lasting, first + lasting)
        stays_m = _steps_m(residual_m[:, around], trial.uv_px[:, around], lasting)[0, camera]
        if stays_m > step_m[at, camera] / 2:
            return first, float(step_m[at, camera])
        telling[max(at - reach, 0) : at + reach, camera] = 0.0
    return None


def _moved(around: _Trial) -> tuple[int, ...]:
    """Name the camera without which the others step least; all of them if another explains nearly as much."""
    everyone = tuple(range(len(around.rig.cameras)))
    if len(everyone) < 3:
        return everyone
    rest_m = np.full(len(everyone), np.inf)
    reach = around.weight.shape[1] // 2
    for camera in everyone:
        others = [c for c in everyone if c != camera]
        step_m = _steps_m(_residuals_m(around, others)[others], around.uv_px[others], reach)[0]
        if np.isfinite(step_m).any():
            rest_m[camera] = np.nanmax(step_m)
    best, second = np.argsort(rest_m)[:2]
    return (int(best),) if rest_m[best] < CLEARLY * rest_m[second] else everyone


def _misses_m(trial: _Trial) -> Float[np.ndarray, "camera frame keypoint 2"]:
    """Give how far each camera misses the points that the other cameras see; with two cameras, that both see."""
    count = len(trial.rig.cameras)
    if count < 3:
        return _residuals_m(trial, tuple(range(count)))
    return np.stack(
        [_residuals_m(trial, tuple(c for c in range(count) if c != camera))[camera] for camera in range(count)]
    )


def _residuals_m(trial: _Trial, cameras: Sequence[int]) -> Float[np.ndarray, "camera frame keypoint 2"]:
    """Give the residuals, in the lab, of all cameras to what least squares find from some of them; NaN: not seen."""
    weight = np.zeros_like(trial.weight)
    weight[list(cameras)] = trial.weight[list(cameras)]
    count, projections, focal_px = len(weight), projection_matrices(trial.rig), focal_lengths_px(trial.rig)
    pixels = trial.uv_px.reshape(count, -1, 2)
    solved = triangulate(projections, focal_px, pixels, weight.reshape(count, -1), method="reprojection")
    homogeneous = np.einsum("cij,pj->cpi", projections[..., :3], solved.xyz_lab_m) + projections[:, None, :, 3]
    depth_m = homogeneous[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        residual_px = np.where(depth_m > 0, pixels - homogeneous[..., :2] / depth_m, np.nan)
    residual_m = np.where(
        trial.weight.reshape(count, -1, 1) > 0, residual_px * depth_m / focal_px[:, None, None], np.nan
    )
    return residual_m.reshape(trial.uv_px.shape)


def _steps_m(
    residual_m: Float[np.ndarray, "camera frame keypoint 2"],
    uv_px: Float[np.ndarray, "camera frame keypoint 2"],
    reach: int,
) -> Float[np.ndarray, "moment camera"]:
    """Give the step of each camera's residuals at each moment, as far as a movement of that camera explains it.

    The medians of ``reach`` frames before and after each moment are compared, from frame ``reach`` on. A movement shifts,
    turns and scales what the camera sees, all keypoints together: the keypoints' steps are fitted by ``shift + turn · place``
    (complex numbers, Cauchy's loss), and the fit's root mean square is given. NaN without enough keypoints.
    """
    residual, place = (_medians(values[..., 0] + 1j * values[..., 1], reach) for values in (residual_m, uv_px))
    step, place = residual[reach:] - residual[:-reach], (place[reach:] + place[:-reach]) / 2
    known = np.isfinite(step) & np.isfinite(place)
    step, place, weight = np.where(known, step, 0.0), np.where(known, place, 0.0), known.astype(float)
    fitted = np.zeros_like(step)
    for _ in range(5):
        weight = known / (1.0 + np.abs(step - fitted) ** 2 / SCALE_M**2)
        total = np.maximum(weight.sum(axis=-1, keepdims=True), 1e-12)
        centre, shift = ((weight * values).sum(axis=-1, keepdims=True) / total for values in (place, step))
        arm = place - centre
        spread = np.maximum((weight * np.abs(arm) ** 2).sum(axis=-1, keepdims=True), 1e-12)
        fitted = shift + (weight * arm.conj() * step).sum(axis=-1, keepdims=True) / spread * arm
    count = known.sum(axis=-1)
    squared = np.where(known, np.abs(fitted) ** 2, 0.0).sum(axis=-1) / np.maximum(count, 1)
    return np.where(count >= FEWEST_KEYPOINTS, np.sqrt(squared), np.nan)


def _medians(
    values: Complex[np.ndarray, "camera frame keypoint"], width: int
) -> Complex[np.ndarray, "window camera keypoint"]:
    """Give the medians of the known values over all windows of frames, real and imaginary part each; NaN without three."""
    windows = sliding_window_view(values, width, axis=1)
    known = np.isfinite(windows).sum(axis=-1) >= 3
    padded = np.where(known[..., None], windows, 0.0)
    median = np.nanmedian(np.real(padded), axis=-1) + 1j * np.nanmedian(np.imag(padded), axis=-1)
    return np.where(known, median, np.nan).swapaxes(0, 1)


def _median_m(residual_m: Float[np.ndarray, "frame keypoint 2"]) -> float:
    """Give the median length of the known residuals; infinite if there are none."""
    known = residual_m[np.isfinite(residual_m[..., 0])]
    return float(np.median(np.linalg.norm(known, axis=-1))) if len(known) else np.inf
