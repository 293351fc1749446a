"""Stage ``kinematics``: the joint angles of every frame, found in two ways that check each other.

The first way takes the smooth points of the lab, one frame after the other, to inverse kinematics. The second fits the body
to the pixels of all cameras over the whole trial. The second is reported where it proves itself; the first is what it starts
from, what it is compared with, and what is reported where it does not.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import keep_markers
from gonio.kernel.body.scaling import scale_model
from gonio.kernel.geometry.cameras import undistort_rig
from gonio.kernel.kinematics.clinical import ClinicalAngle, clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.kernel.kinematics.covariance import add_covariance
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.kernel.kinematics.pixel_priors import TrialPriors, anchor, make_priors
from gonio.kernel.kinematics.pixels import PixelFit, fit_pixels
from gonio.kernel.kinematics.resample import resample
from gonio.kernel.synchronization.looks import thin
from gonio.pipeline.body import SubjectBody, in_marker_order
from gonio.pipeline.findings import finding
from gonio.pipeline.keypoints import look_stride
from gonio.pipeline.moments import Span, longest_stretch, worst_moment
from gonio.pipeline.params import Parameters
from gonio.pipeline.run import Outcome, Progress
from gonio.records import (
    NOT_CONVERGED,
    TOO_FEW_MARKERS,
    BodyModel,
    Finding,
    ImagePoints,
    LabPoints,
    Motion,
    Rig,
    record,
)

LEAST_WEIGHT = 0.1
"""Markers that inverse kinematics weighs less are left out of the fit to the pixels: eyes don't tell of the legs, but each
costs eleven unknowns with four cameras."""

FEWEST_FRAMES = 12
"""With fewer solved frames, there is no movement to fit as a whole."""

LEAST_INLIERS = 0.6
LARGEST_DEPARTURE_SD = 3.0
LARGEST_LEAN_DEG = 45.0
"""What a fit to the pixels must keep to be believed: the share of its observations that it does not reject, how far the
subject's geometry may go from the measured one, and the mean tilt of pelvis and back. Real trials: 0.8, 2, 10 to 25°."""

LARGEST_DIFFERENCE_DEG = 10.0
"""Between the two ways' curves of an angle, root mean square: more than both ways' errors together on good recordings."""


@record
class BodyMotion:
    """The motion that is reported, the body it belongs to, and the two-step motion that it was checked against.

    ``fit`` is what the fit to the pixels says of itself, None where it was not asked for or not possible; ``distrusted``
    says why it is not what is reported, and is empty where it is.
    """

    motion: Motion
    model: BodyModel
    two_step: Motion
    fit: PixelFit | None
    distrusted: str


def fit_motion(
    body: SubjectBody,
    points: LabPoints,
    keypoints: ImagePoints,
    rig: Rig,
    parameters: Parameters,
    progress: Progress | None = None,
) -> Outcome[BodyMotion]:
    """Find the joint angles of every frame in both ways, choose, and judge.

    Args:
        body: The body model in the subject's size.
        points: Smooth tracks in the lab, with covariances.
        keypoints: What the cameras saw, on one clock.
        rig: The cameras, in the same lab.
        parameters: What the request chose.
        progress: Is told the done share.
    """
    two_step = solve_points(body, points)
    looks = thin(keypoints, look_stride(points.timebase.rate_hz, parameters.keypoints.rate))
    enough = min(int(np.isfinite(two_step.values).all(axis=1).sum()), looks.uv_px.shape[1]) >= FEWEST_FRAMES
    if parameters.kinematics.method == "points" or not enough:
        two_step = add_error_bars(two_step, body, points, whole=True)
        found = BodyMotion(motion=two_step, model=body.model, two_step=two_step, fit=None, distrusted="")
        return Outcome(found, judge_motion(two_step))
    telling = keep_markers(body.model, np.flatnonzero(body.tasks.marker_weights >= LEAST_WEIGHT))
    distance_m = _distances_m(rig, points.xyz_lab_m)
    priors = anchor(make_priors(telling, body.markerset, rig, looks.timebase.rate_hz, distance_m), two_step)
    seen = replace(
        looks,
        confidence=np.where(looks.confidence >= parameters.reconstruction.min_confidence, looks.confidence, 0.0),
    )
    fit = _fit_pixels(telling, seen, rig, two_step, priors, progress)
    reason = distrust(fit, priors)
    two_step = add_error_bars(two_step, body, points, whole=bool(reason))
    if reason:
        found = BodyMotion(motion=two_step, model=body.model, two_step=two_step, fit=fit, distrusted=reason)
        return Outcome(found, (*judge_motion(two_step), finding("pixel-fit-distrusted", where=reason)))
    model = personalise(body.model, fit)
    motion = resample(_with_sd_only(fit.motion), two_step.times_s)
    motion = replace(
        motion,
        values=np.where(_never_known(two_step), np.nan, motion.values),
        residual_rms_m=_residual_rms_m(fit.model, motion, in_marker_order(fit.model, points)),
    )
    found = BodyMotion(motion=motion, model=model, two_step=two_step, fit=fit, distrusted="")
    return Outcome(found, (*judge_motion(motion), *cross_check(found)))


