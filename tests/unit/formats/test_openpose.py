"""OpenPose's keypoints by gonio's names."""

from gonio.formats.markerset import read_markerset
from gonio.formats.openpose import BODY_25B, gonio_names
from gonio.resources import models_dir


def test_sides_and_words_are_written_out() -> None:
    assert gonio_names(("LBigToe", "RHip", "Neck", "Nose")) == ("left_big_toe", "right_hip", "neck", "nose")


def test_names_of_gonio_stay_as_they_are() -> None:
    names = read_markerset(models_dir() / "markersets" / "halpe26.toml").keypoint_names
    assert gonio_names(names) == names


def test_the_card_places_every_keypoint() -> None:
    card = read_markerset(models_dir() / "markersets" / "body25b.toml")
    assert set(card.keypoint_names) == set(gonio_names(BODY_25B))
    assert {name for measurement in card.measurements for pair in measurement.pairs for name in pair} <= set(
        card.keypoint_names
    )
