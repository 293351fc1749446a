"""What soles and plates measured, from the files to the video's clock, and what the report says about it."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gonio.errors import InputError
from gonio.formats.force_coefficients import builtin_force_coefficients
from gonio.formats.osim import read_osim
from gonio.formats.pressure_csv import write_pressure
from gonio.kernel.virtual_lab import SOLES, grow, press, truth_at, walk
from gonio.pipeline.dynamics import find_joint_torques
from gonio.pipeline.forces import find_forces
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.params import ForceParameters, Parameters, Subject
from gonio.pipeline.pressure import Sensors, measure_forces, read_sensors
from gonio.pipeline.run import CaptureFile
from gonio.records import FootPressure, ForcePlates, Motion
from gonio.resources import models_dir

DURATION_S = 2.5
CHOSEN = Parameters(subject=Subject(mass_kg=70.0))
HARDWARE = replace(CHOSEN, forces=ForceParameters(synchronization="hardware"))


@pytest.fixture(scope="module")
def walker():
    return walk(grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, 70.0), 1.25)


def motion_of(walker, times_s):
    truth = truth_at(walker, times_s)
    motion = Motion(
        coordinate_names=truth.coordinate_names,
        rotational=walker.body.coordinates.rotational,
        times_s=times_s,
        values=truth.q,
        status=np.zeros(len(times_s), dtype=np.uint8),
        iterations=np.zeros(len(times_s), dtype=int),
        residual_rms_m=np.zeros(len(times_s)),
    )
    return BodyMotion(motion=motion, model=walker.body, two_step=motion, fit=None, distrusted="")


@pytest.fixture(scope="module")
def motion(walker):
    return motion_of(walker, np.arange(0, DURATION_S, 1 / 60))


def soles(walker, **changes):
    errors = replace(SOLES["clean"], **changes)
    return press(walker, errors=errors, duration_s=DURATION_S + 0.3, rate_hz=50.0).pressure


@pytest.fixture
def sensors(tmp_path):
    def read(pressure, spoil=None, card=""):
        write_pressure(tmp_path / "soles.csv", pressure)
        files = [CaptureFile(path=tmp_path / "soles.csv", name="my soles.csv", role="pressure")]
        if spoil:
            spoil(tmp_path / "soles.csv")
        if card:
            (tmp_path / "c.toml").write_text(card)
            files.append(CaptureFile(path=tmp_path / "c.toml", name="c.toml", role="pressure_card"))
        return read_sensors(files, DURATION_S).value

    return read


def said(outcome):
    return {found.code: found for found in outcome.findings}


def test_a_session_without_soles_and_plates_measures_nothing(motion):
    found = read_sensors([], DURATION_S)
    assert (found.value.stream, found.value.plates, found.findings) == (None, None, ())
    measured = measure_forces(found.value, motion, CHOSEN)
    assert (measured.value.pressure, measured.value.plates, measured.findings) == (None, None, ())


def test_the_offset_is_found_taken_out_and_said(walker, motion, sensors):
    pressure = soles(walker, offset_s=0.06)
    outcome = measure_forces(sensors(pressure), motion, CHOSEN)
    assert set(said(outcome)) == {"pressure-synchronized"}
    assert outcome.value.clock.offset_s == pytest.approx(0.06, abs=0.006)
    np.testing.assert_allclose(
        outcome.value.pressure.times_s, pressure.times_s - outcome.value.clock.offset_s, atol=1e-6
    )
    np.testing.assert_allclose(outcome.value.pressure.vertical_n, pressure.vertical_n, atol=1e-6)


def test_a_hardware_trigger_is_honoured_and_checked(walker, motion, sensors):
    outcome = measure_forces(sensors(soles(walker)), motion, HARDWARE)
    assert outcome.findings == ()
    np.testing.assert_allclose(outcome.value.pressure.times_s, soles(walker).times_s, atol=1e-6)
    late = measure_forces(sensors(soles(walker, offset_s=0.08)), motion, HARDWARE)
    assert late.value.pressure is not None
    assert said(late)["pressure-hardware-late"].value == pytest.approx(80, abs=8)


def test_noise_below_zero_is_said(walker, sensors, tmp_path):
    pressure = soles(walker)
    sensors(replace(pressure, vertical_n=np.where(pressure.vertical_n > 0, pressure.vertical_n, -5.0)))
    files = [CaptureFile(path=tmp_path / "soles.csv", name="soles.csv", role="pressure")]
    (found,) = read_sensors(files, DURATION_S).findings
    assert found.code == "pressure-below-zero"
    assert found.value == pytest.approx(100 * float((pressure.vertical_n == 0).mean()), abs=1)


def test_swapped_feet_are_not_used(walker, motion, sensors):
    pressure = soles(walker)
    swapped = replace(
        pressure, vertical_n=pressure.vertical_n[:, ::-1].copy(), cop_foot_m=pressure.cop_foot_m[:, ::-1].copy()
    )
    for chosen in (CHOSEN, HARDWARE):
        outcome = measure_forces(sensors(swapped), motion, chosen)
        assert outcome.value.pressure is None
        assert said(outcome)["pressure-feet-swapped"].severity == "serious"


def test_another_trials_stream_is_not_used(walker, motion, sensors):
    other = soles(walk(walker.body, 0.9), offset_s=0.1)
    outcome = measure_forces(sensors(other), motion, CHOSEN)
    assert outcome.value.pressure is None
    assert said(outcome)["pressure-not-synchronized"].severity == "serious"


def stand(walker, body_sway=0.0):
    """Stand on the right leg, the left knee bent."""
    model, times_s = walker.body, np.arange(0, DURATION_S, 1 / 60)
    q = np.tile(model.coordinates.default, (len(times_s), 1))
    q[:, [model.coordinates.names.index(name) for name in ("hip_flexion_l", "knee_angle_l")]] = 0.5, 1.2
    q += body_sway * np.sin(2 * np.pi * 0.7 * times_s)[:, None] * model.coordinates.rotational
    found = motion_of(walker, times_s)
    moved = replace(found.motion, values=q)
    return replace(found, motion=moved, two_step=moved)


def one_sole(times_s, force_n):
    place_m = np.full((len(times_s), 2, 2), np.nan)
    place_m[:, 0] = 0.12, 0.0
    return FootPressure(times_s=times_s, vertical_n=np.stack([force_n, 0 * force_n], axis=1), cop_foot_m=place_m)


def test_standing_on_one_leg_is_measured(walker, sensors):
    times_s = np.arange(-0.5, DURATION_S + 0.5, 0.05)
    outcome = measure_forces(sensors(one_sole(times_s, 70 * 9.80665 + np.sin(9 * times_s))), stand(walker), CHOSEN)
    assert set(said(outcome)) == {"pressure-clock-idle"}
    assert outcome.value.pressure is not None
    forces = find_forces(stand(walker), outcome.value, CHOSEN, builtin_force_coefficients())
    assert {f.code for f in forces.findings} == {"forces-method", "forces-gain", "forces-one-foot"}
    torques = find_joint_torques(stand(walker), outcome.value, forces.value, CHOSEN, builtin_force_coefficients()).value
    assert np.isfinite(torques.values).all()
    # The weight is on the right sole: a newton of what the sole shows, and what filters do to it, is left over.
    assert np.abs(torques.residual[10:-10, 1]).max() < 5.0


def test_a_stream_that_moves_is_not_idle(walker, sensors):
    """Loads come and go while the body stands: it is another trial's."""
    times_s = np.arange(-0.5, DURATION_S + 0.5, 0.05)
    force_n = 70 * 9.80665 * (1 + 0.3 * np.sin(5 * times_s))
    outcome = measure_forces(sensors(one_sole(times_s, force_n)), stand(walker), CHOSEN)
    assert outcome.value.pressure is None
    assert set(said(outcome)) == {"pressure-not-synchronized"}


