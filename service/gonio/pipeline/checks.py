"""Stages ``checks`` and ``tripods``: is what the cameras saw of use at all, and did each camera stay what it is called?

What contradicts itself is left out and named, or refused with the remedy. Nothing here changes a keypoint that is right.
"""

from dataclasses import replace

import numpy as np

from gonio.errors import CaptureError, InputError
from gonio.kernel.calibration.exchange import find_exchange
from gonio.kernel.calibration.movement import find_movement
from gonio.kernel.smoothing.filters import runs
from gonio.kernel.triangulation.fusion import LONGEST_SPAN_S
from gonio.pipeline.findings import finding
from gonio.pipeline.params import ReconstructionParameters
from gonio.pipeline.run import Outcome
from gonio.records import Finding, ImagePoints, Rig

FEWEST_KEYPOINTS = 6
"""A camera that trusts fewer keypoints than this does not see the subject."""


def check_keypoints(keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters) -> Outcome[ImagePoints]:
    """Leave out what is no position, and make sure that the rest can give points in the lab.

    Raises:
        InputError: ``keypoint-names``: there are no hips by the names that gonio knows.
        CaptureError: ``nothing-trusted``: no keypoint is trusted by two cameras at once; ``cameras-exchanged``: the videos of
            two cameras stand under each other's name.
    """
    if absent := {"left_hip", "right_hip"}.difference(keypoints.keypoint_names):
        raise InputError(
            f"There is no keypoint {' and no keypoint '.join(sorted(absent))}; there are: "
            f"{', '.join(keypoints.keypoint_names)}. The direction of walking is told by the hips.",
            hint="Name keypoints as the cards in models/markersets do: left_hip, not LHip.",
            code="keypoint-names",
        )
    clean, findings = _leave_out_what_is_no_position(keypoints)
    trusted = clean.confidence >= max(parameters.min_confidence, np.finfo(float).tiny)
    if not (trusted.sum(axis=0) >= 2).any():
        highest = ", ".join(f"{n} {c.max(initial=0.0):.2f}" for n, c in zip(rig.names, clean.confidence, strict=True))
        raise CaptureError(
            "No keypoint is trusted by two cameras at the same moment, so no point in the lab can be computed; the highest "
            f"confidences are: {highest}; the least that counts is {parameters.min_confidence:g}.",
            hint="Look at the videos: is a whole person in the picture of at least two cameras at once, well lit and not "
            "hidden? A lower min_confidence helps only where the keypoints are right.",
            code="nothing-trusted",
        )
    _refuse_exchanged_cameras(clean, rig, parameters.min_confidence)
    return Outcome(clean, (*findings, *_times_without_two_cameras(clean, parameters.min_confidence)))


def leave_out_moved_cameras(
    keypoints: ImagePoints, rig: Rig, parameters: ReconstructionParameters
) -> Outcome[ImagePoints]:
    """Find the cameras that were moved while they recorded, and leave out the part that no longer fits the calibration.

    Where it can't be told which camera it was, all stay in, and the finding says so.
    """
    findings: list[Finding] = []
    for _ in rig.cameras:
        movement = find_movement(rig, keypoints, parameters.min_confidence)
        if movement is None:
            break
        at_s = keypoints.timebase.start_s + movement.frame / keypoints.timebase.rate_hz
        names = " or ".join(rig.names[camera] for camera in movement.cameras)
        if len(movement.cameras) != 1:
            findings.append(
                finding("camera-moved-unclear", where=names, value=1e3 * movement.step_m, span_s=(at_s, at_s))
            )
            break
        side = "after" if movement.keep_before else "before"
        where, moment = f"{names}; left out: what it saw {side}", (at_s, at_s)
        findings.append(finding("camera-moved", where=where, value=1e3 * movement.step_m, span_s=moment, camera=names))
        frame, unsure = movement.frame, movement.unsure_frames
        lost = slice(max(frame - unsure, 0), None) if movement.keep_before else slice(0, frame + unsure)
        uv_px, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
        (camera,) = movement.cameras
        uv_px[camera, lost], confidence[camera, lost] = np.nan, 0.0
        keypoints = replace(keypoints, uv_px=uv_px, confidence=confidence)
    return Outcome(keypoints, tuple(findings))


def _leave_out_what_is_no_position(keypoints: ImagePoints) -> tuple[ImagePoints, list[Finding]]:
    known = np.asarray(np.isfinite(keypoints.uv_px).all(axis=-1))
    usable = known & np.isfinite(keypoints.confidence) & (keypoints.confidence > 0)
    wrong = ~usable & ~np.isnan(keypoints.uv_px).any(axis=-1) & (keypoints.confidence != 0)
    clean = replace(
        keypoints,
        uv_px=np.where(known[..., None], keypoints.uv_px, np.nan),
        confidence=np.where(usable, keypoints.confidence, 0.0),
    )
    share = 100 * wrong.mean(axis=(1, 2))
    names = keypoints.camera_names
    return clean, [finding("keypoints-invalid", camera=n, value=v) for n, v in zip(names, share, strict=True) if v > 0]


def _refuse_exchanged_cameras(keypoints: ImagePoints, rig: Rig, min_confidence: float) -> None:
    exchange = find_exchange(rig, keypoints, min_confidence)
    if exchange is None:
        return
    pairs = [(rig.names[a], rig.names[b]) for a, b in exchange.pairs]
    one, other = pairs[0]
    raise CaptureError(
        f"The videos of {' (or those of '.join(f'{a} and {b}' for a, b in pairs)}{')' * (len(pairs) - 1)} are exchanged: as "
        f"they are named the cameras miss each other by {1e3 * exchange.miss_before_m:.0f} mm at the subject, exchanged "
        f"by {1e3 * exchange.miss_after_m:.0f} mm.",
        hint=f"Upload the video of {one} with camera={other} and that of {other} with camera={one}, or exchange the two "
        "names in the calibration; then analyse again.",
        code="cameras-exchanged",
    )


def _times_without_two_cameras(keypoints: ImagePoints, min_confidence: float) -> list[Finding]:
    """Find the times, longer than what is filled, in which fewer than two cameras saw the subject."""
    looks = keypoints.sampled
    sees = (looks.confidence >= max(min_confidence, np.finfo(float).tiny)).sum(axis=2) >= FEWEST_KEYPOINTS
    blind = sees.sum(axis=0) < 2
    findings: list[Finding] = []
    for first, last in runs(blind):
        rate_hz, start_s = looks.timebase.rate_hz, looks.timebase.start_s
        if (last - first) / rate_hz <= LONGEST_SPAN_S:
            continue
        left = [n for n, seen in zip(looks.camera_names, sees[:, first:last].any(axis=1), strict=True) if seen]
        where = f"only {' or '.join(left)}" if left else "no camera"
        span_s = start_s + first / rate_hz, start_s + last / rate_hz
        findings.append(finding("too-few-cameras", where=where, value=(last - first) / rate_hz, span_s=span_s))
    return findings
