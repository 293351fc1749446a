"""A session of the virtual laboratory, analysed like any other, with its truth beside the report.

The service takes videos, and no network finds a person in drawn capsules. So the laboratory answers for the stages that
would have read files and looked at pictures, and everything after them is the analysis that a job runs.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from gonio.client import Client, Document
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.formats.pressure_csv import write_pressure
from gonio.http.server import serving
from gonio.kernel.kinematics.clinical import clinical_deg, find_clinical_angles
from gonio.kernel.virtual_lab import PRESETS, SOLES, film, grow, make_rig, press, walk
from gonio.pipeline import analyse
from gonio.pipeline.keypoints import Keypoints
from gonio.pipeline.reconstruction import SEGMENTS
from gonio.pipeline.report import key_lines, load_report
from gonio.pipeline.report_schema import Angle, GaitReport
from gonio.pipeline.run import CaptureFile, LocalRunner, Outcome, Progress, ReportFiles
from gonio.records import Capture, Motion, View, VirtualTrial
from gonio.resources import models_dir
from gonio.settings import Settings
from gonio.terminal import progress_bar, stage_lines
from gonio.vision.pictures import encode_jpeg
from gonio.vision.render import draw_walk

T = TypeVar("T")

SEX, STATURE_M, MASS_KG, SPEED_M_S = "female", 1.66, 61.0, 1.25
RATE_HZ, DURATION_S = 60.0, 2.9
PARAMETERS: dict[str, Any] = {
    "subject": {"sex": SEX, "stature_m": STATURE_M, "mass_kg": MASS_KG},
    "reconstruction": {"min_confidence": 0.3},  # the laboratory's confidences are OpenPose's
}
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


def run_virtual_demo(output: Path, console: Console) -> Path:
    """Film, analyse, compare, and give the report's page."""
    console.print(
        "Recording: a walk of the virtual laboratory, with everything that goes wrong in pictures", soft_wrap=True
    )
    with progress_bar(console) as advance:
        trial, report, seconds = analyse_virtual(output / "report", advance)
    send_pressure(output / "report" / PRESSURE_FILE, output / "data", console)
    document = load_report(report.document)
    for line in key_lines(document):
        console.print(line, soft_wrap=True)
    console.print(error_table(trial, document))
    for line in error_lines(trial, document):
        console.print(line, soft_wrap=True)
    console.print(stage_lines(seconds), style="dim", soft_wrap=True)
    console.print(f"Report: [bold]{report.page.absolute()}[/]", soft_wrap=True)
    return report.page


def analyse_virtual(
    output: Path,
    on_progress: Callable[[str, float, float | None], None] | None = None,
    *,
    duration_s: float = DURATION_S,
) -> tuple[VirtualTrial, ReportFiles, dict[str, float]]:
    """Film a walk with pressure soles on and analyse it into a folder; also give the seconds of each stage."""
    body = read_osim(models_dir() / "bodies" / f"fullbody_{SEX}.osim")
    walker = walk(grow(body, stature_m=STATURE_M, mass_kg=MASS_KG), SPEED_M_S)
    card = read_markerset(models_dir() / "markersets" / "blazepose33.toml")
    effects = PRESETS["occluded"]
    trial = film(walker, make_rig(), card, effects=effects, rate_hz=RATE_HZ, duration_s=duration_s)
    output.mkdir(parents=True, exist_ok=True)
    soles = output / PRESSURE_FILE
    write_pressure(soles, press(walker, errors=SOLES["realistic"], duration_s=duration_s).pressure)
    runner = _Laboratory(trial, output, on_progress)
    report = analyse((CaptureFile(path=soles, name=soles.name, role="pressure"),), PARAMETERS, runner, output)
    return trial, report, runner.seconds


