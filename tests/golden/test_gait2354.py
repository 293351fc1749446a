"""OpenSim's Gait2354 example: scaling and inverse kinematics against OpenSim's own answers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lxml import etree

from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim, read_osim_markers
from gonio.formats.osim_setup import read_kinematics_setup, read_scale_setup
from gonio.formats.osim_writer import write_osim
from gonio.formats.trc import read_trc
from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.body.placement import place_markers
from gonio.kernel.body.scaling import measure_scale_factors, scale_model
from gonio.kernel.kinematics.clinical import clinical_deg, find_clinical_angles
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import SOLVED

MODELS = Path(__file__).resolve().parents[2] / "models"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "opensim_gait2354"
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the Gait2354 example is not ours to distribute: it is read from ../shared/data"
)


def observe(model, trial, time_range_s=(-np.inf, np.inf)):
    """The trial's markers in the model's order, within a range of time."""
    inside = (trial.times_s >= time_range_s[0] - 1e-9) & (trial.times_s <= time_range_s[1] + 1e-9)
    observed = np.full((inside.sum(), len(model.markers.names), 3), np.nan)
    for marker, name in enumerate(model.markers.names):
        if name in trial.names:
            observed[:, marker] = trial.xyz_m[inside, trial.names.index(name)]
    return observed, trial.times_s[inside]


@pytest.fixture(scope="module")
def solved():
    setup = read_kinematics_setup(DATA / "subject01_Setup_IK.xml")
    model, trial = read_osim(setup.model_file), read_trc(setup.marker_file)
    return model, solve_motion(model, setup.tasks.for_model(model, trial.names), *observe(model, trial))


def test_angles_agree_with_opensim_at_accuracy_1e9(solved):
    model, motion = solved
    reference = np.genfromtxt(
        DATA / "opensim46" / "ik_angles_shippedmodel_acc1e-9_t0-2.5.csv", delimiter=",", names=True
    )
    assert np.all(motion.status == SOLVED)
    ours = np.where(model.coordinates.rotational, np.degrees(motion.values), motion.values)
    theirs = np.stack([reference[name] for name in motion.coordinate_names], axis=-1)
    # The issue asks for 0.01°. Measured: 1.9e-4°, of which 1.8e-4 is what OpenSim itself leaves at 1e-9.
    assert np.abs(ours - theirs).max() < 1e-3


@pytest.fixture(scope="module")
def scaled():
    setup = read_scale_setup(DATA / "subject01_Setup_Scale.xml")
    model = read_osim(setup.model_file)
    model = replace(model, markers=read_osim_markers(setup.marker_set_file, model))
    static = read_trc(setup.measured_file)
    measurements = tuple(m for m in setup.measurements if m.bodies[0] in model.bodies.names)  # it has no patellae
    observed, _ = observe(model, static, setup.measured_range_s)
    measured = measure_scale_factors(model, measurements, observed, average="mean", symmetric=False)
    factors = measured.copy()
    for body, manual in setup.manual_factors.items():
        factors[model.bodies.index(body)] = manual
    return setup, model, static, factors, scale_model(model, factors, mass_kg=setup.mass_kg)


def test_scale_factors_are_opensims(scaled):
    _, model, _, factors, _ = scaled
    applied = etree.parse(DATA / "OutputReference" / "subject01_scaleSet_applied.xml")
    for scale in applied.iter("Scale"):
        if scale.findtext("segment") != "ground":
            theirs = np.array([float(word) for word in scale.findtext("scales").split()])
            # The issue asks for 1e-4; the file has six digits.
            np.testing.assert_allclose(factors[model.bodies.index(scale.findtext("segment"))], theirs, atol=5e-6)


def test_the_scaled_model_is_opensims(scaled):
    *_, ours = scaled
    theirs = read_osim(DATA / "OutputReference" / "subject01_simbody.osim")
    np.testing.assert_allclose(ours.bodies.mass_kg, theirs.bodies.mass_kg, atol=1e-6)
    np.testing.assert_allclose(ours.bodies.com_body_m, theirs.bodies.com_body_m, atol=2e-6)
    q = np.random.default_rng(0).normal(0, 0.5, size=(10, len(ours.coordinates.names)))
    # The reference was written with six digits, and its scale factors were rounded to six as well.
    np.testing.assert_allclose(body_poses(ours, q), body_poses(theirs, q), atol=2e-5)


def test_placed_markers_lie_where_the_static_trial_saw_them(scaled):
    setup, _, static, _, model = scaled
    observed, _ = observe(model, static, setup.placing.time_range_s)
    placed, pose = place_markers(model, setup.placing.tasks.for_model(model, static.names), observed)
    assert pose.status[0] == SOLVED
    again, _ = place_markers(placed, setup.placing.tasks.for_model(placed, static.names), observed)
    # OpenSim's own placement differs by up to 10 mm (Top.Head): its static pose stops at a higher cost (2.01657e-4
    # against our 2.01592e-4), since markers of weight 1 beside others of 1000 hardly count at its accuracy of 1e-5.
    np.testing.assert_allclose(again.markers.location_body_m, placed.markers.location_body_m, atol=1e-3)


@pytest.mark.parametrize("name", ["gait2354_simbody.osim", "gait2354_simbody_v10901_original.osim"])
def test_a_scaled_model_is_written_into_its_own_file(scaled, name, tmp_path):
    generic = read_osim(DATA / name)
    model = scale_model(generic, scaled[3], mass_kg=60.0)
    model = replace(model, markers=scaled[4].markers)
    write_osim(tmp_path / "person.osim", model, DATA / name)
    read = read_osim(tmp_path / "person.osim")
    q = np.random.default_rng(1).normal(0, 0.5, size=(5, len(model.coordinates.names)))
    np.testing.assert_allclose(body_poses(read, q), body_poses(model, q), atol=1e-12)
    np.testing.assert_array_equal(read.bodies.inertia_body_kgm2, model.bodies.inertia_body_kgm2)
    np.testing.assert_array_equal(read.markers.location_body_m, model.markers.location_body_m)
    assert read.mass_kg == pytest.approx(60.0)
    before, after = (etree.parse(path) for path in (DATA / name, tmp_path / "person.osim"))
    forces = [etree.tostring(document.find(".//ForceSet"), method="c14n") for document in (before, after)]
    assert forces[0] == forces[1]  # muscles are carried through unchanged


def test_all_versions_of_the_model_are_the_same_tree():
    models = [read_osim(path) for path in sorted(DATA.glob("gait2354_simbody*.osim"))]
    assert len(models) == 4
    for other in models[1:]:
        assert other.mass_kg == pytest.approx(models[0].mass_kg, rel=1e-9)
        assert other.coordinates.names == models[0].coordinates.names
        assert other.bodies.names == models[0].bodies.names
        np.testing.assert_allclose(other.gravity_m_s2, models[0].gravity_m_s2)
        q = np.random.default_rng(2).normal(0, 0.5, size=(5, len(other.coordinates.names)))
        # The same numbers with six digits here and eight there.
        np.testing.assert_allclose(body_poses(other, q), body_poses(models[0], q), atol=1e-5)


def test_keypoints_drive_a_labs_own_model():
    """The built-in body's keypoints on Gait2354 give the built-in body's knee angles, flexion negative or not."""
    own, card = read_osim(MODELS / "bodies" / "fullbody_male.osim"), MODELS / "markersets" / "blazepose33.toml"
    body = attach(own, read_markerset(card))
    q = np.tile(body.coordinates.default, (60, 1))
    bend = 0.6 + 0.5 * np.sin(np.linspace(0, 2 * np.pi, 60))
    q[:, body.coordinates.index("knee_angle_r")] = bend
    q[:, body.coordinates.index("hip_flexion_r")] = 0.5 * bend
    markerset = read_markerset(MODELS / "markersets" / "gait2354_gait2392" / "blazepose33.toml")
    generic = attach(read_osim(DATA / "gait2354_simbody.osim"), markerset)
    seen = marker_positions(body, q)[:, [body.markers.index(name) for name in generic.markers.names]]
    person = scale_model(generic, measure_scale_factors(generic, markerset.measurements, seen), mass_kg=70.0)
    motion = solve_motion(person, make_tasks(person, markerset), seen, np.arange(60) / 60)
    (knee,) = (a for a in find_clinical_angles(person) if (a.name, a.side) == ("knee_flexion", "right"))
    assert knee.sign == -1.0
    # Two models of a knee and a foot, and priors: on real keypoints they differ by 0.6 degrees on average, too.
    assert np.abs(clinical_deg(motion, knee) - np.degrees(bend)).max() < 3.0