def complete(found: BodyMotion) -> Float[np.ndarray, "frame coordinate"]:
    """Give the motion with the coordinates that no keypoint ever tells of at their defaults: what they move weighs little."""
    q = found.motion.values.copy()
    unknown = _never_known(found.motion)
    q[:, unknown] = found.model.coordinates.default[unknown]
    return q


def covariance_of(found: BodyMotion) -> Float[np.ndarray, "frame coordinate coordinate"] | None:
    """Give the covariance of the reported coordinates.

    That of a fit to the pixels is kept at the rate of its looks, and interpolated where it is asked for.
    """
    if found.motion.covariance is not None or found.fit is None:
        return found.motion.covariance
    return resample(found.fit.motion, found.motion.times_s).covariance


def _with_sd_only(motion: Motion) -> Motion:
    if motion.covariance is None:
        return motion
    return replace(motion, covariance=None, sd=np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2)))


def solve_points(body: SubjectBody, points: LabPoints) -> Motion:
    """Find the joint angles of every frame from the smoothed points, one frame after the other."""
    observed = in_marker_order(body.model, points)
    return solve_motion(body.model, body.tasks, observed, points.timebase.times_s(len(observed)))


def add_error_bars(motion: Motion, body: SubjectBody, points: LabPoints, *, whole: bool) -> Motion:
    """Give the motion of :func:`solve_points` with its covariance, or else with the standard deviations only."""
    noise = points.covariance_m2[:, [points.index(name) for name in body.model.markers.names]]
    observed = in_marker_order(body.model, points)
    return add_covariance(motion, body.model, body.tasks, observed, noise, whole=whole)


def _fit_pixels(
    model: BodyModel, keypoints: ImagePoints, rig: Rig, start: Motion, priors: TrialPriors, progress: Progress | None
) -> PixelFit:
    order = [keypoints.keypoint_names.index(name) for name in model.markers.names]
    uv_px = undistort_rig(rig, keypoints.uv_px)[:, :, order]
    first = resample(start, keypoints.timebase.times_s(uv_px.shape[1]))
    return fit_pixels(model, rig, uv_px, keypoints.confidence[:, :, order], first, priors, progress)


def personalise(model: BodyModel, fit: PixelFit) -> BodyModel:
    """Give the whole model, all its markers, the geometry that the fit found with some of them."""
    scaled = scale_model(model, np.repeat(fit.body_factor[:, None], 3, axis=1))
    location = scaled.markers.location_body_m.copy()
    location[[model.markers.index(name) for name in fit.model.markers.names]] = fit.model.markers.location_body_m
    return replace(scaled, markers=replace(scaled.markers, location_body_m=location))


def _distances_m(rig: Rig, xyz_lab_m: Float[np.ndarray, "frame keypoint 3"]) -> Float[np.ndarray, " camera"]:
    """Give how far the subject is from each camera."""
    middle = np.nanmedian(xyz_lab_m, axis=(0, 1))
    return np.array([np.linalg.norm(camera.T_lab_cam[:3, 3] - middle) for camera in rig.cameras])


def _never_known(motion: Motion) -> Bool[np.ndarray, " coordinate"]:
    """Mark the coordinates that no point of the trial told of."""
    return np.asarray(np.isnan(motion.values).all(axis=0))


def _residual_rms_m(
    model: BodyModel, motion: Motion, observed: Float[np.ndarray, "frame marker 3"]
) -> Float[np.ndarray, " frame"]:
    """Give how far the body is from the points in the lab, by frame; NaN where either is unknown."""
    known = np.asarray(np.isfinite(motion.values).all(axis=1))
    q = np.where(known[:, None], motion.values, 0.0)
    squared = ((marker_positions(model, q) - observed) ** 2).sum(axis=-1)
    counts = np.isfinite(squared).sum(axis=1)
    mean = np.nansum(squared, axis=1) / np.maximum(counts, 1)
    return np.where(known & (counts > 0), np.sqrt(mean), np.nan)


