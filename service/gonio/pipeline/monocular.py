"""The river for a person filmed by one camera, from what was uploaded to the same report. Read it from top to bottom."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gonio.errors import CaptureError, InputError
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, keep_markers, make_tasks
from gonio.kernel.body.scaling import scale_model
from gonio.kernel.calibration.person import unrefined
from gonio.kernel.geometry.cameras import project, undistort_rig
from gonio.kernel.geometry.transforms import rotation_about_y, transform
from gonio.kernel.kinematics.clinical import clinical_sd_deg, find_clinical_angles
from gonio.kernel.kinematics.covariance import place_covariance_m2
from gonio.kernel.kinematics.floor import Standing
from gonio.kernel.kinematics.monocular import (
    REAL_SCATTER,
    OneCameraFit,
    Placement,
    Scatter,
    believe_less,
    fit_one_camera,
    start_one_camera,
    view_angle_rad,
    widen,
)
from gonio.kernel.kinematics.pixel_priors import TrialPriors, make_priors
from gonio.kernel.kinematics.pixels import PixelFit
from gonio.kernel.kinematics.resample import resample
from gonio.kernel.synchronization.delays import trusted
from gonio.kernel.synchronization.looks import thin
from gonio.kernel.triangulation.one_camera import follow_people
from gonio.pipeline.album import Album
from gonio.pipeline.body import SubjectBody, choose_markerset, only_file
from gonio.pipeline.capture import match_videos, read_capture, read_rig
from gonio.pipeline.describe import Analysis
from gonio.pipeline.dynamics import find_joint_torques, moment_curves
from gonio.pipeline.findings import finding
from gonio.pipeline.forces import choose_coefficients, find_forces
from gonio.pipeline.gait import analyse_gait
from gonio.pipeline.keypoints import (
    DETECTOR,
    MIN_VISIBILITY,
    Keypoints,
    look_at_videos,
    look_stride,
    lost_subject,
    read_sightings,
)
from gonio.pipeline.moments import worst_moment
from gonio.pipeline.motion import FEWEST_FRAMES, LEAST_WEIGHT, BodyMotion, distrust, joint_of, judge_motion, personalise
from gonio.pipeline.params import Parameters, Subject, parse_parameters, with_file_defaults
from gonio.pipeline.pressure import measure_forces, read_sensors
from gonio.pipeline.reconstruction import Reconstruction
from gonio.pipeline.report import write_report
from gonio.pipeline.run import CaptureFile, Outcome, Progress, ReportFiles, StageRunner
from gonio.records import (
    FILLED,
    MEASURED,
    MISSING,
    BodyModel,
    Camera,
    Capture,
    Finding,
    ImagePoints,
    LabPoints,
    Rig,
    record,
)
from gonio.resources import models_dir
from gonio.vision.people import leaf_through

MONOCULAR_SHARES: Mapping[str, float] = MappingProxyType(
    {
        "calibration": 0.01,
        "capture": 0.01,
        "sensors": 0.005,
        "keypoints": 0.82,
        "scaling": 0.01,
        "kinematics": 0.1,
        "pressure": 0.005,
        "forces": 0.005,
        "dynamics": 0.005,
        "gait": 0.01,
        "report": 0.02,
    }
)
"""Each stage's share of the wall time, in order."""

UNRELIABLE_SD_DEG = {"hip_flexion": 8.0, "knee_flexion": 6.0, "ankle_dorsiflexion": 8.0}
"""An angle whose standard deviation is larger, in a usual frame, is marked as not measured."""


@record
class OneView:
    """The motion, what it says of each keypoint, and the camera, in a lab in which the subject heads towards +X."""

    rig: Rig
    motion: BodyMotion
    raw: Reconstruction
    view_rad: float


