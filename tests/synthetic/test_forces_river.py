"""From the files to the torques: plates instead of soles, the lab's own coefficients, a subject without a mass."""

from pathlib import Path

import numpy as np
import pytest

from gonio.bench.walks import compare
from gonio.demo.virtual import PARAMETERS, PRESSURE_FILE, SUBJECT, film_walk, write_session
from gonio.formats.mot import Table, write_mot
from gonio.pipeline import analyse
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.report import load_report
from gonio.pipeline.report_schema import GaitReport
from gonio.pipeline.run import LocalRunner
from gonio.records import FEET, VirtualTrial
from gonio.resources import models_dir


@pytest.fixture(scope="module")
def trial() -> VirtualTrial:
    return film_walk()


@pytest.fixture
def session(trial: VirtualTrial, tmp_path: Path) -> Path:
    write_session(trial, tmp_path / "session")
    return tmp_path / "session"


def report_of(session: Path, subject: dict[str, object] | None = None, **parameters: object) -> GaitReport:
    wanted = {"subject": SUBJECT if subject is None else subject, **PARAMETERS, **parameters}
    written = analyse(find_capture_files(session), wanted, LocalRunner(), session.parent / "report")
    return load_report(written.document)


def write_plates(trial: VirtualTrial, path: Path) -> None:
    """Write what two plates would have measured as OpenSim has it: force, centre of pressure, free moment."""
    columns: dict[str, np.ndarray] = {}
    for foot, side in enumerate(FEET):
        force, cop = trial.truth.wrench[:, foot, :3], np.nan_to_num(trial.truth.cop_lab_m[:, foot])
        free = trial.truth.wrench[:, foot, 3:] - np.cross(cop, force)
        for axis, name in enumerate("xyz"):
            columns[f"{side}_ground_force_v{name}"] = force[:, axis]
            columns[f"{side}_ground_force_p{name}"] = cop[:, axis]
            columns[f"{side}_ground_torque_{name}"] = free[:, axis] if name == "y" else np.zeros(len(free))
    values = np.stack(list(columns.values()), axis=1)
    write_mot(
        path, Table(name="plates", labels=tuple(columns), times_s=trial.truth.times_s, values=values, in_degrees=False)
    )


def test_force_plates_take_the_place_of_soles(trial: VirtualTrial, session: Path) -> None:
    write_plates(trial, session / "plates.mot")
    report = report_of(session)
    assert report.kinetics is not None
    assert [foot.method for foot in report.kinetics.feet] == ["plates", "plates"]
    assert "plates-over-soles" in {finding.code for finding in report.findings}
    # What is left is the movement's error: 10 mm between the knee and the force are 0.1 Nm/kg under the body's weight.
    assert compare(trial, report).knee_nm_kg < 0.12


def test_a_lab_may_bring_its_own_coefficients(session: Path) -> None:
    own = (models_dir() / "forces" / "default.toml").read_text()
    (session / "ours.forces.toml").write_text(own.replace('source = "Plate', 'source = "Our lab. Plate'))
    report = report_of(session, forces={"method": "pivot"})
    assert report.kinetics is not None
    assert report.kinetics.coefficients_source.startswith("Our lab. ")
    assert report.kinetics.asked == "pivot"
    assert report.pressure is not None
    assert report.pressure.offset_ms == pytest.approx(50.0, abs=15.0)
    assert report.pressure.offset_sd_ms < 15.0
    assert ("ours.forces.toml", "force_coefficients") in {(f.name, f.role) for f in report.provenance.inputs}


def test_without_a_mass_there_are_angles_and_no_torques(session: Path) -> None:
    report = report_of(session, {"sex": "female"})
    assert report.kinetics is None
    assert "torque-mass-missing" in {finding.code for finding in report.findings}
    assert all(angle.range_deg is not None for angle in report.angles)


def test_another_trials_stream_gives_no_torques(session: Path) -> None:
    """Its steps are elsewhere: the stream is refused, the angles are there."""
    lines = (session / PRESSURE_FILE).read_text().splitlines()
    header, rows = lines[0], [line.split(",") for line in lines[1:]]
    slower = [",".join([f"{1.37 * float(row[0]):.4f}", *row[1:]]) for row in rows]
    (session / PRESSURE_FILE).write_text("\n".join([header, *slower]) + "\n")
    report = report_of(session)
    assert report.kinetics is None
    assert "pressure-not-synchronized" in {finding.code for finding in report.findings}
