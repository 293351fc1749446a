"""Stage ``report``: what was computed, written down for people (HTML) and for programs (JSON, CSV, C3D, TRC, MOT)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gonio.formats.c3d import Event, Side
from gonio.formats.c3d_writer import write_c3d
from gonio.formats.curve_tables import can_write_parquet, write_cycle_parquet, write_cycle_table, write_time_table
from gonio.formats.mot import Table, table_of_motion, write_mot
from gonio.formats.osim_writer import write_osim
from gonio.formats.trc import Trajectories, write_trc
from gonio.kernel.geometry.cameras import project
from gonio.pipeline.describe import Analysis, describe
from gonio.pipeline.dynamics import moment_curves
from gonio.pipeline.finding_kind import counted
from gonio.pipeline.gait import angle_curves, time_s
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.opensim_dynamics import table_of_torques
from gonio.pipeline.report_page import render_html
from gonio.pipeline.report_schema import GaitReport
from gonio.pipeline.run import ReportFiles
from gonio.pipeline.viewer import skeleton_of, write_viewer
from gonio.records import FEET, Finding, GaitAnalysis, GroundForces, LabPoints
from gonio.vision.model_cards import load_card
from gonio.vision.pictures import decode_jpeg, draw_skeleton, encode_jpeg, look_closer
from gonio.vision.weights import default_cache_dir, ensure_weights

PLAN_KEYPOINTS = tuple(
    f"{side}_{joint}" for joint in ("heel", "ankle", "hip", "shoulder") for side in ("left", "right")
)
PLAN_POINTS = 400


def write_report(analysis: Analysis, findings: Sequence[Finding], output_dir: Path) -> ReportFiles:
    """Write ``report.json`` and ``report.html``, and the files for other programs."""
    cache_dir = default_cache_dir()
    weights = {name: ensure_weights(load_card(name), cache_dir, offline=True) for name in analysis.keypoints.networks}
    report = describe(analysis, findings, {**weights, analysis.body.file.name: analysis.body.file})
    document, page = output_dir / "report.json", output_dir / "report.html"
    document.write_text(report.model_dump_json(indent=1), encoding="utf-8")
    page.write_text(render_html(report, draw_pictures(analysis), draw_plan(analysis)), encoding="utf-8")
    return ReportFiles(
        document=document,
        page=page,
        others=(
            *write_opensim_files(analysis.points, analysis.motion, analysis.body.file, output_dir),
            *write_laboratory_files(analysis.points, analysis.motion, analysis.gait, output_dir),
            *write_force_files(analysis, output_dir),
            *write_viewer(analysis, output_dir),
        ),
    )


def write_opensim_files(points: LabPoints, found: BodyMotion, template: Path, output_dir: Path) -> tuple[Path, ...]:
    """Write the points (``markers.trc``), the coordinates (``motion.mot``) and the subject's model (``model.osim``)."""
    trc, mot, osim = (output_dir / name for name in ("markers.trc", "motion.mot", "model.osim"))
    write_trc(trc, _trajectories(points))
    write_mot(mot, table_of_motion(found.motion))
    write_osim(osim, found.model, template)
    return trc, mot, osim


def write_laboratory_files(
    points: LabPoints, found: BodyMotion, gait: GaitAnalysis, output_dir: Path
) -> tuple[Path, ...]:
    """Write points, angles and events (``trial.c3d``), angles over time (``angles.csv``), and all cycles (``cycles.csv``).

    Where Apache Arrow is installed, also ``cycles.parquet``.
    """
    c3d, angles, cycles = (output_dir / name for name in ("trial.c3d", "angles.csv", "cycles.csv"))
    curves = angle_curves(found.motion, found.model)
    write_c3d(c3d, _trajectories(points), {f"{c.side}_{c.quantity}": c.values for c in curves}, _events(gait))
    write_time_table(angles, found.motion.times_s, curves)
    write_cycle_table(cycles, gait)
    if not can_write_parquet():
        return c3d, angles, cycles
    parquet = output_dir / "cycles.parquet"
    write_cycle_parquet(parquet, gait)
    return c3d, angles, cycles, parquet


def write_force_files(analysis: Analysis, output_dir: Path) -> tuple[Path, ...]:
    """Write the ground's forces (``forces.mot``), all torques (``torques.sto``) and the legs' moments (``moments.csv``).

    The first two are as OpenSim has them: external loads of each foot, and generalized forces named after the coordinates.
    Nothing without torques.
    """
    forces, torques, model = analysis.forces, analysis.torques, analysis.motion.model
    if forces is None or torques is None:
        return ()
    mot, sto, moments = (output_dir / name for name in ("forces.mot", "torques.sto", "moments.csv"))
    write_mot(mot, table_of_loads(forces))
    write_mot(sto, table_of_torques(model, torques.times_s, torques.values))
    write_time_table(moments, torques.times_s, moment_curves(analysis.motion, torques))
    return mot, sto, moments