def analyse_one_camera(
    capture_files: Sequence[CaptureFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> ReportFiles:
    """Compute a gait report from one camera's video, or the keypoints that another program found in it.

    Args:
        capture_files: The video or the keypoints, the calibration of its camera (which may hold others), and whatever else a
            session of several cameras may have.
        parameters: What the request chose (:class:`gonio.pipeline.params.Parameters`).
        runner: Runs the stages; keeps what they give, where that is its job.
        output_dir: Where the report's files go.

    Raises:
        InputError: A file or a parameter is wrong.
        CaptureError: The recording can't give the answer.
        ResourceError: Weights are missing.
    """
    chosen = with_file_defaults(parse_parameters(parameters), parameters, capture_files)
    coefficients = choose_coefficients(capture_files)
    output_dir.mkdir(parents=True, exist_ok=True)

    rig = runner("calibration", lambda _: read_camera(capture_files))
    capture = runner("capture", lambda _: read_capture(capture_files, rig, chosen.keypoints.rate_hz, fewest=1))
    sensors = runner("sensors", lambda _: read_sensors(capture_files, capture.frame_count / capture.timebase.rate_hz))
    keypoints = runner("keypoints", lambda progress: find_subject(capture, chosen, output_dir, progress))
    body = runner("scaling", lambda _: scale_to_stature(keypoints.points, chosen.subject, capture_files))
    seen = runner("kinematics", lambda progress: fit_view(body, keypoints.points, capture.rig, chosen, progress))
    motion = seen.motion
    measured = runner("pressure", lambda _: measure_forces(sensors, motion, chosen, seen.raw.R_lab_calibrated))
    forces = runner("forces", lambda _: find_forces(motion, measured, chosen, coefficients))
    torques = runner("dynamics", lambda _: find_joint_torques(motion, measured, forces, chosen, coefficients))
    moments = moment_curves(motion, torques)
    gait = runner("gait", lambda _: analyse_gait(motion, seen.raw.points.timebase, measured, moments))

    analysis = Analysis(
        files=tuple(capture_files),
        parameters=chosen,
        capture=capture,
        keypoints=keypoints,
        synchronization=trusted(capture.rig),
        refinement=unrefined(capture.rig),
        raw=seen.raw,
        tracks=seen.raw.points,
        points=seen.raw.points,
        body=body,
        motion=motion,
        measured=measured,
        coefficients=coefficients,
        forces=forces,
        torques=torques,
        gait=gait,
    )
    return runner("report", lambda _: Outcome(write_report(analysis, runner.findings, output_dir)))


def read_camera(files: Sequence[CaptureFile]) -> Outcome[Rig]:
    """Read the calibration, and leave the one camera in it that filmed.

    Raises:
        InputError: ``too-many-videos`` where several did, or what reading the calibration says.
    """
    read = read_rig(files)
    rig = read.value
    filmed = [*match_videos([file for file in files if file.role == "video"], rig)]
    filmed += [name for name in match_videos([f for f in files if f.role == "keypoints"], rig) if name not in filmed]
    if len(filmed) > 1:
        raise InputError(
            f"A session of one camera has recordings of {len(filmed)}: {', '.join(filmed)}.",
            hint="Make a session of the kind human_multicamera for them: several cameras measure more than one.",
            code="too-many-videos",
        )
    cameras = tuple(camera for camera in rig.cameras if camera.name in filmed) or rig.cameras[:1]
    return Outcome(replace(rig, cameras=cameras), read.findings)


def find_subject(capture: Capture, parameters: Parameters, output_dir: Path, progress: Progress) -> Outcome[Keypoints]:
    """Find everybody's keypoints, or take those that were uploaded, and choose the subject: seen the longest and largest.

    Raises:
        InputError: ``person-place``: the subject was asked for by a place on the floor.
        CaptureError: ``nobody-found``, or ``person-unknown``.
        ResourceError: ``weights-missing``.
    """
    asked = parameters.keypoints
    stride = look_stride(capture.timebase.rate_hz, asked.rate)
    uploaded = capture.views[0].poses is not None
    with Album(capture, stride, output_dir) as album:
        if uploaded:
            sightings = read_sightings(capture, asked)
            if capture.views[0].path is not None:
                leaf_through(capture, album.add, progress)
        else:
            sightings = look_at_videos(capture, asked.model, stride, album, progress)
    people = follow_people(sightings, parameters.reconstruction.min_confidence if uploaded else MIN_VISIBILITY)
    number = _asked_person(asked.person, len(people))
    keypoints = Keypoints(
        points=people[number - 1],
        networks=() if uploaded else (DETECTOR, asked.model),
        pictures=album.pictures,
        picture_frame=album.middle,
        picture_scale=album.scales,
        previews=album.previews,
    )
    seen = float(keypoints.seen[0].mean())
    findings: list[Finding] = []
    if seen < 0.9:
        findings.append(lost_subject(capture.rig.names[0], keypoints.seen[0], keypoints.look_times_s))
    lasting = [one for one in people if one is not people[number - 1] and (one.confidence > 0).any(axis=2).mean() > 0.1]
    if lasting:
        where = "the one seen the longest and largest" if number == 1 else f"number {number} by time and size"
        findings.append(finding("one-camera-bystanders", where=where, value=len(lasting)))
    return Outcome(keypoints, tuple(findings))


def _asked_person(person: object, count: int) -> int:
    if count == 0:
        raise CaptureError(
            "Nobody was found in this video.",
            hint="Check that it shows a whole person who fills at least a fifth of the picture's height.",
            code="nobody-found",
        )
    if isinstance(person, tuple):
        raise InputError(
            "One camera can't tell who is nearest to a place on the floor.",
            hint="Ask for keypoints.person = 1, 2, …: the people by how long and how large they are seen.",
            code="person-place",
        )
    number = person if isinstance(person, int) else 1
    if number > count:
        raise CaptureError(
            f"Person {number} was asked for, but {count} were seen.",
            hint="Leave keypoints.person out to get the one who is seen the longest and largest.",
            code="person-unknown",
        )
    return number


def scale_to_stature(points: ImagePoints, subject: Subject, files: Sequence[CaptureFile] = ()) -> Outcome[SubjectBody]:
    """Make the built-in body the subject's in stature and mass; the session's own model is taken as it is.

    Raises:
        InputError: the session has two body models or marker sets, or no marker set fits.
    """
    own = only_file(files, "body_model")
    file = own or models_dir() / "bodies" / f"fullbody_{subject.sex or 'male'}.osim"
    unmarked = read_osim(file)
    findings: list[Finding] = []
    factor = 1.0
    if own is None:
        tall_m = _stature_m(unmarked)
        factor = (subject.stature_m or tall_m) / tall_m
        if subject.stature_m is None:
            findings.append(finding("stature-unknown", value=tall_m))
        if subject.sex is None:
            findings.append(finding("sex-unknown"))
    scales = np.full((len(unmarked.bodies.names), 3), factor)
    sized = scale_model(unmarked, scales, mass_kg=subject.mass_kg)
    if subject.mass_kg is None:
        findings.append(finding("mass-unknown", value=sized.mass_kg))
    markerset = choose_markerset(unmarked, points.keypoint_names, only_file(files, "marker_set"))
    model = attach(sized, markerset)
    body = SubjectBody(model=model, markerset=markerset, tasks=make_tasks(model, markerset), file=file, scales=scales)
    return Outcome(body, tuple(findings))


def _stature_m(model: BodyModel) -> float:
    place = marker_positions(model, model.coordinates.default[None])[0]
    return float(place[model.markers.index("vertex"), 1] - place[model.markers.index("heel_r"), 1])


def fit_view(
    body: SubjectBody,
    points: ImagePoints,
    rig: Rig,
    parameters: Parameters,
    progress: Progress | None = None,
    scatter: Scatter = REAL_SCATTER,
) -> Outcome[OneView]:
    """Fit the body to the camera's keypoints over the whole trial, and judge what this view can tell.

    Raises:
        CaptureError: ``monocular-too-short``, or ``monocular-no-start``.
    """
    telling = keep_markers(body.model, np.flatnonzero(body.tasks.marker_weights >= LEAST_WEIGHT))
    weights = body.tasks.marker_weights[body.tasks.marker_weights >= LEAST_WEIGHT]
    tasks = replace(body.tasks, marker_weights=weights)
    looks = thin(points, look_stride(points.timebase.rate_hz, parameters.keypoints.rate))
    order = [looks.keypoint_names.index(name) for name in telling.markers.names]
    uv_px = undistort_rig(rig, looks.uv_px)[0][:, order]
    confidence = looks.confidence[0][:, order]
    confidence = np.where(confidence >= parameters.reconstruction.min_confidence, confidence, 0.0)
    if len(uv_px) < FEWEST_FRAMES:
        raise CaptureError(
            f"Too few pictures were looked at: {len(uv_px)}. One camera needs movement: {FEWEST_FRAMES} or more.",
            hint="Film one stride or more.",
            code="monocular-too-short",
        )
    times_s = looks.timebase.times_s(len(uv_px))
    _, placement = start_one_camera(telling, tasks, rig.cameras[0], uv_px, confidence, times_s)
    camera = turn_to(rig.cameras[0], placement)
    start, placement = start_one_camera(telling, tasks, camera, uv_px, confidence, times_s)
    distance_m = np.array([np.linalg.norm(np.median(placement.hips_lab_m, axis=0) - camera.centre_lab_m)])
    turned = replace(rig, cameras=(camera,))
    priors = make_priors(telling, body.markerset, turned, looks.timebase.rate_hz, distance_m)
    priors = believe_less(telling, priors, looks.timebase.rate_hz, scatter)
    found = fit_one_camera(telling, camera, uv_px, confidence, start, priors, progress)
    view_rad = view_angle_rad(camera, placement)
    # What the network was too unsure of to be used must not count as missed by the body either.
    used = points.confidence >= parameters.reconstruction.min_confidence
    counted = replace(points, confidence=np.where(used, points.confidence, 0.0))
    seen = describe_fit(body, found.fit, counted, rig, turned, view_rad)
    return Outcome(seen, judge_view(seen, found, priors))


def turn_to(camera: Camera, placement: Placement) -> Camera:
    """Turn the lab about its vertical so that the subject faces +X."""
    forward = placement.forward_lab
    angle_rad = float(np.arctan2(-forward[2], forward[0]))
    T_lab_calibrated = transform(rotation_about_y(-angle_rad), np.zeros(3))
    return replace(camera, T_lab_cam=T_lab_calibrated @ camera.T_lab_cam)


def describe_fit(
    body: SubjectBody, fit: PixelFit, points: ImagePoints, calibrated: Rig, rig: Rig, view_rad: float
) -> OneView:
    """Give the fit in the words of the river: the motion at the video's rate, and the body's keypoints in the lab.

    ``calibrated`` is the rig as it came, ``rig`` the same in the lab that is turned to the subject's heading.
    """
    count = points.uv_px.shape[1]
    times_s = points.timebase.times_s(count)
    motion = widen(resample(fit.motion, times_s), view_rad)
    model = personalise(body.model, fit)
    unknown = replace(motion, values=np.full_like(motion.values, np.nan), covariance=None)
    names = points.keypoint_names
    places = [names.index(name) for name in model.markers.names]
    xyz = np.full((count, len(names), 3), np.nan)
    xyz[:, places] = marker_positions(model, motion.values)
    covariance = np.full((count, len(names), 3, 3), np.nan)
    covariance[:, places] = place_covariance_m2(model, motion)
    seen = points.confidence > 0
    straight_px = undistort_rig(rig, points.uv_px)
    flat = replace(rig.cameras[0], distortion=np.zeros(5))
    residual_px = np.where(seen[..., None], straight_px - project(flat, xyz)[None], np.nan)
    known = np.isfinite(xyz[..., 0])
    depth_m = (xyz - flat.centre_lab_m) @ flat.T_lab_cam[:3, 2]
    lab = LabPoints(
        camera_names=points.camera_names,
        keypoint_names=names,
        timebase=points.timebase,
        xyz_lab_m=xyz,
        origin=np.select([known & seen[0], known], [MEASURED, FILLED], MISSING).astype(np.uint8),
        covariance_m2=covariance,
        residual_px=residual_px,
    )
    miss_m = np.linalg.norm(residual_px, axis=-1) * depth_m[None] / flat.intrinsic_px[0, 0]
    raw = Reconstruction(
        rig=rig,
        points=lab,
        camera_weight=np.isfinite(miss_m).astype(float),
        miss_m=miss_m,
        R_lab_calibrated=flat.T_lab_cam[:3, :3] @ calibrated.cameras[0].T_lab_cam[:3, :3].T,
    )
    squared = np.square(miss_m[0])
    counts = np.maximum(np.isfinite(squared).sum(axis=1), 1)
    rms_m = np.where(np.isfinite(squared).any(axis=1), np.sqrt(np.nansum(squared, axis=1) / counts), np.nan)
    motion = replace(motion, residual_rms_m=rms_m)
    found = BodyMotion(motion=motion, model=model, two_step=unknown, fit=fit, distrusted="")
    return OneView(rig=rig, motion=found, raw=raw, view_rad=view_rad)


def judge_view(seen: OneView, found: OneCameraFit, priors: TrialPriors) -> tuple[Finding, ...]:
    """Say which angles this view can't measure, by their predicted error, and whether the fit can be believed at all."""
    motion = seen.motion
    findings = [*judge_motion(motion.motion), finding("one-camera", value=float(np.degrees(seen.view_rad)))]
    if not found.standing.is_on_floor:
        findings.append(_off_floor(found.standing))
    reason = distrust(found.fit, priors)
    if reason:
        findings.append(finding("monocular-fit-doubtful", where=reason))
    for angle in find_clinical_angles(motion.model):
        sd_deg = clinical_sd_deg(motion.motion, angle)
        known = sd_deg[np.isfinite(sd_deg)]
        if known.size and np.median(known) > UNRELIABLE_SD_DEG[angle.name]:
            where = f"{angle.side} {angle.name.replace('_', ' ')}"
            span_s = worst_moment(sd_deg, motion.motion.times_s)
            value, joint = float(np.median(known)), joint_of(angle)
            findings.append(finding("view-unreliable", where=where, value=value, span_s=span_s, joint=joint))
    return tuple(findings)


def _off_floor(standing: Standing) -> Finding:
    """Say why the floor was not used."""
    if np.isnan(standing.gap_m):
        return finding("feet-off-floor", where="no foot seems to stand still")
    side = "above" if standing.gap_m > 0 else "below"
    where = (
        f"standing feet seem to be {100 * abs(standing.gap_m):.0f} cm {side} it, and that is known to "
        f"± {100 * 1.96 * standing.gap_sd_m:.0f} cm"
    )
    return finding("feet-off-floor", where=where, value=standing.gap_m)
