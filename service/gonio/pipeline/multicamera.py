"""The river for several synchronized cameras, from what was uploaded to the report. Read it from top to bottom."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gonio.pipeline.body import scale_to_subject
from gonio.pipeline.capture import read_capture, read_rig
from gonio.pipeline.checks import check_keypoints, leave_out_moved_cameras
from gonio.pipeline.describe import Analysis
from gonio.pipeline.dynamics import find_joint_torques, moment_curves
from gonio.pipeline.forces import choose_coefficients, find_forces
from gonio.pipeline.gait import analyse_gait
from gonio.pipeline.keypoints import find_keypoints
from gonio.pipeline.motion import fit_motion
from gonio.pipeline.params import parse_parameters, with_file_defaults
from gonio.pipeline.pressure import measure_forces, read_sensors
from gonio.pipeline.reconstruction import (
    calibrated_delays,
    hold_lengths,
    reconstruct,
    refine_cameras,
    smooth,
    synchronize,
)
from gonio.pipeline.report import write_report
from gonio.pipeline.run import CaptureFile, Outcome, ReportFiles, StageRunner
from gonio.pipeline.trial_lab import lab_source


def analyse(
    capture_files: Sequence[CaptureFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> ReportFiles:
    """Compute a gait report from the files of one session.

    Args:
        capture_files: The videos (or the keypoints that another program found in them) and the calibration; the table of
            foot pressure with its card, the force plates, the lab's own coefficients of the shear; the lab's own body model
            and its marker set: each if there is one.
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

    rig = runner("calibration", lambda _: read_rig(capture_files))
    capture = runner("capture", lambda _: read_capture(capture_files, rig, chosen.keypoints.rate_hz))
    sensors = runner("sensors", lambda _: read_sensors(capture_files, capture.frame_count / capture.timebase.rate_hz))
    keypoints = runner("keypoints", lambda progress: find_keypoints(capture, chosen, output_dir, progress))
    checked = runner("checks", lambda _: check_keypoints(keypoints.points, capture.rig, chosen.reconstruction))
    known_s = calibrated_delays(capture_files)
    delays, synchronous = runner(
        "synchronization", lambda _: synchronize(checked, capture.rig, chosen.reconstruction, known_s)
    )
    steady = runner("tripods", lambda _: leave_out_moved_cameras(synchronous, capture.rig, chosen.reconstruction))
    refined = runner("cameras", lambda _: refine_cameras(steady, capture.rig, chosen.reconstruction))
    source = lab_source(capture_files)
    raw = runner("triangulation", lambda _: reconstruct(steady, refined.rig, chosen.reconstruction, source))
    tracks = runner("smoothing", lambda _: smooth(steady, raw, chosen.reconstruction))
    points = hold_lengths(tracks, chosen.reconstruction)
    body = runner("scaling", lambda _: scale_to_subject(points, chosen.subject, capture_files))
    motion = runner("kinematics", lambda progress: fit_motion(body, points, steady, raw.rig, chosen, progress))
    measured = runner("pressure", lambda _: measure_forces(sensors, motion, chosen, raw.R_lab_calibrated))
    forces = runner("forces", lambda _: find_forces(motion, measured, chosen, coefficients))
    torques = runner("dynamics", lambda _: find_joint_torques(motion, measured, forces, chosen, coefficients))
    moments = moment_curves(motion, torques)
    gait = runner("gait", lambda _: analyse_gait(motion, points.timebase, measured, moments))

    analysis = Analysis(
        files=tuple(capture_files),
        parameters=chosen,
        capture=capture,
        keypoints=keypoints,
        synchronization=delays,
        refinement=refined,
        raw=raw,
        tracks=tracks,
        points=points,
        body=body,
        motion=motion,
        measured=measured,
        coefficients=coefficients,
        forces=forces,
        torques=torques,
        gait=gait,
    )
    return runner("report", lambda _: Outcome(write_report(analysis, runner.findings, output_dir)))
