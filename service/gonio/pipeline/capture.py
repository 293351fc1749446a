"""Stages ``calibration`` and ``capture``: what was uploaded, matched and checked, before any work is spent on it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gonio.errors import CaptureError, InputError
from gonio.formats.calibration import read_calibration, read_own_calibration
from gonio.formats.openpose import count_frames
from gonio.pipeline.findings import finding
from gonio.pipeline.run import CaptureFile, Outcome
from gonio.records import Calibration, Camera, Capture, Finding, Rig, Timebase, View
from gonio.vision.video import VideoInfo, probe_video

EDGE_PX = 16
"""Codecs pad a picture to blocks of 16 pixels: a video and its calibration may differ by that much at the lower right."""

RATE_TOLERANCE = 2e-3
"""Two rates are the same if they differ by less: 60 and 59.94 Hz are the same camera mode written differently."""


def read_rig(files: Sequence[CaptureFile]) -> Outcome[Rig]:
    """Read the session's calibration.

    Raises:
        InputError: ``calibration-missing`` or ``calibration-ambiguous``, or what the format's reader says.
    """
    calibrations = [file for file in files if file.role == "calibration"]
    if not calibrations:
        raise InputError(
            "The session has no calibration.",
            hint="Upload the calibration of the cameras, for example Calib.qca.txt.",
            code="calibration-missing",
        )
    if len(calibrations) > 1:
        raise InputError(
            f"The session has {len(calibrations)} calibrations: {', '.join(f.name for f in calibrations)}.",
            hint="Delete all but the one that belongs to this recording.",
            code="calibration-ambiguous",
        )
    path, name = calibrations[0].path, calibrations[0].name
    return Outcome(replace(read_calibration(path), source=name), judge_calibration(read_own_calibration(path)))


def judge_calibration(calibration: Calibration | None) -> tuple[Finding, ...]:
    """Pass on what a calibration's own verdict said (None: a file of another program, which has none)."""
    if calibration is None or calibration.verdict.level == "accept":
        return ()
    wanted = "serious" if calibration.verdict.level == "reject" else "warning"
    reasons = " ".join(found.message for found in calibration.findings if found.severity == wanted)
    if wanted == "serious":
        return (finding("calibration-rejected", where=reasons),)
    return (finding("calibration-doubtful", where=reasons),)


def read_capture(
    files: Sequence[CaptureFile], rig: Rig, poses_rate_hz: float | None = None, fewest: int = 2
) -> Outcome[Capture]:
    """Match the videos, or the keypoints of another program, to the cameras and find the time that all of them cover.

    Args:
        files: The session's files. If some camera's keypoints are among them, all cameras' must be; their videos may be.
        rig: The calibrated cameras.
        poses_rate_hz: The rate of keypoints whose video is not there.
        fewest: How many cameras must have a video or keypoints.

    Raises:
        CaptureError: ``too-few-videos`` with fewer than ``fewest``.
        InputError: ``video-camera-unknown``, ``video-camera-taken``, ``video-size-wrong``, ``video-rates-differ``,
            ``poses-incomplete``, ``poses-rate-missing``, or what opening a file says.
    """
    videos = match_videos([file for file in files if file.role == "video"], rig)
    poses = match_videos([file for file in files if file.role == "keypoints"], rig)
    by_camera = poses or videos
    if len(by_camera) < fewest:
        kind = "camera with keypoints" if poses else f"video{'' if len(videos) == 1 else 's'}"
        needed = "a point in space needs two views" if fewest > 1 else "there is nothing to look at"
        which = f"at least {fewest} calibrated cameras" if fewest > 1 else "the calibrated camera"
        raise CaptureError(
            f"The session has {len(by_camera)} {kind}; {needed}.",
            hint=f"Upload the synchronized videos, or the keypoints, of {which}.",
            code="too-few-videos",
        )
    if poses and (lacking := videos.keys() - poses.keys()):
        raise InputError(
            f"The keypoints of {', '.join(sorted(lacking))} are missing, though its video is there; other cameras have theirs.",
            hint="Upload the keypoints of all cameras, or of none: then gonio finds them in the videos.",
            code="poses-incomplete",
        )
    findings = [finding("camera-without-video", camera=name) for name in rig.names if name not in by_camera]
    cameras, infos, used = [], [], []
    for camera in rig.cameras:
        if camera.name in by_camera:
            pose, video = poses.get(camera.name), videos.get(camera.name)
            info = probe_video(video.path) if video else None
            info = _poses_info(pose, camera, info, poses_rate_hz) if pose else info
            assert info is not None  # a camera in `by_camera` has one of the two
            fitted, size_findings = fit_camera_to_video(camera, info)
            cameras.append(fitted)
            infos.append(info)
            used.append(by_camera[camera.name])
            findings += size_findings
            if info.is_variable_rate:
                findings.append(finding("rate-varies", camera=camera.name, value=1e3 * info.largest_deviation_s))
    timebase, frame_count, steps, time_findings = common_time(tuple(c.name for c in cameras), infos)
    views = tuple(
        View(
            camera_name=camera.name,
            file_name=file.name,
            path=videos[camera.name].path if camera.name in videos else None,
            image_size_px=info.image_size_px,
            rate_hz=info.rate_hz,
            frame_count=info.frame_count,
            frame_step=step,
            poses=poses[camera.name].path if camera.name in poses else None,
        )
        for camera, file, info, step in zip(cameras, used, infos, steps, strict=True)
    )
    capture = Capture(
        rig=Rig(cameras=tuple(cameras), source=rig.source), views=views, timebase=timebase, frame_count=frame_count
    )
    return Outcome(capture, (*findings, *time_findings))


