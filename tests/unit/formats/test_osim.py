"""OpenSim models: what is read, what is refused by name, what is written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.osim import read_osim
from gonio.formats.osim_writer import write_osim
from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.body.scaling import scale_model
from gonio.records import Markers

ROOT = Path(__file__).resolve().parents[3]
JOINTS = ROOT / "tests/golden/all_joints.osim"
BODY = ROOT / "models/bodies/fullbody_male.osim"

OLD = """<?xml version="1.0"?>
<OpenSimDocument Version="{version}"><Model name="old"><BodySet><objects>
<Body name="ground"><mass>0</mass><Joint/></Body>
<Body name="thigh"><mass>8</mass><mass_center>0 -0.2 0</mass_center>
<inertia_xx>0.1</inertia_xx><inertia_yy>0.03</inertia_yy><inertia_zz>0.1</inertia_zz><inertia_xy>0.01</inertia_xy>
<Joint><CustomJoint name="hip"><parent_body>ground</parent_body><location_in_parent>0 1 0</location_in_parent>
<CoordinateSet><objects><Coordinate name="flexion"><default_value>0.1</default_value><range>-1 2</range>
<clamped> true </clamped></Coordinate></objects></CoordinateSet>
<SpatialTransform><TransformAxis name="rotation1"><function/><coordinates/><axis>1 0 0</axis></TransformAxis>
<TransformAxis name="rotation3"><function/><coordinates>flexion</coordinates><axis>0 0 1</axis></TransformAxis>
<TransformAxis name="translation2"><coordinates>flexion</coordinates><axis>0 1 0</axis>
<function><natCubicSpline><x>-1 0 1 2</x><y>0 0.01 0.04 0.02</y></natCubicSpline></function></TransformAxis>
</SpatialTransform></CustomJoint></Joint></Body>
</objects></BodySet><MarkerSet><objects><Marker name="knee"><body>thigh</body><location>0 -0.4 0</location></Marker>
</objects></MarkerSet></Model></OpenSimDocument>"""


def changed(tmp_path, old, new, source=JOINTS):
    """A copy of a model with one piece of text replaced."""
    text = source.read_text()
    assert old in text
    path = tmp_path / "changed.osim"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize("version", [10901, 20303, 30000])
def test_old_layouts_with_identity_functions_left_out(tmp_path, version):
    (tmp_path / "old.osim").write_text(OLD.format(version=version))
    model = read_osim(tmp_path / "old.osim")
    assert model.gravity_m_s2.tolist() == [0, -9.80665, 0]  # not in the file: OpenSim's default
    assert model.coordinates.clamped.tolist() == [True]
    assert model.coordinates.rotational.tolist() == [True]
    assert model.bodies.inertia_body_kgm2[0, 0].tolist() == [0.1, 0.01, 0.0]
    place = marker_positions(model, np.array([[1.0]]))[0, 0]
    np.testing.assert_allclose(place, [0.4 * np.sin(1), 1.04 - 0.4 * np.cos(1), 0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<PinJoint ", "<HingeJoint ", "not well-formed"),
        ('<OpenSimDocument Version="40000">', '<OpenSimDocument Version="50000">', "document version '50000'"),
        ('<OpenSimDocument Version="40000">', '<OpenSimDocument Version="4.0">', "document version '4.0'"),
        ("<mass>1</mass>", "<mass>-1</mass>", "Body body0 .*mass -1"),
        ("<mass>1</mass>", "<mass>heavy</mass>", "<mass> of Body body0 .*not numbers"),
        ("<mass>1</mass>", "<mass>nan</mass>", "<mass> of Body body0 .*not finite"),
        ("<mass_center>0.1 -0.2 0.05", "<mass_center>0.1 -0.2", "<mass_center> of Body body0 .*holds 2 numbers"),
        ('<Body name="body1">', '<Body name="body0">', "Two body elements have the name body0"),
        ('<Coordinate name="pin">', '<Coordinate name="slide">', "Two coordinate elements have the name slide"),
        ('<Marker name="m00">', '<Marker name="m01">', "Two marker elements have the name m01"),
        ("<socket_parent>/bodyset/body0", "<socket_parent>/bodyset/body7", "closes a loop|form a cycle|hang"),
        ("<socket_parent>/bodyset/body1<", "<socket_parent>/bodyset/none<", "names '/bodyset/none'"),
        ('<SimmSpline name="function">', '<Sine name="function">', "not well-formed"),
        ("<x>-2 -1.2 -0.3", "<x>-2 -1.2 -1.3", "SimmSpline function .*ascending"),
        ("<coordinates>c1</coordinates>", "<coordinates>pin</coordinates>", "depends on pin"),
        ("<axis>0.6 0 0.8</axis>", "<axis>0 0 0</axis>", "axis of length 0"),
        ('<TransformAxis name="rotation1">', '<TransformAxis name="twist">', "transform axes twist"),
        ("CoordinateCouplerConstraint", "PointConstraint", "not well-formed"),
        ("<independent_coordinate_names>c1<", "<independent_coordinate_names>x1<", "couples 'd1' to 'x1'"),
        ("<independent_coordinate_names>c1<", "<independent_coordinate_names>d1<", "coupler of d1 leads back"),
        ("<default_value>0.1<", "<prescribed>maybe</prescribed><default_value>0.1<", "<prescribed> of Coordinate f1"),
        ("<socket_parent_frame>/bodyset/body3<", "<socket_parent_frame>/bodyset/bone<", "Marker m30 .*'/bodyset/bone'"),
    ],
)
def test_what_cannot_be_honoured_is_named(tmp_path, old, new, message):
    with pytest.raises(InputError, match=message) as raised:
        read_osim(changed(tmp_path, old, new))
    assert "changed.osim" in raised.value.message
    assert raised.value.hint


@pytest.mark.parametrize(
    ("kind", "other", "message"),
    [
        ("PinJoint", "EllipsoidJoint", "EllipsoidJoint j1 .*does not know"),
        ("BallJoint", "PinJoint", "PinJoint j4 .*3 coordinates"),
        ("CoordinateCouplerConstraint", "PointConstraint", "PointConstraint coupler"),
        ("PiecewiseLinearFunction", "Sine", "Sine function .*kind of function"),
    ],
)
def test_unknown_kinds_are_named(tmp_path, kind, other, message):
    path = tmp_path / "kinds.osim"
    path.write_text(JOINTS.read_text().replace(f"<{kind} ", f"<{other} ").replace(f"</{kind}>", f"</{other}>"))
    with pytest.raises(InputError, match=message):
        read_osim(path)


def test_a_constraint_that_is_switched_off_is_no_matter(tmp_path):
    path = changed(tmp_path, "<isEnforced>true", "<isEnforced>false")
    assert np.all(read_osim(path).coordinates.coupled_to == -1)


def test_a_cycle_of_bodies_is_named(tmp_path):
    path = changed(tmp_path, "<socket_parent>/ground<", "<socket_parent>/bodyset/body9<")
    with pytest.raises(InputError, match="form a cycle that never reaches ground"):
        read_osim(path)


def test_entities_and_document_types_are_refused(tmp_path):
    bomb = '<!DOCTYPE a [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
    path = changed(tmp_path, "<OpenSimDocument", bomb + "<OpenSimDocument")
    with pytest.raises(InputError, match="document type"):
        read_osim(path)


def test_files_of_other_kinds_are_refused(tmp_path):
    for text, message in (("", "not well-formed"), ("<a/>", "holds no Model"), ("\x00\x01", "not well-formed")):
        (tmp_path / "x.osim").write_text(text)
        with pytest.raises(InputError, match=message):
            read_osim(tmp_path / "x.osim")
    with pytest.raises(InputError, match="can't be read"):
        read_osim(tmp_path)


@pytest.mark.parametrize("source", [JOINTS, BODY], ids=lambda path: path.stem)
def test_a_scaled_model_reads_back_as_it_was_written(tmp_path, source):
    generic = read_osim(source)
    random = np.random.default_rng(5)
    factors = random.uniform(0.7, 1.4, size=(len(generic.bodies.names), 3))
    model = scale_model(generic, factors, mass_kg=66.0)
    fewer = Markers(
        names=("extra", *model.markers.names[:3]),
        body=np.array([-1, *model.markers.body[:3]]),
        location_body_m=random.normal(size=(4, 3)),
        fixed=np.array([True, False, True, False]),
    )
    model = replace(model, markers=fewer, name="person")
    write_osim(tmp_path / "person.osim", model, source)
    read = read_osim(tmp_path / "person.osim")
    q = random.normal(size=(5, len(model.coordinates.names)))
    np.testing.assert_allclose(body_poses(read, q), body_poses(model, q), atol=1e-12)
    np.testing.assert_array_equal(read.bodies.mass_kg, model.bodies.mass_kg)
    np.testing.assert_array_equal(read.bodies.inertia_body_kgm2, model.bodies.inertia_body_kgm2)
    np.testing.assert_array_equal(read.markers.location_body_m, fewer.location_body_m)
    assert read.markers.names == fewer.names
    assert read.markers.fixed.tolist() == fewer.fixed.tolist()
    assert read.name == "person"


def test_scaling_twice_multiplies_the_multiplier(tmp_path):
    generic = read_osim(BODY)
    factors = np.full((len(generic.bodies.names), 3), 1.5)
    write_osim(tmp_path / "once.osim", scale_model(generic, factors), BODY)
    once = read_osim(tmp_path / "once.osim")
    write_osim(tmp_path / "twice.osim", scale_model(once, factors), tmp_path / "once.osim")
    q = np.full((1, len(generic.coordinates.names)), 0.4)
    expected = body_poses(scale_model(scale_model(generic, factors), factors), q)
    np.testing.assert_allclose(body_poses(read_osim(tmp_path / "twice.osim"), q), expected, atol=1e-12)


def test_another_model_is_no_template(tmp_path):
    with pytest.raises(InputError, match="is not the model"):
        write_osim(tmp_path / "x.osim", read_osim(BODY), JOINTS)
