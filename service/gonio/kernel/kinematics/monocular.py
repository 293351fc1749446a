"""Motion from one camera's keypoints: where the body is to begin with, and the whole-trial fit from there.

One camera sees directions only. What makes metres of them: the camera's own place over the floor, feet that stand on it, and
a body whose stature is known. The fit itself is that of several cameras (:mod:`gonio.kernel.kinematics.pixels`): one body,
whose segments keep their length, that moves smoothly and bends its joints within their ranges.

What no fit can see is movement along the line of sight. From the side the covariance of the fit is right. From the front a
limb that points towards the camera and one that points away look alike, the fit finds one of several bodies, and its
covariance knows of that one only: :func:`widen` adds what the view hides.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gonio.errors import CaptureError
from gonio.kernel.body.forward import couple, marker_positions
from gonio.kernel.kinematics.floor import Standing, feet_of, find_standing
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.kernel.kinematics.pixel_priors import BIAS_M, MOMENT_S, TRUNK_OFFSET_M, TrialPriors
from gonio.kernel.kinematics.pixels import MIN_CONFIDENCE, PixelFit, fit_pixels
from gonio.records import NOT_CONVERGED, SOLVED, BodyModel, Camera, Motion, Rig, Tasks

HEADING_S = 0.5
"""Feet are put on the floor where they hardly move; how far the body is from the camera changes no faster than in this time."""

LEAST_ACROSS = 0.35
"""Sine of the angle between a ray and the body's sagittal plane, from which their intersection is used: 20°."""

POSTURE_DEG = {"pelvis_tilt": 6.0, "lumbar_extension": 8.0}
"""Standard deviation of the trial's mean about upright posture, where no second camera tells of it: between walkers."""


LENGTH_SCALE = 0.05
"""Every length is known from the stature only, the trunk's too: standard deviation of a segment's share in it."""


WIDTH_OFFSET_M = 0.01
"""Nor was the width of hips and shoulders measured: standard deviation of their keypoints' places."""


HIDDEN_LIMB_DEG = 60.0
"""How far a joint is from its default at any moment, one standard deviation: a limb that the body hides for a while has nothing
else to hold it, and the descent would turn it round and round."""


HIDDEN_FROM_RAD = np.deg2rad(65.0)
"""From this view angle on, the sagittal plane is foreshortened so much that the fit may end in a mirrored limb."""

HIDDEN_SD_DEG = {
    "hip_flexion": 15.0,
    "knee_angle": 15.0,
    "ankle_angle": 10.0,
    "pelvis_tilt": 8.0,
    "lumbar_extension": 8.0,
}
"""What is then not known: about how far these angles move in walking, one standard deviation."""


MOST_DESCENTS = 4
SETTLED_SD = 0.2
"""Two descents that end closer than this found the same body: it adds 2 % to a standard deviation."""


class Scatter(NamedTuple):
    """How far a detector's keypoints are off, new in each frame or for a while; what stays for good is the priors' affair.

    Standard deviation at confidence 1, at the subject; the share of its variance that is new in each frame; and how long the
    rest takes to die away. By default what was measured on a real recording (docs/validation/virtual-lab.md): one camera
    can't measure it, since to its fit an error that lasts looks like movement.
    """

    sd_m: float = 0.0059
    white: float = 0.24
    lasts_s: float = 0.105

    def lasting_sd_m(self, rate_hz: float) -> float:
        """Give the error of a frame that would tell as little of what is slow if it were new in every frame."""
        stays = np.exp(-1.0 / (rate_hz * self.lasts_s))
        return self.sd_m * float(np.sqrt(self.white + (1.0 - self.white) * (1.0 + stays) / (1.0 - stays)))


REAL_SCATTER = Scatter()


class OneCameraFit(NamedTuple):
    """A fit to one camera's keypoints, and what it said of the floor before that was believed."""

    fit: PixelFit
    standing: Standing


class Placement(NamedTuple):
    """Where the body is, roughly: the middle of the hips, and where the body faces (horizontal, unit)."""

    hips_lab_m: Float[np.ndarray, "frame 3"]
    forward_lab: Float[np.ndarray, "3"]