def _poses_info(poses: CaptureFile, camera: Camera, video: VideoInfo | None, rate_hz: float | None) -> VideoInfo:
    """Describe the pictures that keypoints were found in: as their video says, else as calibration and request say."""
    frames = count_frames(poses.path)
    if video is not None:
        return replace(video, frame_count=min(frames, video.frame_count))
    if rate_hz is None:
        raise InputError(
            f"The rate of {poses.name} is not known: keypoint files don't tell it.",
            hint="Start the analysis with the parameter keypoints.rate_hz, or upload the videos too.",
            code="poses-rate-missing",
        )
    return VideoInfo(
        file_name=poses.name,
        codec="",
        image_size_px=camera.image_size_px,
        rotation_deg=0,
        frame_count=frames,
        rate_hz=rate_hz,
        duration_s=frames / rate_hz,
        is_variable_rate=False,
        largest_deviation_s=0.0,
    )


def match_videos(videos: Sequence[CaptureFile], rig: Rig) -> dict[str, CaptureFile]:
    """Give each file's camera (a video's or keypoints'): the one it is for, else the one whose name is (in) the file's name."""
    by_camera: dict[str, CaptureFile] = {}
    for video in videos:
        stem = video.name.rsplit(".", 1)[0].casefold()
        wanted = (video.camera or "").casefold() or stem
        names = [name for name in rig.names if name.casefold() == wanted]
        if not names and not video.camera:
            names = [name for name in rig.names if name.casefold() in stem]
        if len(names) != 1:
            raise InputError(
                f"{video.name} belongs to no single camera of the calibration{f' ({video.camera})' if video.camera else ''}.",
                hint=f"Name the video after its camera or upload it with camera=NAME; the calibration knows: "
                f"{', '.join(rig.names)}.",
                code="video-camera-unknown",
            )
        if names[0] in by_camera:
            raise InputError(
                f"{video.name} and {by_camera[names[0]].name} both belong to camera {names[0]}.",
                hint="Delete one of them, or upload it with another camera=NAME.",
                code="video-camera-taken",
            )
        by_camera[names[0]] = video
    return by_camera


def fit_camera_to_video(camera: Camera, info: VideoInfo) -> tuple[Camera, tuple[Finding, ...]]:
    """Make a camera's calibration that of its video: the same, cut at an edge, or scaled.

    Raises:
        InputError: ``video-size-wrong`` where the shapes differ, so that no scaling can be right.
    """
    calibrated, filmed = np.array(camera.image_size_px), np.array(info.image_size_px)
    if np.array_equal(calibrated, filmed):
        return camera, ()
    if np.abs(calibrated - filmed).max() <= EDGE_PX:
        lost = float(np.abs(calibrated - filmed).max())
        return replace(camera, image_size_px=info.image_size_px), (
            finding("image-size-differs", camera=camera.name, value=lost),
        )
    scale = filmed / calibrated
    if abs(scale[0] / scale[1] - 1) > 0.01:
        raise InputError(
            f"{info.file_name} has {filmed[0]} × {filmed[1]} pixels, but camera {camera.name} was calibrated with "
            f"{calibrated[0]} × {calibrated[1]}.",
            hint="Is it the video of another camera, or turned by 90°? Calibrate with the mode that you record with.",
            code="video-size-wrong",
        )
    intrinsic_px = camera.intrinsic_px.copy()
    # A pixel's centre is at a whole number, its edges at halves: scaling acts on the edges.
    intrinsic_px[:2, 2] = (intrinsic_px[:2, 2] + 0.5) * scale - 0.5
    intrinsic_px[:2, :2] *= scale[:, None]
    scaled = replace(camera, image_size_px=info.image_size_px, intrinsic_px=intrinsic_px)
    return scaled, (finding("image-size-scaled", camera=camera.name, value=float(scale.mean())),)


def common_time(
    names: Sequence[str], infos: Sequence[VideoInfo]
) -> tuple[Timebase, int, tuple[int, ...], tuple[Finding, ...]]:
    """Find the slowest camera's clock, each camera's step to it and the number of frames that all have.

    Raises:
        InputError: ``video-rates-differ`` where one rate is no multiple of the slowest: taking the nearest frames would
            be wrong by up to half a frame, several centimetres at a swinging foot.
    """
    rates = np.array([info.rate_hz for info in infos])
    slowest = float(rates.min())
    ratio = rates / slowest
    steps = np.rint(ratio).astype(int)
    if np.any(np.abs(ratio / steps - 1) > RATE_TOLERANCE):
        listed = ", ".join(f"{info.file_name} {info.rate_hz:.3f} Hz" for info in infos)
        raise InputError(
            f"The videos have rates that are no multiples of each other: {listed}.",
            hint="Record all cameras at the same rate.",
            code="video-rates-differ",
        )
    counts = np.array([(info.frame_count - 1) // step + 1 for info, step in zip(infos, steps, strict=True)])
    shortest = int(counts.min())
    findings = [
        finding("rates-differ", camera=name, value=int(step))
        for name, step in zip(names, steps, strict=True)
        if step > 1
    ]
    findings += [
        finding("lengths-differ", camera=name, value=int(count - shortest))
        for name, count in zip(names, counts, strict=True)
        if count > shortest
    ]
    return Timebase(rate_hz=slowest), shortest, tuple(int(s) for s in steps), tuple(findings)
