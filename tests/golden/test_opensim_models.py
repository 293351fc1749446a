"""Models and forward kinematics against OpenSim 4.6's own answers (all_joints.json, made by make_all_joints.py)."""

import json
from pathlib import Path

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import couple, marker_positions

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def reference() -> dict:
    return json.loads((HERE / "all_joints.json").read_text())


@pytest.fixture(scope="module")
def model():
    return read_osim(HERE / "all_joints.osim")


def test_every_kind_of_joint_and_function_puts_markers_where_opensim_does(model, reference):
    q = np.array([pose["q"] for pose in reference["poses"]])
    expected = np.array([pose["markers_m"] for pose in reference["poses"]])
    assert list(model.coordinates.names) == reference["coordinates"]
    # OpenSim assembles the coupler iteratively, to 1e-12; everything else is rounding in sums of ten transforms.
    np.testing.assert_allclose(marker_positions(model, q), expected, rtol=0, atol=1e-10)


def test_couplers_follow_their_source_as_in_opensim(model, reference):
    q = np.array([pose["q"] for pose in reference["poses"]])
    asked = q.copy()
    asked[:, model.coordinates.index("d1")] = 99.0
    np.testing.assert_allclose(couple(model, asked), q, rtol=0, atol=1e-9)


def test_masses_and_what_is_an_angle_agree_with_opensim(model, reference):
    assert model.mass_kg == pytest.approx(reference["mass_kg"], rel=1e-12)
    assert model.coordinates.rotational.tolist() == reference["rotational"]


def test_the_model_file_is_what_its_script_makes():
    script = HERE / "make_all_joints.py"
    namespace = {"__name__": "make", "__file__": str(script)}
    exec(compile(script.read_text(), str(script), "exec"), namespace)
    assert namespace["build"]() == (HERE / "all_joints.osim").read_text()
