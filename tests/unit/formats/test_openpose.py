"""OpenPose's keypoints by gonio's names, and its files."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.openpose import (
    BODY_25B,
    LAYOUTS,
    count_frames,
    gonio_names,
    holds_poses,
    keypoint_count,
    read_poses,
    write_poses,
)
from gonio.resources import models_dir
from gonio.vision.model_cards import load_card


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


def people(*persons: list[list[float]]) -> str:
    return json.dumps({"people": [{"pose_keypoints_2d": [v for point in p for v in point]} for p in persons]})


def archive(path: Path, files: dict[str, str]) -> Path:
    with zipfile.ZipFile(path, "w") as zipped:
        for name, content in files.items():
            zipped.writestr(name, content)
    return path


def test_every_known_layout_has_a_card_that_places_it() -> None:
    for layout, names in LAYOUTS.items():
        card = read_markerset(models_dir() / "markersets" / f"{layout}.toml")
        assert set(card.keypoint_names) <= set(names), layout
        assert len(set(names)) == len(names)


def test_keypoints_of_blazepose_are_in_the_order_of_its_network() -> None:
    card = load_card("blazepose_heavy").keypoints
    assert card is not None
    assert LAYOUTS["blazepose33"] == card.names


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 700, (5, 17, 2)).round(3)
    confidence = rng.uniform(0.1, 1, (5, 17)).round(3)
    uv[1, 3], confidence[1, 3] = np.nan, 0.0
    uv[2], confidence[2] = np.nan, 0.0
    write_poses(tmp_path / "cam1.zip", uv, confidence)
    read = read_poses(tmp_path / "cam1.zip", "coco17")
    np.testing.assert_array_equal(read.uv_px[:, 0], uv)
    np.testing.assert_array_equal(read.confidence[:, 0], confidence)
    assert (count_frames(tmp_path / "cam1.zip"), keypoint_count(tmp_path / "cam1.zip")) == (5, 17)


def test_a_folder_with_gaps_and_several_people_is_read(tmp_path: Path) -> None:
    one, other = [[1.0, 2.0, 0.5]] * 17, [[3.0, 4.0, 0.75]] * 17
    (tmp_path / "cam01.0007.json").write_text(people(one))
    (tmp_path / "cam01.0009.json").write_text(people(one, other))
    (tmp_path / "notes.txt").write_text("not a frame")
    assert holds_poses(tmp_path)
    read = read_poses(tmp_path, "coco17")
    assert read.uv_px.shape == (3, 2, 17, 2)
    assert read.confidence[:, :, 0].tolist() == [[0.5, 0.0], [0.0, 0.0], [0.5, 0.75]]


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "no file whose name ends in a frame number"),
        ({"readme.txt": "hello"}, "no file whose name ends in a frame number"),
        ({"a_01.json": "{}", "b_01.json": "{}"}, "same frame number"),
        ({"a_1.json": "{}", "a_99999999.json": "{}"}, "frame numbers run from 1 to 99999999"),
        ({"a_1.json": "no json"}, "a_1.json is no keypoint file"),
        ({"a_1.json": "[" * 100_000}, "a_1.json is no keypoint file"),
        ({"a_1.json": '{"people": [{"pose_keypoints_2d": [1, 2]}]}'}, "no triples"),
        ({"a_1.json": '{"people": [{"pose_keypoints_2d": [1, 2, "x"]}]}'}, "is no keypoint file"),
        ({"a_1.json": " " * 3_000_000}, "unpacks to 3000000 bytes"),
    ],
)
def test_files_that_are_no_keypoints_are_refused_by_name(tmp_path: Path, files: dict[str, str], said: str) -> None:
    path = archive(tmp_path / "cam1.zip", files)
    with pytest.raises(InputError, match=said) as caught:
        read_poses(path, "coco17")
    assert caught.value.code == "poses-unreadable"
    assert "cam1.zip" in str(caught.value)


def test_what_is_no_archive_or_another_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cam1.zip").write_bytes(b"PK no archive")
    with pytest.raises(InputError, match="no ZIP archive"):
        count_frames(tmp_path / "cam1.zip")
    path = archive(tmp_path / "cam2.zip", {"a_1.json": people([[1.0, 2.0, 0.5]] * 18)})
    with pytest.raises(InputError, match="18 keypoints in frame 1; the layout coco17 has 17") as caught:
        read_poses(path, "coco17")
    assert caught.value.code == "poses-layout-wrong"
