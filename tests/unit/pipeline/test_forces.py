"""The stages forces and dynamics: what they give, and what the report says where something is missing."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.force_coefficients import builtin_force_coefficients
from gonio.formats.osim import read_osim
from gonio.kernel.virtual_lab import SOLES, grow, press, truth_at, walk
from gonio.pipeline.describe_kinetics import describe_kinetics
from gonio.pipeline.dynamics import find_joint_torques, moment_curves
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.forces import choose_coefficients, find_forces
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.params import ForceParameters, Parameters, Subject
from gonio.pipeline.pressure import Measured
from gonio.records import FootForces, Motion
from gonio.resources import models_dir

COEFFICIENTS = builtin_force_coefficients()
CHOSEN = Parameters(subject=Subject(mass_kg=70.0))


@pytest.fixture(scope="module")
def walker():
    return walk(grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, 70.0), 1.25)


@pytest.fixture(scope="module")
def truth(walker):
    return truth_at(walker, np.arange(0, 2.2, 1 / 60))


@pytest.fixture(scope="module")
def found(walker, truth):
    frames, coordinates = truth.q.shape
    motion = Motion(
        coordinate_names=truth.coordinate_names,
        rotational=walker.body.coordinates.rotational,
        times_s=truth.times_s,
        values=truth.q,
        status=np.zeros(frames, dtype=np.uint8),
        iterations=np.zeros(frames, dtype=int),
        residual_rms_m=np.zeros(frames),
        # A degree in each angle, 3 mm in each place.
        covariance=np.tile(
            np.diag(np.where(walker.body.coordinates.rotational, np.deg2rad(1.0) ** 2, 0.003**2)), (frames, 1, 1)
        ).reshape(frames, coordinates, coordinates),
    )
    return BodyMotion(motion=motion, model=walker.body, two_step=motion, fit=None, distrusted="")


@pytest.fixture(scope="module")
def soles(walker):
    pressure = press(walker, errors=replace(SOLES["realistic"], offset_s=0.0, gaps=0.0), duration_s=2.3).pressure
    return Measured(pressure=pressure, clock=None, plates=None)


def codes(*outcomes):
    return {f.code for outcome in outcomes for f in outcome.findings}


def test_soles_give_knee_torques_with_bands(found, soles, truth):
    forces = find_forces(found, soles, CHOSEN, COEFFICIENTS)
    torques = find_joint_torques(found, soles, forces.value, CHOSEN, COEFFICIENTS)
    assert forces.value.methods == ("template", "template")
    assert codes(forces) == {"forces-method", "forces-gain"}
    assert not torques.findings
    inside = slice(6, -6)
    for name in ("knee_angle_r", "knee_angle_l"):
        index = torques.value.index(name)
        error_nm = (torques.value.values[:, index] - truth.moment_of(name))[inside]
        # The bar end to end is 0.10 Nm/kg of 70 kg.
        assert np.sqrt((error_nm**2).mean()) < 7.0
        assert (np.abs(error_nm) <= torques.value.band[inside, index]).mean() > 0.85
    moments = moment_curves(found, torques.value)
    assert {(m.quantity, m.side) for m in moments} >= {("knee_extension_moment", "right"), ("ankle_power", "left")}
    plantarflexion = next(m for m in moments if m.quantity == "ankle_plantarflexion_moment" and m.side == "right")
    assert plantarflexion.values.max() > 1.0  # Nm/kg at push-off in any walk, and never as much the other way
    assert plantarflexion.values.min() > -0.5
    described = describe_kinetics(forces.value, torques.value, found, COEFFICIENTS.source)
    assert described.task == "walking"
    assert len(described.torques) == 6
    assert len(described.feet[0].up_n) == len(truth.times_s)


def test_plates_take_precedence(found, soles, truth):
    plates = FootForces(
        times_s=truth.times_s,
        wrench=truth.wrench,
        cop_lab_m=truth.cop_lab_m,
        shared=np.zeros(len(truth.times_s), dtype=bool),
    )
    for measured in (Measured(pressure=None, clock=None, plates=plates), replace(soles, plates=plates)):
        forces = find_forces(found, measured, CHOSEN, COEFFICIENTS)
        assert forces.value.methods == ("plates", "plates")
        assert codes(forces) == set()
        torques = find_joint_torques(found, measured, forces.value, CHOSEN, COEFFICIENTS).value
        index = torques.index("knee_angle_r")
        error_nm = (torques.values[:, index] - truth.moment_of("knee_angle_r"))[6:-6]
        # What the movement's low-pass of 6 Hz takes.
        assert np.sqrt((error_nm**2).mean()) < 3.0


def test_without_a_mass_there_are_angles_but_no_torques(found, soles):
    forces = find_forces(found, soles, Parameters(), COEFFICIENTS)
    assert forces.value is None
    assert codes(forces) == {"torque-mass-missing"}
    assert find_joint_torques(found, soles, None, Parameters(), COEFFICIENTS).value is None
    assert moment_curves(found, None) == ()
    assert describe_kinetics(None, None, found, "") is None


def test_without_soles_and_plates_nothing_is_said(found):
    nothing = find_forces(found, Measured(pressure=None, clock=None, plates=None), CHOSEN, COEFFICIENTS)
    assert nothing.value is None
    assert nothing.findings == ()


def test_one_foot_only_is_said(found, soles):
    one = soles.pressure.vertical_n.copy()
    one[:, 1] = 0.0
    forces = find_forces(found, replace(soles, pressure=replace(soles.pressure, vertical_n=one)), CHOSEN, COEFFICIENTS)
    assert "forces-one-foot" in codes(forces)
    torques = find_joint_torques(found, soles, forces.value, CHOSEN, COEFFICIENTS)
    assert "residuals-high" in codes(torques)


def test_no_contact_is_said(found, soles):
    none = replace(soles, pressure=replace(soles.pressure, vertical_n=0 * np.nan_to_num(soles.pressure.vertical_n)))
    assert codes(find_forces(found, none, CHOSEN, COEFFICIENTS)) == {"forces-missing"}


def test_a_slow_walk_and_a_landing_are_said(found, soles):
    landing = replace(CHOSEN, forces=ForceParameters(task="landing"))
    assert "forces-indicative" in codes(find_forces(found, soles, landing, COEFFICIENTS))
    crawl = replace(found.motion, times_s=2 * found.motion.times_s)
    pressure = replace(soles.pressure, times_s=2 * soles.pressure.times_s)
    slow = find_forces(replace(found, motion=crawl), replace(soles, pressure=pressure), CHOSEN, COEFFICIENTS)
    assert slow.value.methods == ("pivot", "pivot")
    assert "forces-outside-range" in codes(slow)


def test_a_labs_own_coefficients_are_used_and_named(found, soles, tmp_path):
    own = tmp_path / "my.forces.toml"
    ours = (models_dir() / "forces" / "default.toml").read_text()
    source = ours.partition('source = "')[2].partition('"')[0]
    # Half the lever of the template is another torque.
    own.write_text(ours.replace(source, "Eight of our own").replace("lever = [0.60, 0.4693]", "lever = [0.30, 0.4693]"))
    (tmp_path / "cam1.mp4").touch()
    (file,) = [f for f in find_capture_files(tmp_path) if f.role == "force_coefficients"]
    theirs = choose_coefficients([file])
    values = [
        find_joint_torques(found, soles, find_forces(found, soles, CHOSEN, c).value, CHOSEN, c).value
        for c in (choose_coefficients([]), theirs)
    ]
    assert np.nanmax(np.abs(values[0].values - values[1].values)) > 5.0
    forces = find_forces(found, soles, CHOSEN, theirs).value
    assert describe_kinetics(forces, values[1], found, theirs.source).coefficients_source == "Eight of our own"
    with pytest.raises(InputError, match="2 files"):
        choose_coefficients([file, file])
