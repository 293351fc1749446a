"""A session of the virtual laboratory, uploaded and analysed like any other, with its truth beside the report.

No network finds a person in drawn capsules. So the laboratory's keypoints are uploaded, as a lab uploads those of OpenPose,
with the drawn videos, the cameras' calibration and the stream of the pressure soles.
"""

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from gonio.client import Client
from gonio.demo.over_http import analyse_over_http, demo_service
from gonio.formats.markerset import read_markerset
from gonio.formats.openpose import write_poses
from gonio.formats.osim import read_osim
from gonio.formats.pressure_csv import write_pressure
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.kinematics.clinical import clinical_deg, find_clinical_angles
from gonio.kernel.virtual_lab import PRESETS, SOLES, film, grow, make_rig, press, walk
from gonio.pipeline import analyse
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.reconstruction import SEGMENTS
from gonio.pipeline.report import load_report
from gonio.pipeline.report_schema import Angle, GaitReport
from gonio.pipeline.rounding import array_of
from gonio.pipeline.run import LocalRunner, ReportFiles
from gonio.records import Camera, Motion, Rig, VirtualTrial, Walk
from gonio.resources import models_dir
from gonio.vision.render import draw_walk, write_video

SEX, STATURE_M, MASS_KG, SPEED_M_S = "female", 1.66, 61.0, 1.25
RATE_HZ, DURATION_S = 60.0, 2.9
SUBJECT: dict[str, Any] = {"sex": SEX, "stature_m": STATURE_M, "mass_kg": MASS_KG}
PARAMETERS: dict[str, Any] = {"keypoints": {"rate_hz": RATE_HZ}}
JOINTS = ("hip", "knee", "ankle")
PRESSURE_FILE = "soles.csv"
"""The walker's pressure stream, 20 Hz, by realistic soles: a clock that is 50 ms ahead, noise, a gain, gaps."""


class AngleError(NamedTuple):
    """How far one joint's angle is from the truth, both sides, degrees; and how often its 95 % band holds the truth.

    ``offset`` is the mean error of the worse side; ``rms`` and ``covered`` (per cent) are without it: the absolute tilt of the
    pelvis, and with it the hip's, is out of reach of keypoints.
    """

    joint: str
    offset: float
    rms: float
    covered: float


def run_virtual_demo(output: Path, console: Console, *, videos: bool = True) -> Path:
    """Film, upload, analyse, compare, and give the report's page; without ``videos``, keypoints are all that is uploaded."""
    console.print(
        "Recording: a walk of the virtual laboratory, with everything that goes wrong in pictures", soft_wrap=True
    )
    trial = film_walk()
    files = write_session(trial, output / "session")
    if videos:
        console.print("  drawing its videos …", style="dim")
        files = [*files, *write_videos(trial, output / "session")]
    with demo_service(output, console) as gonio:
        page, report = _analyse(gonio, files, output, console)
    console.print(error_table(trial, report))
    for line in error_lines(trial, report):
        console.print(line, soft_wrap=True)
    console.print(f"Report: [bold]{page.absolute()}[/]", soft_wrap=True)
    return page


def _analyse(gonio: Client, files: Iterable[Path], output: Path, console: Console) -> tuple[Path, GaitReport]:
    session = gonio.create_session(name="Demo: a virtual walk", subject=SUBJECT)["id"]
    paths = analyse_over_http(gonio, session, files, output / "report", console, PARAMETERS)
    return paths["report.html"], load_report(paths["report.json"])


def film_walk(duration_s: float = DURATION_S, rig: Rig | None = None) -> VirtualTrial:
    """Film the demo's walker with the cameras of a rig; without one, with the paper's four."""
    body = read_osim(models_dir() / "bodies" / f"fullbody_{SEX}.osim")
    walker = walk(grow(body, stature_m=STATURE_M, mass_kg=MASS_KG), SPEED_M_S)
    card = read_markerset(models_dir() / "markersets" / "blazepose33.toml")
    return film(walker, rig or make_rig(), card, effects=PRESETS["occluded"], rate_hz=RATE_HZ, duration_s=duration_s)


def write_session(trial: VirtualTrial, folder: Path, *, seed: int = 0) -> list[Path]:
    """Write what a laboratory would upload: each camera's keypoints, the calibration, the pressure stream."""
    folder.mkdir(parents=True, exist_ok=True)
    points, calibration, soles = trial.points, folder / "calibration.toml", folder / PRESSURE_FILE
    keypoints = [folder / f"{name}.zip" for name in points.camera_names]
    for path, uv_px, confidence in zip(keypoints, points.uv_px, points.confidence, strict=True):
        write_poses(path, uv_px, confidence)
    write_toml_calibration(calibration, trial.rig)
    duration_s = points.uv_px.shape[1] / trial.timebase.rate_hz
    write_pressure(soles, press(trial.walk, errors=SOLES["realistic"], duration_s=duration_s, seed=seed).pressure)
    return [*keypoints, calibration, soles]