def test_a_silent_sole_of_a_walk_is_not_a_foot_in_the_air(walker, motion, sensors):
    pressure = soles(walker)
    one = replace(pressure, vertical_n=pressure.vertical_n * [1.0, 0.0])
    for chosen in (CHOSEN, HARDWARE):
        outcome = measure_forces(sensors(one), motion, chosen)
        assert outcome.value.pressure is None
        assert said(outcome)["pressure-foot-silent"].where == "left"


COUNTS = """
kind = "forces"
[time]
column = "time_s"
unit = "s"
[force]
unit = "counts"
saturation = 700
[cop]
unit = "m"
[right]
force = "right_force_n"
cop = ["right_along_m", "right_across_m"]
[left]
force = "left_force_n"
cop = ["left_along_m", "left_across_m"]
"""


def test_counts_are_scaled_to_the_bodys_weight(walker, motion, sensors):
    pressure = soles(walker)
    counts = replace(pressure, vertical_n=np.minimum(0.8 * pressure.vertical_n, 700.0))
    outcome = measure_forces(sensors(counts, card=COUNTS), motion, CHOSEN)
    assert set(said(outcome)) == {"pressure-synchronized", "pressure-uncalibrated"}
    assert outcome.value.pressure.vertical_n.sum(axis=1).mean() == pytest.approx(70 * 9.80665, rel=1e-6)


