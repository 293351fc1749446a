"""OpenSim's Gait2354 example: inverse kinematics against OpenSim 4.6's own converged answer."""

from pathlib import Path

import numpy as np
import pytest
from lxml import etree

from gonio.formats.osim import read_osim
from gonio.formats.trc import read_trc
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import SOLVED, Tasks

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "opensim_gait2354"
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the Gait2354 example is not ours to distribute: it is read from ../shared/data"
)


def read_setup(model, names) -> Tasks:
    """The weights of the example's own setup; markers that the trial lacks weigh nothing."""
    setup = etree.parse(DATA / "subject01_Setup_IK.xml")
    marker_weights = np.zeros(len(model.markers.names))
    weights, targets = np.zeros(len(model.coordinates.names)), np.zeros(len(model.coordinates.names))
    for task in setup.iter("IKMarkerTask"):
        if task.get("name") in model.markers.names and task.get("name") in names:
            marker_weights[model.markers.index(task.get("name"))] = float(task.findtext("weight"))
    for task in setup.iter("IKCoordinateTask"):
        weights[model.coordinates.index(task.get("name"))] = float(task.findtext("weight"))
        targets[model.coordinates.index(task.get("name"))] = float(task.findtext("value"))
    return Tasks(marker_weights=marker_weights, coordinate_weights=weights, coordinate_targets=targets)


@pytest.fixture(scope="module")
def solved():
    model = read_osim(DATA / "subject01_simbody.osim")
    trial = read_trc(DATA / "subject01_walk1.trc")
    observed = np.full((len(trial.times_s), len(model.markers.names), 3), np.nan)
    for marker, name in enumerate(model.markers.names):
        if name in trial.names:
            observed[:, marker] = trial.xyz_m[:, trial.names.index(name)]
    return model, solve_motion(model, read_setup(model, trial.names), observed, trial.times_s)


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


def test_all_versions_of_the_model_are_the_same_tree():
    models = [read_osim(path) for path in sorted(DATA.glob("gait2354_simbody*.osim"))]
    assert len(models) == 4
    for other in models[1:]:
        assert other.mass_kg == pytest.approx(models[0].mass_kg, rel=1e-9)
        assert other.coordinates.names == models[0].coordinates.names
        assert other.bodies.names == models[0].bodies.names
        np.testing.assert_allclose(other.gravity_m_s2, models[0].gravity_m_s2)
