"""Sessions with soles and plates, from the files to the report: what comes in well, and what must be refused or said."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pandas as pd
import pytest

from gonio.bench.torque.walks import torque_errors_nm_kg
from gonio.demo.virtual import PARAMETERS, PRESSURE_FILE, SUBJECT, film_walk, write_session
from gonio.errors import InputError
from gonio.formats.force_plates import read_force_plates
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.pressure_csv import read_pressure, write_pressure
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.geometry.transforms import rotation_about_y, transform
from gonio.kernel.virtual_lab import truth_at
from gonio.pipeline import analyse
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.report import load_report
from gonio.pipeline.report_schema import GaitReport
from gonio.pipeline.run import CaptureFile, LocalRunner
from gonio.records import FootPressure, VirtualTrial
from gonio.resources import models_dir

OF_FORCES = {"sensors", "pressure", "forces", "dynamics", "gait", "report"}
"""The stages that depend on soles and plates; the others are run once."""

TURN = np.deg2rad(110.0)
"""The walkway lies so in the calibrated lab: plates have to be turned to the subject's heading."""

R_calibrated_lab = rotation_about_y(TURN)


class Upstream:
    """A runner that runs the stages before the forces once, for all sessions of this file."""

    def __init__(self) -> None:
        self.kept: dict[str, object] = {}
        self.local = LocalRunner()

    def __call__(self, stage, work):
        if stage in OF_FORCES:
            return self.local(stage, work)
        if stage not in self.kept:
            self.kept[stage] = work(lambda fraction: None).value
        return self.kept[stage]

    @property
    def findings(self):
        return self.local.findings

    def again(self) -> "Upstream":
        fresh = Upstream()
        fresh.kept = self.kept
        return fresh


@pytest.fixture(scope="module")
def trial() -> VirtualTrial:
    return film_walk()


@pytest.fixture(scope="module")
def session(trial, tmp_path_factory) -> tuple[Path, Upstream]:
    folder = tmp_path_factory.mktemp("session")
    write_session(trial, folder)
    turn = transform(R_calibrated_lab, np.zeros(3))
    cameras = tuple(replace(camera, T_lab_cam=turn @ camera.T_lab_cam) for camera in trial.rig.cameras)
    write_toml_calibration(folder / "calibration.toml", replace(trial.rig, cameras=cameras))
    return folder, Upstream()


@pytest.fixture
def report_of(session, tmp_path) -> Callable[..., GaitReport]:
    """Analyse the session with other files in the place of its soles."""
    folder, upstream = session

    def run(*files: CaptureFile, subject=SUBJECT, **parameters) -> GaitReport:
        given = [file for file in find_capture_files(folder) if file.role != "pressure"]
        chosen = {**PARAMETERS, "subject": subject, **parameters}
        return load_report(analyse([*given, *files], chosen, upstream.again(), tmp_path / "report").document)

    return run


@pytest.fixture
def soles(session, tmp_path):
    """The session's soles, spoilt."""

    def write(change: Callable[[FootPressure], FootPressure] = lambda pressure: pressure) -> CaptureFile:
        pressure = read_pressure(session[0] / PRESSURE_FILE).pressure
        write_pressure(tmp_path / "soles.csv", change(pressure))
        return CaptureFile(path=tmp_path / "soles.csv", name="soles.csv", role="pressure")

    return write


def codes(report: GaitReport) -> set[str]:
    return {found.code for found in report.findings}


def angles_are_there(report: GaitReport) -> bool:
    return all(angle.range_deg is not None and angle.range_deg > 5 for angle in report.angles)


def knee_error_nm_kg(trial, report):
    error, _ = torque_errors_nm_kg(trial, report)
    return float(np.sqrt(np.nanmean(error**2)))


def test_soles_give_torque_and_their_clock_in_numbers(trial, report_of, soles, tmp_path):
    report = report_of(soles())
    assert report.pressure is not None
    assert report.pressure.used
    assert report.pressure.offset_ms == pytest.approx(50.0, abs=15.0)  # three times the usual 5 ms
    assert 1.0 < report.pressure.offset_sd_ms < 15.0
    assert report.kinetics is not None
    assert "14 walkers" in report.kinetics.coefficients_source
    assert knee_error_nm_kg(trial, report) < 0.15
    files_hold_the_same(report, tmp_path / "report")


