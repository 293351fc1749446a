"""Inverse dynamics of OpenSim's example against OpenSim's own results, and its setup with everything that can be wrong."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.mot import read_mot
from gonio.pipeline.opensim_dynamics import run_dynamics

EXAMPLE = Path(__file__).resolve().parents[3] / "shared" / "data" / "opensim_gait2354"
pytestmark = pytest.mark.skipif(not EXAMPLE.is_dir(), reason=f"{EXAMPLE.name} is not at hand (in shared/data)")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The example, with the reference's own model and motion as input."""
    for path in EXAMPLE.iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path)
    shutil.copy(EXAMPLE / "OutputReference" / "subject01_simbody.osim", tmp_path)
    shutil.copy(EXAMPLE / "OutputReference" / "subject01_walk1_ik.mot", tmp_path)
    return tmp_path


def test_the_unchanged_setup_gives_the_shipped_result(folder: Path) -> None:
    dynamics, motion, result = run_dynamics(folder / "subject01_Setup_InverseDynamics.xml")
    reference = read_mot(EXAMPLE / "OutputReference" / "inverse_dynamics.sto")
    written = read_mot(result.files[0])
    assert written.labels == reference.labels
    np.testing.assert_allclose(written.times_s, reference.times_s, atol=1e-6)
    # OpenSim 4.6 itself is 6.7e-5 Nm off this file of an older version.
    assert np.abs(written.values - reference.values).max() < 1e-4
    np.testing.assert_allclose(written.of("knee_angle_r_moment"), dynamics.of("knee_angle_r"), atol=1e-9)
    assert len(motion.times_s) == len(reference.times_s)


def change(folder: Path, file: str, old: str, new: str) -> None:
    path = folder / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


SETUP, LOADS = "subject01_Setup_InverseDynamics.xml", "subject01_walk1_grf.xml"
MOTION, FORCES = "subject01_walk1_ik.mot", "subject01_walk1_grf.mot"


def test_missing_columns_are_said_or_refused_by_name(folder: Path) -> None:
    change(folder, MOTION, "mtp_angle_l", "another")
    _, _, result = run_dynamics(folder / SETUP)
    assert result.remarks == (f"{MOTION} has no column mtp_angle_l: it keeps its default.",)
    change(folder, FORCES, "1_ground_force_px", "elsewhere")
    with pytest.raises(InputError, match="1_ground_force_px"):
        run_dynamics(folder / SETUP)


def test_an_unknown_body_is_named(folder: Path) -> None:
    change(folder, LOADS, "calcn_r", "hoof_r")
    with pytest.raises(InputError, match="no body named hoof_r"):
        run_dynamics(folder / SETUP)


def test_degrees_that_claim_to_be_radians_are_refused(folder: Path) -> None:
    change(folder, MOTION, "inDegrees=yes", "inDegrees=no")
    with pytest.raises(InputError) as caught:
        run_dynamics(folder / SETUP)
    assert caught.value.code == "degrees-suspected"
    assert "inDegrees" in caught.value.hint


def test_forces_that_end_before_the_motion_are_refused(folder: Path) -> None:
    lines = (folder / FORCES).read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.strip() == "endheader") + 2
    kept = [re.sub(r"^nRows=\d+", "nRows=300", line) for line in lines[: start + 300]]
    (folder / FORCES).write_text("\n".join(kept) + "\n")
    with pytest.raises(InputError) as caught:
        run_dynamics(folder / SETUP)
    assert caught.value.code == "forces-too-short"


def test_a_time_range_beside_the_trial_is_refused(folder: Path) -> None:
    text = (folder / SETUP).read_text()
    start = text.index("<time_range>")
    (folder / SETUP).write_text(
        text[:start] + "<time_range>7 9</time_range>" + text[text.index("</time_range>") + 13 :]
    )
    with pytest.raises(InputError, match="nothing of it lies between 7 and 9 s"):
        run_dynamics(folder / SETUP)


@pytest.mark.parametrize("file", [SETUP, LOADS, MOTION, FORCES, "subject01_simbody.osim"])
def test_a_file_cut_in_half_is_an_error_with_its_name(folder: Path, file: str) -> None:
    path = folder / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError) as caught:
        run_dynamics(folder / SETUP)
    assert caught.value.code == "forces-too-short" or file in caught.value.message