def write_videos(trial: VirtualTrial, folder: Path) -> list[Path]:
    """Draw what each camera saw, a process a core."""
    paths = [folder / f"{camera.name}.mp4" for camera in trial.rig_true.cameras]
    with ProcessPoolExecutor() as pool:
        times = list(trial.camera_times_s)
        list(pool.map(_write_video, paths, trial.rig_true.cameras, [trial.walk] * len(paths), times))
    return paths


def _write_video(path: Path, camera: Camera, walk: Walk, times_s: Float[np.ndarray, " frame"]) -> None:
    write_video(path, draw_walk(camera, walk, times_s), RATE_HZ)


def analyse_virtual(
    output: Path, *, duration_s: float = DURATION_S
) -> tuple[VirtualTrial, ReportFiles, dict[str, float]]:
    """Film a walk with pressure soles on and analyse it without a service; also give the seconds of each stage."""
    trial = film_walk(duration_s)
    write_session(trial, output / "session")
    runner = LocalRunner()
    report = analyse(find_capture_files(output / "session"), {"subject": SUBJECT, **PARAMETERS}, runner, output)
    return trial, report, runner.seconds


def compare_angles(trial: VirtualTrial, report: GaitReport) -> list[AngleError]:
    """Compare the report's angles with the truth."""
    true = _true_angles(trial)
    found: list[AngleError] = []
    for joint in JOINTS:
        errors, bars = [], []
        for angle in (a for a in report.angles if a.joint == joint):
            errors.append(array_of(angle.values_deg) - true[_key(angle)])
            bars.append(1.96 * array_of(angle.sd_deg))
        error, bar = np.stack(errors), np.stack(bars)
        offset = np.nanmean(error, axis=1, keepdims=True)
        away = error - offset
        found.append(
            AngleError(
                joint=joint,
                offset=float(offset.ravel()[np.argmax(np.abs(offset))]),
                rms=float(np.sqrt(np.nanmean(away**2))),
                covered=100 * float((np.abs(away) < bar)[np.isfinite(away)].mean()),
            )
        )
    return found


def error_table(trial: VirtualTrial, report: GaitReport) -> Table:
    """Put what was found beside what is true."""
    table = Table(title="Against the truth", title_justify="left")
    for heading in ("", "found", "true", "error"):
        table.add_column(heading, justify="left" if not heading else "right")
    index, xyz = trial.points.keypoint_names.index, trial.xyz_lab_m
    for segment in report.reconstruction.segments:
        start, end = SEGMENTS[segment.name]
        true_mm = 1e3 * float(np.linalg.norm(xyz[:, index(start)] - xyz[:, index(end)], axis=-1).mean())
        if segment.mean_mm is not None:
            share = 100 * (segment.mean_mm / true_mm - 1)
            table.add_row(segment.name, f"{segment.mean_mm:.0f} mm", f"{true_mm:.0f} mm", f"{share:+.1f} %")
    true = _true_angles(trial)
    for angle in report.angles:
        if angle.range_deg is not None:
            true_deg = float(np.ptp(true[_key(angle)]))
            name = f"{angle.side} {angle.name.lower()}, range"
            table.add_row(name, f"{angle.range_deg:.1f}°", f"{true_deg:.1f}°", f"{angle.range_deg - true_deg:+.1f}°")
    return table


def error_lines(trial: VirtualTrial, report: GaitReport) -> list[str]:
    """Say in a line a joint how far its angle is from the truth over time."""
    return [
        f"{error.joint.capitalize()} over time: {error.rms:.1f}° RMS about an offset of {error.offset:+.1f}°, "
        f"{error.covered:.0f} % of it within the 95 % band"
        for error in compare_angles(trial, report)
    ]


def _true_angles(trial: VirtualTrial) -> dict[tuple[str, str], Float[np.ndarray, " frame"]]:
    """Give the true course of each angle of a report, degrees, by joint and side."""
    motion = true_motion(trial)
    return {
        (angle.name.partition("_")[0], angle.side): clinical_deg(motion, angle)
        for angle in find_clinical_angles(trial.walk.body)
    }


def true_motion(trial: VirtualTrial) -> Motion:
    """Give a virtual trial's true motion as inverse kinematics would report it, without an error."""
    truth, frames = trial.truth, len(trial.truth.times_s)
    return Motion(
        coordinate_names=truth.coordinate_names,
        rotational=trial.walk.body.coordinates.rotational,
        times_s=truth.times_s,
        values=truth.q,
        status=np.zeros(frames, dtype=np.uint8),
        iterations=np.zeros(frames, dtype=int),
        residual_rms_m=np.zeros(frames),
    )


def _key(angle: Angle) -> tuple[str, str]:
    return angle.joint, angle.side