def test_what_is_wrong_with_the_soles_is_said(walker, motion, sensors):
    pressure = soles(walker)
    force = np.where(pressure.vertical_n > 0, 0.7 * pressure.vertical_n, 0.0)
    force[:, 1] += 40.0
    force[40:60] = np.nan
    limited = replace(pressure, vertical_n=np.minimum(force, 400.0))
    outcome = measure_forces(sensors(limited, card=COUNTS.replace("counts", "N").replace("700", "400")), motion, CHOSEN)
    found = said(outcome)
    # 20 of 125 samples and the steps into them.
    assert found["pressure-gaps"].value == pytest.approx(100 * 20.5 / 125, abs=2)
    assert found["pressure-not-zero"].where == "left"
    assert found["pressure-not-zero"].value == pytest.approx(40, abs=1)
    assert {f.where for f in outcome.findings if f.code == "pressure-saturated"} == {"right", "left"}
    assert found["pressure-gain"].value < 85


def test_files_that_are_wrong_stop_before_the_work_begins(walker, sensors):
    with pytest.raises(InputError, match=r"my soles\.csv") as raised:
        sensors(soles(walker), lambda path: path.write_text("time_s\n1\n"))
    assert raised.value.code == "pressure-unreadable"


def test_plates_take_their_feet(walker, motion):
    truth = truth_at(walker, np.arange(0, DURATION_S, 1e-2))
    plates = ForcePlates(
        source="virtual",
        times_s=truth.times_s,
        force_lab_n=truth.wrench[..., :3],
        cop_lab_m=truth.cop_lab_m,
        free_moment_nm=np.zeros(truth.wrench.shape[:2]),
        corners_lab_m=np.full((2, 4, 3), np.nan),
    )
    outcome = measure_forces(Sensors(stream=None, plates=plates), motion, CHOSEN)
    assert outcome.findings == ()
    right, left = outcome.value.plates.wrench[:, 0, 1], outcome.value.plates.wrench[:, 1, 1]
    both = np.isfinite(right) & np.isfinite(left)
    assert (right + left)[both][10:-10].mean() == pytest.approx(70 * 9.80665, rel=0.05)
    elsewhere = replace(plates, cop_lab_m=plates.cop_lab_m + np.array([0.0, 0.0, 2.0]))
    missed = measure_forces(Sensors(stream=None, plates=elsewhere), motion, CHOSEN)
    assert set(said(missed)) == {"plates-not-used"}


MAT = """
kind = "mat"
[time]
column = "t"
unit = "s"
[sensor]
unit = "N"
[mat]
list_column = "cells"
separator = " "
grid = { rows = 140, columns = 24, first_mm = [-2200, -345], pitch_mm = [30, 30] }
"""