def files_hold_the_same(report: GaitReport, folder: Path) -> None:
    """What was written for OpenSim and for spreadsheets comes back as the report has it."""
    knee = next(t for t in report.kinetics.torques if (t.joint, t.side) == ("knee", "right"))
    shown = np.array(knee.values_nm, dtype=float)
    sto = read_mot(folder / "torques.sto")
    np.testing.assert_allclose(np.abs(sto.of("knee_angle_r_moment")), np.abs(shown), atol=1e-2)
    moments = pd.read_csv(folder / "moments.csv")
    per_kg = np.array(knee.values_nm_kg, dtype=float)
    np.testing.assert_allclose(moments["right_knee_extension_moment_Nm_per_kg"], per_kg, atol=1e-2)
    loads = read_force_plates(folder / "forces.mot")
    up_n = np.array([foot.up_n for foot in report.kinetics.feet], dtype=float).T
    np.testing.assert_allclose(loads.force_lab_n[..., 1], up_n, atol=1e-2)
    pressed = np.nan_to_num(up_n) > 100
    places_m = np.array([foot.cop_x_m for foot in report.kinetics.feet], dtype=float).T
    np.testing.assert_allclose(loads.cop_lab_m[pressed][:, 0], places_m[pressed], atol=1e-2)


def plates_mot(trial: VirtualTrial, path: Path) -> CaptureFile:
    """A plate a foot, as OpenSim's tables have them."""
    truth = truth_at(trial.walk, np.arange(0, trial.truth.times_s[-1], 1 / 300))
    columns: dict[str, np.ndarray] = {}
    for foot, stem in enumerate(("ground", "1_ground")):
        loaded = truth.wrench[:, foot, 1:2] > 10.0
        force = np.where(loaded, truth.wrench[:, foot, :3], 0.0) @ R_calibrated_lab.T
        place = np.where(loaded, truth.cop_lab_m[:, foot], 0.0) @ R_calibrated_lab.T
        columns |= {f"{stem}_force_v{axis}": force[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"{stem}_force_p{axis}": place[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"{stem}_torque_{axis}": 0 * force[:, 0] for axis in "xyz"}
    table = Table(
        name="plates",
        labels=tuple(columns),
        times_s=truth.times_s,
        values=np.stack(list(columns.values()), axis=1),
        in_degrees=False,
    )
    write_mot(path, table)
    return CaptureFile(path=path, name=path.name, role="force_plates")


def plates_c3d(trial: VirtualTrial, path: Path) -> CaptureFile:
    """Two plates of type 1, one under each foot's path, in millimetres with Z up."""
    rate_hz = 300.0
    truth = truth_at(trial.walk, np.arange(0, trial.truth.times_s[-1], 1 / rate_hz))
    # The file's X and Y are the lab's X and −Z: a turn about X.
    R_file_lab = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    channels, corners = [], []
    for foot in range(2):
        loaded = truth.wrench[:, foot, 1] > 10.0
        force = np.where(loaded[:, None], truth.wrench[:, foot, :3], 0.0)
        place = truth.cop_lab_m[loaded, foot]
        margin = np.array([0.3, 0.02])  # two narrow strips: no foot stands on the other one's
        low, high = place.min(axis=0)[[0, 2]] - margin, place.max(axis=0)[[0, 2]] + margin
        middle = 0.5 * (low + high)
        # The corners of quadrants 1 to 4 of a plate whose x axis is the lab's X, its y the lab's Z, its z down.
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        flat = middle + signs * 0.5 * (high - low)
        corner = np.stack([flat[:, 0], np.zeros(4), flat[:, 1]], axis=1)
        corners.append(1e3 * corner @ R_calibrated_lab.T @ R_file_lab.T)
        at = np.zeros((len(force), 2))
        at[loaded] = 1e3 * (place[:, [0, 2]] - middle)
        channels += [force[:, 0], force[:, 2], -force[:, 1], at[:, 0], at[:, 1], np.zeros(len(force))]
    content = ezc3d.c3d()
    parameters = content["parameters"]
    parameters["POINT"]["RATE"]["value"] = [rate_hz]
    parameters["POINT"]["LABELS"]["value"] = ["NONE"]
    parameters["POINT"]["UNITS"]["value"] = ["mm"]
    content["data"]["points"] = np.ones((4, 1, len(truth.times_s)))
    parameters["ANALOG"]["RATE"]["value"] = [rate_hz]
    parameters["ANALOG"]["LABELS"]["value"] = [f"c{i}" for i in range(12)]
    content["data"]["analogs"] = np.array(channels)[None]
    for entry, value in (
        ("USED", [2]),
        ("TYPE", [1, 1]),
        ("CORNERS", np.stack([c.T for c in corners], axis=2)),
        ("ORIGIN", np.zeros((3, 2))),
        ("CHANNEL", 1.0 + np.arange(12).reshape(2, 6).T),
    ):
        content.add_parameter("FORCE_PLATFORM", entry, value)
    content.write(str(path))
    return CaptureFile(path=path, name=path.name, role="force_plates")


@pytest.mark.parametrize("write", [plates_mot, plates_c3d])
def test_plates_are_found_in_the_calibrated_lab_and_beat_soles(trial, report_of, soles, tmp_path, write):
    plates = write(trial, tmp_path / ("plates." + write.__name__.rpartition("_")[2]))
    report = report_of(plates, soles())
    assert report.kinetics is not None
    assert [foot.method for foot in report.kinetics.feet] == ["plates", "plates"]
    assert "plates-over-soles" in codes(report)
    # The movement's own error is left: 0.10 with soles.
    assert knee_error_nm_kg(trial, report) < 0.09
    assert any(event.from_force for event in report.gait.events)


def test_without_a_mass_there_are_angles_and_no_torque(report_of, soles):
    report = report_of(soles(), subject={"sex": "female"})
    assert report.kinetics is None
    assert "torque-mass-missing" in codes(report)
    assert "no torques" in report.verdict.sentence
    assert angles_are_there(report)


def swapped(p: FootPressure) -> FootPressure:
    return replace(p, vertical_n=p.vertical_n[:, ::-1].copy(), cop_foot_m=p.cop_foot_m[:, ::-1].copy())


def silent(p: FootPressure) -> FootPressure:
    return replace(p, vertical_n=p.vertical_n * [1.0, 0.0])


def slower(p: FootPressure) -> FootPressure:
    return replace(p, times_s=1.25 * p.times_s)


@pytest.mark.parametrize(
    ("change", "code"),
    [(swapped, "pressure-feet-swapped"), (silent, "pressure-foot-silent"), (slower, "pressure-not-synchronized")],
)
def test_a_stream_that_can_not_be_is_left_aside_and_angles_remain(report_of, soles, change, code):
    report = report_of(soles(change))
    assert code in codes(report)
    assert report.kinetics is None
    assert report.pressure is not None
    assert not report.pressure.used
    assert "no torques" in report.verdict.sentence
    assert angles_are_there(report)


def test_negative_pressure_stops_before_the_work(report_of, soles):
    with pytest.raises(InputError) as raised:
        report_of(soles(lambda p: replace(p, vertical_n=-p.vertical_n)))
    assert raised.value.code == "pressure-negative"


def test_a_lab_may_bring_its_own_coefficients(report_of, soles, tmp_path):
    own = tmp_path / "ours.forces.toml"
    theirs = (models_dir() / "forces" / "default.toml").read_text()
    own.write_text(theirs.replace('source = "Plate', 'source = "Our lab. Plate'))
    file = CaptureFile(path=own, name=own.name, role="force_coefficients")
    report = report_of(soles(), file, forces={"method": "pivot"})
    assert report.kinetics is not None
    assert report.kinetics.coefficients_source.startswith("Our lab. ")
    assert report.kinetics.asked == "pivot"
    assert ("ours.forces.toml", "force_coefficients") in {(f.name, f.role) for f in report.provenance.inputs}