def fit_one_camera(
    model: BodyModel,
    camera: Camera,
    uv_px: Float[np.ndarray, "frame marker 2"],
    confidence: Float[np.ndarray, "frame marker"],
    start: Motion,
    priors: TrialPriors,
    on_progress: Callable[[float], None] | None = None,
) -> OneCameraFit:
    """Fit a body to one camera's keypoints: first without the floor, then, if its feet stand there, with it.

    Args:
        model: The body in the subject's stature; its markers are the keypoints.
        camera: The camera, in a lab whose floor is the plane y = 0.
        uv_px: Undistorted keypoints in the order of the markers; NaN is missing.
        confidence: Theirs.
        start: Where to begin (:func:`start_one_camera`).
        priors: As :func:`believe_less` gives them.
        on_progress: Is told the done share, 0 to 1.

    Returns:
        The fit, in which everything that goes by cameras has this one camera, and whether its feet were on the floor.
    """
    rig = Rig(cameras=(camera,), source="one camera")
    report = _Halves(on_progress)

    def descend(begin: Motion | PixelFit, resting_m: Float[np.ndarray, "frame marker"] | None) -> PixelFit:
        def once(first: Motion | PixelFit) -> PixelFit:
            return fit_pixels(model, rig, uv_px[None], confidence[None], first, priors, report, resting_m)

        return _come_to_rest(once, begin)

    free = descend(start, None)
    standing = find_standing(free.model, free.motion, *feet_of(model))
    if not standing.is_on_floor:
        return OneCameraFit(free, standing)
    report.half = 1
    fit = descend(free, standing.resting_m)
    # What goes by cameras has the floor as its last.
    fit = replace(fit, bias_px=fit.bias_px[:1], sigma_px=fit.sigma_px[:1], swapped=fit.swapped[:1])
    return OneCameraFit(fit, standing)


class _Halves:
    """Tells the share of two equal halves as one that never falls."""

    def __init__(self, report: Callable[[float], None] | None) -> None:
        self._report, self._told, self.half = report, 0.0, 0

    def __call__(self, share: float) -> None:
        """Take the share of the present half."""
        self._told = max(self._told, (self.half + share) / 2)
        if self._report is not None:
            self._report(self._told)


def _come_to_rest(descend: Callable[[Motion | PixelFit], PixelFit], start: Motion | PixelFit) -> PixelFit:
    """Descend until another descent hardly moves the body.

    Depth and size together are a long shallow valley, in which the descent creeps: it has come to rest where another one,
    from where the last stopped, hardly moves the body any more.
    """
    fit = descend(start)
    for _ in range(MOST_DESCENTS - 1):
        if fit.converged:
            break
        last, fit = fit, descend(fit)
        if not fit.converged and _moved_sd(last.motion, fit.motion) < SETTLED_SD:
            status = np.where(fit.motion.status == NOT_CONVERGED, SOLVED, fit.motion.status).astype(np.uint8)
            fit = replace(fit, converged=True, motion=replace(fit.motion, status=status))
    return fit


def _moved_sd(first: Motion, second: Motion) -> float:
    """Give how far two motions of one trial are apart, root mean square, in standard deviations of the second."""
    assert second.covariance is not None  # a fit to pixels always has one
    variance = np.diagonal(second.covariance, axis1=1, axis2=2)
    squared = np.square(second.values - first.values)
    told = np.isfinite(squared) & (variance > 0)
    return float(np.sqrt(np.mean(squared[told] / variance[told]))) if told.any() else np.inf