def distrust(fit: PixelFit, priors: TrialPriors) -> str:
    """Say why a fit to the pixels can't be believed; empty if it can."""
    if not fit.converged:
        return "it did not converge"
    if fit.inlier_share < LEAST_INLIERS:
        return f"it contradicts {100 * (1 - fit.inlier_share):.0f} % of the observations"
    stretched = np.abs(fit.log_scale) / priors.group_sd
    if stretched.size and stretched.max() > LARGEST_DEPARTURE_SD:
        return f"it changes a segment's length by {100 * np.abs(fit.log_scale)[stretched.argmax()]:.0f} %"
    moved_sd = np.abs(fit.offset_m).max(axis=1) / priors.offset_sd_m
    if moved_sd.max() > LARGEST_DEPARTURE_SD:
        name = fit.model.markers.names[int(moved_sd.argmax())].replace("_", " ")
        return (
            f"it moves the {name} by {1e3 * np.abs(fit.offset_m).max(axis=1)[moved_sd.argmax()]:.0f} mm in its segment"
        )
    for name in ("pelvis_tilt", "lumbar_extension"):
        if name in fit.motion.coordinate_names:
            lean = float(np.degrees(np.nanmean(fit.motion.of(name))))
            if abs(lean) > LARGEST_LEAN_DEG:
                return f"its mean {name.replace('_', ' ')} is {lean:.0f}°"
    return ""


def cross_check(found: BodyMotion) -> tuple[Finding, ...]:
    """Find the angles in which the two ways differ by more than their error bars explain.

    The mean difference is left out: the second way estimates where the keypoints lie in the segments, the first does not.
    """
    findings: list[Finding] = []
    for angle in find_clinical_angles(found.model):
        difference = clinical_deg(found.motion, angle) - clinical_deg(found.two_step, angle)
        known = np.isfinite(difference)
        if known.sum() < FEWEST_FRAMES:
            continue
        apart = difference[known] - difference[known].mean()
        sd = np.hypot(clinical_sd_deg(found.motion, angle), clinical_sd_deg(found.two_step, angle))[known]
        beyond = float((np.abs(apart) > 1.96 * sd).mean())
        rms = float(np.sqrt(np.mean(apart**2)))
        if rms > LARGEST_DIFFERENCE_DEG or (beyond > 0.2 and rms > LARGEST_DIFFERENCE_DEG / 2):
            where = f"{angle.side} {angle.name.replace('_', ' ')}"
            off_deg = np.abs(difference - difference[known].mean())
            span_s = worst_moment(off_deg, found.motion.times_s)
            findings.append(
                finding("kinematics-disagree", where=where, value=rms, span_s=span_s, joint=joint_of(angle))
            )
    return tuple(findings)


def judge_motion(motion: Motion) -> tuple[Finding, ...]:
    """Find what the reader has to know about the body fit."""
    findings: list[Finding] = []
    unsolved = 100 * float((motion.status == TOO_FEW_MARKERS).mean())
    if unsolved > 0:
        severe, span_s = "serious" if unsolved > 50 else None, _longest(motion, TOO_FEW_MARKERS)
        findings.append(finding("frames-unsolved", value=unsolved, severity=severe, span_s=span_s))
    diverged = 100 * float((motion.status == NOT_CONVERGED).mean())
    if diverged > 0:
        findings.append(finding("frames-not-converged", value=diverged, span_s=_longest(motion, NOT_CONVERGED)))
    known = motion.residual_rms_m[np.isfinite(motion.residual_rms_m)]
    if known.size and known.mean() > 0.04:  # good markerless points leave 20 to 30 mm
        severe = "serious" if known.mean() > 0.08 else None
        span_s = worst_moment(motion.residual_rms_m, motion.times_s)
        findings.append(finding("body-fit-poor", value=1e3 * float(known.mean()), severity=severe, span_s=span_s))
    return tuple(findings)


def joint_of(angle: ClinicalAngle) -> str:
    """Give the joint that an angle is of, as findings name it: ``right knee``."""
    return f"{angle.side} {angle.name.split('_')[0]}"


def _longest(motion: Motion, status: int) -> Span | None:
    return longest_stretch(np.asarray(motion.status == status), motion.times_s)
