from pathlib import Path

import pytest

from gonio.errors import InputError
from gonio.resources import models_dir
from gonio.vision.model_cards import list_cards, load_card, read_card

FULL = models_dir() / "keypoints" / "blazepose_full.toml"


def test_the_shipped_cards() -> None:
    assert list_cards() == ("blazepose_detector", "blazepose_full", "blazepose_heavy")
    cards = {name: load_card(name) for name in list_cards()}
    for name, card in cards.items():
        assert card.name == name
        assert card.licence == "Apache-2.0"
        assert all(len(bytes.fromhex(source.sha256)) == 32 for source in card.sources)
    assert "@mediapipe/pose" in cards["blazepose_heavy"].source


@pytest.mark.parametrize("name", ["blazepose_full", "blazepose_heavy"])
def test_blazepose_has_33_keypoints_and_every_left_one_has_a_right_one(name: str) -> None:
    points = load_card(name).keypoints
    assert points is not None
    assert len(points.names) == len(set(points.names)) == 33
    assert [points.names.index(n) for n in ("left_hip", "right_hip", "left_heel", "right_foot_index")] == [
        23,
        24,
        29,
        32,
    ]
    mirrored = {n.replace("left", "*").replace("right", "left").replace("*", "right") for n in points.names}
    assert mirrored == set(points.names)
    assert len(points.auxiliary) == 2


def test_an_unknown_model_names_the_known_ones() -> None:
    with pytest.raises(InputError) as caught:
        load_card("openpose")
    assert caught.value.code == "model-unknown"
    assert "blazepose_heavy" in caught.value.hint


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('licence = "Apache-2.0"', "", "licence"),
        ("window = 7", 'window = "seven"', "window"),
        ("range = [0.0, 1.0]", "range = [0.0]", "range"),
        ('kind = "landmarks"', 'kind = "segmentation"', "kind"),
        ("[refinement]", "[refinements]", "refinements"),
        ('kind = "landmarks"', 'kind = "detector"', "[detection]"),
        ("sha256", "sha265", "sha256"),
        ("[input]", "[input", "TOML|Expected"),
    ],
)
def test_a_bad_card_names_the_file_and_the_entry(tmp_path: Path, before: str, after: str, complaint: str) -> None:
    text = FULL.read_text()
    assert before in text
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(before, after))
    with pytest.raises(InputError, match=r"bad\.toml") as caught:
        read_card(path)
    assert caught.value.code == "model-card-invalid"
    assert any(word in caught.value.message for word in complaint.split("|"))