def start_one_camera(
    model: BodyModel,
    tasks: Tasks,
    camera: Camera,
    uv_px: Float[np.ndarray, "frame marker 2"],
    confidence: Float[np.ndarray, "frame marker"],
    times_s: Float[np.ndarray, " frame"],
) -> tuple[Motion, Placement]:
    """Find a first motion: each keypoint is put on its ray where a body that stands at the feet's place would have it.

    A ray that crosses the body's sagittal planes is cut with the plane in which its keypoint moves; one that runs along them
    is cut at the depth of the keypoint of an upright body. The points then go to inverse kinematics.

    Args:
        model: The body in the subject's stature; its markers are the keypoints.
        tasks: How inverse kinematics weighs them.
        camera: The camera, in a lab whose floor is the plane y = 0.
        uv_px: Undistorted keypoints in the order of the markers; NaN is missing.
        confidence: Theirs; below 0.3 a keypoint is not used.
        times_s: When the pictures were taken, in equal steps.

    Raises:
        CaptureError: ``monocular-no-start``: hips and feet are never seen together, or the feet are not on the floor.
    """
    used = np.isfinite(uv_px).all(axis=-1) & (confidence >= MIN_CONFIDENCE)
    rays = _rays(camera, np.where(used[..., None], uv_px, np.nan))
    placement = place_body(model, camera, rays, 1.0 / float(np.median(np.diff(times_s))))
    forward = placement.forward_lab
    right = np.cross(forward, [0.0, 1.0, 0.0])
    upright = marker_positions(model, couple(model, model.coordinates.default[None]))[0]
    from_hips = upright - upright[_hips(model)].mean(axis=0)
    axes = np.stack([forward, [0.0, 1.0, 0.0], right])
    expected = placement.hips_lab_m[:, None] + from_hips @ axes
    centre = camera.centre_lab_m
    across = rays @ right
    with np.errstate(divide="ignore", invalid="ignore"):
        to_plane_m = ((expected - centre) @ right) / across
        looks = camera.T_lab_cam[:3, 2]
        to_depth_m = ((expected - centre) @ looks) / (rays @ looks)
    along_m = np.where((np.abs(across) > LEAST_ACROSS) & (to_plane_m > 0), to_plane_m, to_depth_m)
    points = centre + along_m[..., None] * rays
    return solve_motion(model, tasks, points, times_s), placement


def place_body(
    model: BodyModel, camera: Camera, rays: Float[np.ndarray, "frame marker 3"], rate_hz: float
) -> Placement:
    """Find where the body is and where it faces from where its feet seem to be on the floor.

    A foot that is off the floor seems to be behind where it is, and fast. So what seems slow counts most, and the depth of
    the hips follows the feet's slowly.

    Args:
        model: The body; its markers are the keypoints.
        camera: The camera.
        rays: Unit directions of the keypoints in the lab; NaN is missing.
        rate_hz: The pictures' rate.

    Raises:
        CaptureError: ``monocular-no-start``.
    """
    feet, rest_m = feet_of(model)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_floor_m = (rest_m - camera.centre_lab_m[1]) / rays[:, feet, 1]
    to_floor_m[~(to_floor_m > 0)] = np.nan
    on_floor = camera.centre_lab_m + to_floor_m[..., None] * rays[:, feet]
    speed_m_s = np.linalg.norm(np.gradient(on_floor, axis=0), axis=-1) * rate_hz
    weight = np.where(np.isfinite(speed_m_s), 1.0 / (np.square(speed_m_s) + 0.2**2), 0.0)
    hips = rays[:, _hips(model)].mean(axis=1)
    usable = (weight.sum(axis=1) > 0) & np.isfinite(hips).all(axis=1)
    if usable.sum() < 3:
        raise CaptureError(
            "Where the subject stands is not known: hips and feet are hardly ever seen together, or the calibration has the "
            "feet above the camera's horizon.",
            hint="Film the whole person, feet included, and check that the calibration's floor is y = 0 and its Y axis up.",
            code="monocular-no-start",
        )
    place = np.nansum(weight[..., None] * on_floor, axis=1) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    looks = camera.T_lab_cam[:3, 2]
    depth_m = _smooth(np.where(usable, (place - camera.centre_lab_m) @ looks, np.nan), rate_hz * HEADING_S)
    frames = np.arange(len(rays))
    middle = np.stack([np.interp(frames, frames[usable], hips[usable, axis]) for axis in range(3)], axis=1)
    hips_lab_m = camera.centre_lab_m + middle * (depth_m / (middle @ looks))[:, None]
    return Placement(hips_lab_m, _forward(model, feet, on_floor, weight, hips_lab_m))


def view_angle_rad(camera: Camera, placement: Placement) -> float:
    """Give the angle between the line of sight and the body's right-left axis: 0 is from the side, π/2 from front or back."""
    sight = np.median(placement.hips_lab_m, axis=0) - camera.centre_lab_m
    sight[1] = 0.0
    share = abs(float(sight @ placement.forward_lab)) / max(float(np.linalg.norm(sight)), 1e-9)
    return float(np.arcsin(min(share, 1.0)))


def widen(motion: Motion, view_rad: float) -> Motion:
    """Add to a fit's covariance what its view hides, above :data:`HIDDEN_FROM_RAD`; up to there it stays as it is."""
    if motion.covariance is None or view_rad < HIDDEN_FROM_RAD:
        return motion
    covariance = motion.covariance.copy()
    for index, name in enumerate(motion.coordinate_names):
        sd_deg = next((sd for stem, sd in HIDDEN_SD_DEG.items() if name.startswith(stem)), 0.0)
        covariance[:, index, index] += np.deg2rad(sd_deg) ** 2
    return replace(motion, covariance=covariance)