def send_pressure(soles: Path, data_dir: Path, console: Console) -> Document:
    """Upload the pressure stream to a service of its own, as a laboratory would, and give what the service saw in it."""
    with serving(Settings(data_dir=data_dir.absolute(), port=0)) as url, Client(url) as gonio:
        while not gonio.is_ready():
            time.sleep(0.1)
        session = gonio.create_session(name="Demo: a virtual walk", subject=PARAMETERS["subject"])
        file = gonio.upload(session["id"], soles, role="pressure")
    facts = file["facts"]
    console.print(
        f"Pressure: {file['name']}, {facts['samples']} samples at {facts['rate_hz']:.0f} Hz, accepted over HTTP",
        soft_wrap=True,
    )
    return file


def compare_angles(trial: VirtualTrial, report: GaitReport) -> list[AngleError]:
    """Compare the report's angles with the truth."""
    true = _true_angles(trial)
    found: list[AngleError] = []
    for joint in JOINTS:
        errors, bars = [], []
        for angle in (a for a in report.angles if a.joint == joint):
            errors.append(_numbers(angle.values_deg) - true[_key(angle)])
            bars.append(1.96 * _numbers(angle.sd_deg))
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


class _Laboratory(LocalRunner):
    """Runs an analysis whose cameras, capture and keypoints come from the virtual laboratory."""

    def __init__(
        self, trial: VirtualTrial, output: Path, on_progress: Callable[[str, float, float | None], None] | None
    ) -> None:
        super().__init__(on_progress)
        self._trial = trial
        self._output = output

    def __call__(self, stage: str, work: Callable[[Progress], Outcome[T]]) -> T:
        known: dict[str, Callable[[], Any]] = {
            "calibration": lambda: self._trial.rig,
            "capture": self._capture,
            "keypoints": self._keypoints,
        }
        if stage in known:
            return super().__call__(stage, lambda _: Outcome(known[stage]()))
        return super().__call__(stage, work)

    def _capture(self) -> Capture:
        rig, timebase, frames = self._trial.rig, self._trial.timebase, self._trial.points.uv_px.shape[1]
        views = tuple(
            View(
                camera_name=camera.name,
                file_name="virtual",
                path=self._output,
                image_size_px=camera.image_size_px,
                rate_hz=timebase.rate_hz,
                frame_count=frames,
            )
            for camera in rig.cameras
        )
        return Capture(rig=rig, views=views, timebase=timebase, frame_count=frames)

    def _keypoints(self) -> Keypoints:
        """Give the keypoints, and a drawing of the walker for each camera to show them on."""
        trial, folder = self._trial, self._output / "pictures"
        folder.mkdir(exist_ok=True)
        middle = trial.points.uv_px.shape[1] // 2
        pictures: list[Path] = []
        for camera, times_s in zip(trial.rig_true.cameras, trial.camera_times_s, strict=True):
            (rgb,) = draw_walk(camera, trial.walk, times_s[middle : middle + 1])
            path = folder / f"{camera.name}.jpg"
            path.write_bytes(encode_jpeg(rgb))
            pictures.append(path)
        return Keypoints(
            points=trial.points,
            networks=(),
            pictures=tuple(pictures),
            picture_frame=middle,
            picture_scale=(1.0,) * len(pictures),
        )


def _true_angles(trial: VirtualTrial) -> dict[tuple[str, str], Float[np.ndarray, " frame"]]:
    """Give the true course of each angle of a report, degrees, by joint and side."""
    truth, frames = trial.truth, len(trial.truth.times_s)
    motion = Motion(
        coordinate_names=truth.coordinate_names,
        rotational=trial.walk.body.coordinates.rotational,
        times_s=truth.times_s,
        values=truth.q,
        status=np.zeros(frames, dtype=np.uint8),
        iterations=np.zeros(frames, dtype=int),
        residual_rms_m=np.zeros(frames),
        covariance=None,
    )
    return {
        (angle.name.partition("_")[0], angle.side): clinical_deg(motion, angle)
        for angle in find_clinical_angles(trial.walk.body)
    }


def _key(angle: Angle) -> tuple[str, str]:
    return angle.joint, angle.side


def _numbers(values: list[float | None]) -> Float[np.ndarray, " frame"]:
    return np.array([np.nan if value is None else value for value in values])
