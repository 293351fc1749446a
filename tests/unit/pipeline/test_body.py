"""A session's body: the built-in one, or the lab's own with a marker set that places the keypoints on it."""

from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.osim import read_osim
from gonio.formats.osim_writer import write_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach
from gonio.pipeline.body import choose_markerset, scale_to_subject
from gonio.pipeline.motion import solve_points
from gonio.pipeline.params import Subject
from gonio.pipeline.run import CaptureFile
from gonio.records import MEASURED, BodyModel, LabPoints, Timebase
from gonio.resources import models_dir
from gonio.vision.model_cards import load_card

CARD = load_card("blazepose_heavy").keypoints
assert CARD is not None
NAMES = CARD.names
GAIT2354 = Path(__file__).resolve().parents[4] / "shared" / "data" / "opensim_gait2354" / "gait2354_simbody.osim"


def standing(model: BodyModel, card_names: tuple[str, ...] = NAMES) -> LabPoints:
    """The keypoints of a body that stands for half a second and bends its knees a little."""
    marked = attach(model, choose_markerset(model, NAMES))
    q = np.tile(model.coordinates.default, (30, 1))
    for side in "rl":
        knee = model.coordinates.index(f"knee_angle_{side}")
        bend = np.linspace(0, 0.5, 30)
        q[:, knee] = bend if model.coordinates.range[knee, 1] > 1 else -bend
    xyz = np.full((30, len(card_names), 3), np.nan)
    for i, place in enumerate(marker_positions(marked, q).transpose(1, 0, 2)):
        xyz[:, card_names.index(marked.markers.names[i])] = place
    return LabPoints(
        camera_names=(),
        keypoint_names=card_names,
        timebase=Timebase(rate_hz=60.0),
        xyz_lab_m=xyz,
        origin=np.full(xyz.shape[:2], MEASURED, np.uint8),
        covariance_m2=np.full((*xyz.shape, 3), np.nan),
        residual_px=np.zeros((0, *xyz.shape[:2], 2)),
    )


def test_the_built_in_body_is_chosen_by_sex() -> None:
    points = standing(read_osim(models_dir() / "bodies" / "fullbody_male.osim"))
    female = scale_to_subject(points, Subject(sex="female", mass_kg=60.0))
    assert female.value.file.name == "fullbody_female.osim"
    assert female.value.model.mass_kg == pytest.approx(60.0)
    assert female.findings == ()
    unknown = scale_to_subject(points, Subject())
    assert [f.code for f in unknown.findings] == ["mass-unknown", "sex-unknown"]


def test_a_labs_own_model_serves_a_session(tmp_path: Path) -> None:
    """A file of the lab's: here the built-in body under another name, without markers of its own that a card would know."""
    own = tmp_path / "lab.osim"
    built_in = models_dir() / "bodies" / "fullbody_female.osim"
    write_osim(own, read_osim(built_in), built_in)
    card = tmp_path / "lab.markerset.toml"
    card.write_text(
        'name = "lab"\nmodel = "lab"\nmarker_sd_mm = 15.0\n[keypoints]\n'
        + "".join(
            f'{side}_{part} = {{ joint = "{joint}_{side[0]}", weight = 1.0 }}\n'
            for side in ("left", "right")
            for part, joint in (("hip", "hip"), ("knee", "knee"), ("ankle", "ankle"), ("shoulder", "shoulder"))
        )
        + '[[measurements]]\nname = "thigh"\npairs = [["right_hip", "right_knee"]]\nbodies = ["femur_r"]\n'
    )
    files = [
        CaptureFile(path=own, name=own.name, role="body_model"),
        CaptureFile(path=card, name=card.name, role="marker_set"),
    ]
    points = standing(read_osim(models_dir() / "bodies" / "fullbody_male.osim"))
    body = scale_to_subject(points, Subject(mass_kg=70.0), files).value
    assert body.file == own
    assert len(body.model.markers.names) == 8
    motion = solve_points(body, points)
    assert np.rad2deg(motion.of("knee_angle_r"))[-1] == pytest.approx(np.rad2deg(0.5), abs=3.0)
    with pytest.raises(InputError, match="2 files of the kind body_model"):
        scale_to_subject(points, Subject(), [*files, files[0]])


def test_gait2354_serves_a_session_with_the_card_that_gonio_ships() -> None:
    if not GAIT2354.is_file():
        pytest.skip(f"{GAIT2354.parent.name} is not at hand (in shared/data)")
    points = standing(read_osim(GAIT2354))
    files = [CaptureFile(path=GAIT2354, name=GAIT2354.name, role="body_model")]
    body = scale_to_subject(points, Subject(mass_kg=72.6), files)
    assert body.value.file == GAIT2354
    motion = solve_points(body.value, points)
    np.testing.assert_allclose(np.rad2deg(motion.of("knee_angle_r"))[[0, -1]], [0.0, -np.rad2deg(0.5)], atol=1.0)


def test_a_model_that_no_card_fits_is_refused_with_the_remedy() -> None:
    model = read_osim(Path(__file__).parents[2] / "golden" / "all_joints.osim")
    with pytest.raises(InputError) as caught:
        choose_markerset(model, NAMES)
    assert caught.value.code == "markerset-missing"
    assert "marker_set" in caught.value.hint