def _forward(
    model: BodyModel,
    feet: Int[np.ndarray, " foot_marker"],
    on_floor: Float[np.ndarray, "frame foot_marker 3"],
    weight: Float[np.ndarray, "frame foot_marker"],
    hips_lab_m: Float[np.ndarray, "frame 3"],
) -> Float[np.ndarray, "3"]:
    """Find where the body faces: from heels to toes of standing feet; without them, where it goes."""
    names = [model.markers.names[i] for i in feet]
    total = np.zeros(3)
    for heel, name in enumerate(names):
        if "heel" not in name:
            continue
        toe_names = (name.replace("heel", toe) for toe in ("foot_index", "big_toe"))
        toe = next((names.index(other) for other in toe_names if other in names), None)
        if toe is None:
            continue
        both = np.minimum(weight[:, heel], weight[:, toe])
        vector = on_floor[:, toe] - on_floor[:, heel]
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        total += np.nansum(both[:, None] * vector / np.maximum(length, 1e-9), axis=0)
    if not np.any(total):
        total = hips_lab_m[-1] - hips_lab_m[0]
    total[1] = 0.0
    return total / max(float(np.linalg.norm(total)), 1e-12) if np.any(total) else np.array([1.0, 0.0, 0.0])


def _rays(camera: Camera, uv_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    """Give the unit directions of undistorted picture points in the lab."""
    homogeneous = np.concatenate([uv_px, np.ones((*uv_px.shape[:-1], 1))], axis=-1)
    rays = homogeneous @ np.linalg.inv(camera.intrinsic_px).T @ camera.T_lab_cam[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _smooth(values: Float[np.ndarray, " frame"], sigma_frames: float) -> Float[np.ndarray, " frame"]:
    """Fit a straight line around each frame, with a Gaussian's weights; NaN doesn't count. A walk's depth is no constant."""
    frames = np.arange(len(values), dtype=float)
    known = np.isfinite(values)
    ahead = frames[known] - frames[:, None]
    weight = np.exp(-0.5 * (ahead / max(sigma_frames, 1.0)) ** 2) + 1e-9
    s0, s1, s2 = weight.sum(axis=1), (weight * ahead).sum(axis=1), (weight * ahead**2).sum(axis=1)
    t0, t1 = weight @ values[known], (weight * ahead) @ values[known]
    return (s2 * t0 - s1 * t1) / np.maximum(s0 * s2 - s1**2, 1e-12)


def _hips(model: BodyModel) -> list[int]:
    return [model.markers.index("right_hip"), model.markers.index("left_hip")]


def believe_less(model: BodyModel, priors: TrialPriors, rate_hz: float, scatter: Scatter = REAL_SCATTER) -> TrialPriors:
    """Believe less of lengths and widths, and of the keypoints what one camera can't see of their errors.

    What one camera hardly tells is held near upright (:data:`POSTURE_DEG`). ``priors`` are those of
    :func:`gonio.kernel.kinematics.pixel_priors.make_priors` for a rig of this camera, ``rate_hz`` the keypoints'. Whoever
    judges the fit must judge it by what was believed.
    """
    posture_sd = priors.posture_sd.copy()
    for name, sd_deg in POSTURE_DEG.items():
        if name in model.coordinates.names:
            posture_sd[model.coordinates.names.index(name)] = np.deg2rad(sd_deg)
    joint = model.coordinates.rotational & ~np.array([name.startswith("pelvis") for name in model.coordinates.names])
    hidden_sd = np.deg2rad(HIDDEN_LIMB_DEG) * np.sqrt(max(MOMENT_S * rate_hz, 1.0))
    px_per_m = float(priors.bias_sd_px.mean()) / BIAS_M
    return replace(
        priors,
        posture_sd=posture_sd,
        moment_sd=np.where(joint, np.minimum(priors.moment_sd, hidden_sd), priors.moment_sd),
        group_sd=np.maximum(priors.group_sd, LENGTH_SCALE),
        offset_sd_m=np.where(priors.offset_sd_m <= TRUNK_OFFSET_M, WIDTH_OFFSET_M, priors.offset_sd_m),
        noise_px=scatter.lasting_sd_m(rate_hz) * px_per_m,
    )