def table_of_loads(forces: GroundForces) -> Table:
    """Make the table of external loads: each foot's force, where it acts on the floor, and the moment about the vertical."""
    labels: list[str] = []
    columns: list[np.ndarray] = []
    for foot, side in enumerate(FEET):
        force_n, moment_nm = forces.wrench[:, foot, :3], forces.wrench[:, foot, 3:]
        place_m = np.where(forces.contact[:, foot, None], forces.cop_lab_m[:, foot], 0.0)
        free_nm = moment_nm - np.cross(place_m, force_n)
        for word, values in (("force_v", force_n), ("force_p", place_m), ("torque_", free_nm)):
            labels += [f"{side}_ground_{word}{axis}" for axis in "xyz"]
            columns += list(values.T)
    return Table(
        name="Ground reaction",
        labels=tuple(labels),
        times_s=forces.times_s,
        values=np.stack(columns, axis=1),
        in_degrees=False,
    )


def _trajectories(points: LabPoints) -> Trajectories:
    return Trajectories(
        names=points.keypoint_names,
        times_s=points.timebase.times_s(len(points.xyz_lab_m)),
        xyz_m=points.xyz_lab_m,
        rate_hz=points.timebase.rate_hz,
    )


def _events(gait: GaitAnalysis) -> list[Event]:
    """List the events with the names that C3D files give them."""
    found: list[Event] = []
    sides: tuple[Side, Side] = ("right", "left")
    for label, trains in (("Foot Strike", gait.events.strikes), ("Foot Off", gait.events.lifts)):
        for side, train in zip(sides, trains, strict=True):
            found += [Event(label, side, time_s(gait, f)) for f in train.frames]
    return sorted(found, key=lambda event: event.time_s)


def load_report(document: Path) -> GaitReport:
    """Read a report that :func:`write_report` wrote."""
    return GaitReport.model_validate_json(document.read_bytes())


def draw_pictures(analysis: Analysis) -> dict[str, bytes]:
    """Draw the smoothed points over the still frame of each camera: what the reader can check by eye."""
    keypoints, points = analysis.keypoints, analysis.points
    drawn: dict[str, bytes] = {}
    if not keypoints.pictures:
        return {}
    for camera, path, scale in zip(analysis.raw.rig.cameras, keypoints.pictures, keypoints.picture_scale, strict=True):
        uv_px = project(camera, points.xyz_lab_m[keypoints.picture_frame])
        # A pixel's centre is at a whole number, its edges at halves: scaling acts on the edges.
        place_px = (uv_px + 0.5) * scale - 0.5
        picture, place_px = look_closer(decode_jpeg(path.read_bytes()), place_px)
        drawn[camera.name] = encode_jpeg(
            draw_skeleton(picture, place_px, points.keypoint_names, skeleton_of(points.keypoint_names))
        )
    return drawn


def draw_plan(analysis: Analysis) -> str:
    """Draw the room with the subject's way through it: which way is up and forward, and what each camera looked at."""
    from gonio.pipeline.calibration_figures import plan_figure  # with matplotlib: slow to load

    names = [n for n in PLAN_KEYPOINTS if n in analysis.points.keypoint_names]
    places = np.concatenate([analysis.points.of(name) for name in names or analysis.points.keypoint_names[:1]])
    known = places[np.isfinite(places[:, 0])]
    return plan_figure(analysis.raw.rig, known[:: max(1, len(known) // PLAN_POINTS)], "subject")


def key_lines(report: GaitReport) -> list[str]:
    """Give the six lines of a report that matter most, for a terminal."""
    r, b = report.reconstruction, report.body
    worst = max(r.cameras, key=lambda c: abs(complex(c.bias_u_px or 0, c.bias_v_px or 0)))
    legs = [s for s in r.segments if s.name.endswith(("thigh", "shank"))]

    def extent(joint: str, side: str) -> str:
        angle = next(a for a in report.angles if a.joint == joint and a.side == side)
        return "unknown" if angle.min_deg is None else f"{angle.min_deg:.0f}° to {angle.max_deg:.0f}°"

    return [
        f"Verdict: {report.verdict.level}. {report.verdict.sentence}",
        f"Recording: {counted(len(r.cameras), 'camera|cameras')}, {report.frames} frames at {report.rate_hz:g} Hz "
        f"({report.duration_s:.2f} s), {counted(len(report.findings), 'finding|findings')}",
        f"Cameras: reprojection mean {r.reprojection_mean_px} px, median {r.reprojection_median_px} px over "
        f"{r.observations} observations; largest bias {worst.name} ({worst.bias_u_px}, {worst.bias_v_px}) px",
        "Leg segments, SD over time: " + ", ".join(f"{s.name} {s.sd_mm} mm" for s in legs),
        f"Body fit: {b.marker_rms_mean_mm} mm RMS in {b.frames_solved} of {report.frames} frames",
        f"Knee flexion: right {extent('knee', 'right')}, left {extent('knee', 'left')}",
    ]
