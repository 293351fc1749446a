"""The built-in bodies: what they weigh, how they stand, and that their files are what their script makes."""

import sys
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.body.markerset import attach, find_joint_centre, make_tasks
from gonio.kernel.kinematics.clinical import find_clinical_angles

MODELS = Path(__file__).resolve().parents[2] / "models"
SEXES = ["male", "female"]
CARDS = sorted((MODELS / "markersets").glob("*.toml"))


@pytest.fixture(params=SEXES)
def model(request):
    return read_osim(MODELS / "bodies" / f"fullbody_{request.param}.osim")


def test_the_files_are_what_the_script_makes(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(MODELS / "bodies"), *sys.path])
    import build
    import segments

    for sex, person in (("male", segments.MAN), ("female", segments.WOMAN)):
        made = build.build(f"fullbody_{sex}", person)
        assert made == (MODELS / "bodies" / f"fullbody_{sex}.osim").read_bytes()


def test_masses_are_the_published_shares(model):
    bodies, total = model.bodies, model.mass_kg
    man = model.name == "fullbody_male"
    assert total == pytest.approx(80.5 if man else 63.9, abs=1e-6)
    thigh = bodies.mass_kg[bodies.index("femur_r")] / total
    assert thigh == pytest.approx(0.123 if man else 0.146, abs=1e-3)  # shares are rounded and sum to 100.2 or 100.4 %
    foot = bodies.mass_kg[[bodies.index("calcn_r"), bodies.index("toes_r")]].sum() / total
    assert foot == pytest.approx(0.012 if man else 0.010, abs=1e-4)


def test_inertias_are_of_real_bodies(model):
    for name, mass_kg, inertia in zip(
        model.bodies.names, model.bodies.mass_kg, model.bodies.inertia_body_kgm2, strict=True
    ):
        if mass_kg > 0:
            moments = np.linalg.eigvalsh(inertia)
            assert moments[0] > 0, name
            assert moments[2] <= moments[0] + moments[1], name


def test_it_stands_upright_with_level_feet_and_plausible_height(model):
    place = dict(zip(model.markers.names, marker_positions(model, model.coordinates.default[None])[0], strict=True))
    assert place["heel_r"][1] == pytest.approx(0.01, abs=0.002)
    stature_m = 1.77 if model.name == "fullbody_male" else 1.61
    assert place["vertex"][1] == pytest.approx(
        stature_m, abs=0.06
    )  # the mean lengths of Dumas 2007 add up 3 to 4 cm short
    assert place["shoulder_r"][2] > 0 > place["shoulder_l"][2]
    assert place["big_toe_r"][0] > place["heel_r"][0]


def test_left_is_the_mirror_image_of_right(model):
    q = model.coordinates.default.copy()
    for name in model.coordinates.names:
        if name.endswith(("_r", "_l")):
            q[model.coordinates.index(name)] = 0.3
    place = dict(zip(model.markers.names, marker_positions(model, q[None])[0], strict=True))
    for name in [name for name in place if name.endswith("_r")]:
        np.testing.assert_allclose(place[name[:-1] + "l"], place[name] * (1, 1, -1), atol=1e-9)


def test_positive_angles_flex(model):
    angles = {(angle.name, angle.side): angle for angle in find_clinical_angles(model)}
    assert len(angles) == 6
    assert all(angle.sign == 1.0 for angle in angles.values())
    q = np.tile(model.coordinates.default, (2, 1))
    q[1, model.coordinates.index("knee_angle_r")] = 1.0
    straight, bent = body_poses(model, q)[:, model.bodies.index("calcn_r"), :3, 3]
    assert bent[0] < straight[0] - 0.2  # the heel goes back


def test_a_joint_can_carry_a_keypoint(model):
    """The centre of a joint, in its parent body, is where the built-in body has a marker."""
    for joint, marker in (("hip_r", "hip_r"), ("ankle_l", "ankle_l"), ("elbow_l", "elbow_l")):
        body, location_m = find_joint_centre(model, joint)
        index = model.markers.index(marker)
        assert body == model.markers.body[index]
        np.testing.assert_allclose(location_m, model.markers.location_body_m[index], atol=1e-9)
    with pytest.raises(InputError, match="no joint named jaw"):
        find_joint_centre(model, "jaw")


@pytest.mark.parametrize("card", sorted((MODELS / "markersets").glob("*/*.toml")), ids=lambda path: path.parent.stem)
def test_cards_for_the_models_of_labs_measure_what_they_place(card):
    markerset = read_markerset(card)
    for measurement in markerset.measurements:
        for pair in measurement.pairs:
            assert set(pair) <= set(markerset.keypoint_names)


@pytest.mark.parametrize("card", CARDS, ids=lambda path: path.stem)
def test_each_card_fits_both_bodies(model, card):
    markerset = read_markerset(card)
    fitted = attach(model, markerset)
    tasks = make_tasks(fitted, markerset)
    assert fitted.markers.names == markerset.keypoint_names
    assert len(tasks.marker_weights) == len(markerset.keypoint_names)
    for measurement in markerset.measurements:
        for pair in measurement.pairs:
            assert set(pair) <= set(markerset.keypoint_names)
        assert set(measurement.bodies) <= set(model.bodies.names)