def lay_mat(truth, ahead_s, path):
    """Write what a mat of 4.2 m × 0.7 m shows: each foot's force on the four sensors about its centre."""
    cells = np.zeros((len(truth.times_s), 140, 24))
    for foot in range(2):
        loaded = np.flatnonzero(truth.wrench[:, foot, 1] > 1.0)
        row, column = (truth.cop_lab_m[loaded, foot][:, [0, 2]] - [-2.2, -0.345]).T / 0.030
        for rows, columns in ((0, 0), (0, 1), (1, 0), (1, 1)):
            share = np.abs(1 - rows - row % 1) * np.abs(1 - columns - column % 1)
            place = (loaded, row.astype(int) + rows, column.astype(int) + columns)
            np.add.at(cells, place, share * truth.wrench[loaded, foot, 1])
    lines = [" ".join("0" if cell == 0 else f"{cell:.3f}" for cell in sample.ravel()) for sample in cells]
    table = pd.DataFrame({"t": truth.times_s + ahead_s, "cells": lines})
    table.to_csv(path, index=False)


def test_a_mat_is_shared_out_to_the_feet_above_it(walker, motion, tmp_path):
    truth = truth_at(walker, np.arange(0, DURATION_S, 0.02))
    lay_mat(truth, 0.05, tmp_path / "mat.csv")
    (tmp_path / "c.toml").write_text(MAT)
    files = [
        CaptureFile(path=tmp_path / "mat.csv", name="mat.csv", role="pressure"),
        CaptureFile(path=tmp_path / "c.toml", name="c.toml", role="pressure_card"),
    ]
    outcome = measure_forces(read_sensors(files, DURATION_S).value, motion, CHOSEN)
    assert set(said(outcome)) <= {"pressure-synchronized", "pressure-gaps"}
    assert outcome.value.clock.offset_s == pytest.approx(0.05, abs=0.008)
    found, exact = outcome.value.pressure, soles(walker)
    known = np.isfinite(found.vertical_n)
    assert known.mean() > 0.95
    assert np.abs(found.vertical_n - truth.wrench[..., 1])[known].max() < 2.0
    pressed = known & (truth.wrench[..., 1] > 100.0)
    # Within the error of the offset, a centre of pressure that runs at 0.5 m/s moves 4 mm; beyond the toe joint the sole
    # bends away from the line of the heel.
    away_m = (found.cop_foot_m - exact.cop_foot_m[: len(found.times_s)])[pressed]
    assert np.sqrt(np.mean(away_m**2)) < 0.010


def test_a_real_messy_stream_that_is_not_of_this_trial_is_refused_with_a_reason(insole_iscas, motion, tmp_path):
    card = tmp_path / "insole.toml"
    feet = "\n".join(
        f'[{side}]\nlist_column = "{column}"\n'
        "grid = { rows = 33, columns = 15, first_mm = [256, -49], pitch_mm = [-8, 7] }"
        for side, column in (("right", "Matrix_1"), ("left", "Matrix_0"))
    )
    card.write_text(
        'kind = "sensors"\n[time]\ncolumn = "Timestamp"\nunit = "s"\nzero = 1727036080.0\n'
        f'[sensor]\nunit = "counts"\n{feet}\n'
    )
    table = insole_iscas / "walking_cjj_neiba.csv"
    files = [
        CaptureFile(path=table, name=table.name, role="pressure"),
        CaptureFile(path=card, name=card.name, role="pressure_card"),
    ]
    outcome = measure_forces(read_sensors(files, DURATION_S).value, motion, CHOSEN)
    assert outcome.value.pressure is None
    assert "pressure-not-synchronized" in said(outcome) or "pressure-feet-swapped" in said(outcome)
    trusted = measure_forces(read_sensors(files, DURATION_S).value, motion, HARDWARE)
    assert {"pressure-uncalibrated", "pressure-rate-low", "pressure-hardware-unconfirmed"} <= set(said(trusted))
