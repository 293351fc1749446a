"""Calibrations written and read again are the same; damaged ones are refused in words."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from gonio.bench.board_sessions import separate_optics
from gonio.errors import InputError
from gonio.formats.board_card import list_board_cards, load_board_card, read_board_card
from gonio.formats.calibration import read_calibration, read_intrinsics, read_own_calibration, write_calibration_as
from gonio.formats.floor_points import read_floor_points
from gonio.kernel.virtual_lab import make_rig
from gonio.pipeline.boards import card_text, print_board
from gonio.pipeline.findings import finding
from gonio.records import Calibration, Judgement, LabFrame, Rig, Verdict, Volume
from gonio.resources import boards_dir

FISHEYE = "[c]\nfisheye = true\nmatrix = []\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]"


@pytest.fixture
def calibration() -> Calibration:
    rng = np.random.default_rng(5)
    cameras = tuple(
        replace(
            camera,
            intrinsic_px=camera.intrinsic_px * rng.uniform(0.9, 1.1, (3, 3)) * [[1, 0, 1], [0, 1, 1], [0, 0, 0]]
            + np.diag([0.0, 0.0, 1.0]),
            distortion=rng.normal(0, 0.1, 5),
        )
        for camera in make_rig(3).cameras
    )
    root = rng.normal(size=(48, 48))
    return Calibration(
        rig=Rig(cameras=cameras, source="gonio"),
        intrinsics=tuple(separate_optics(camera, rng) for camera in cameras),
        delay_s=rng.normal(0, 0.01, 3),
        covariance=root @ root.T,
        sigma_px=0.31,
        lab=LabFrame(T_lab_ref=cameras[0].T_lab_cam, source="board", misfit_m=np.nan, tilt_sd_rad=0.01),
        volume=Volume(lower_lab_m=-rng.random(3), upper_lab_m=rng.random(3), error_m=0.0012),
        verdict=Verdict(
            level="reject",
            judgements=(Judgement(name="bump", level="reject", value=np.nan, accept=4.0, warn=6.0, where="cam2"),),
        ),
        board="a board",
        left_out=("cam9",),
        findings=(finding("camera-bumped", where="cam2", value=8.0, severity="serious"),),
    )


def assert_same(one, other, where: str = "calibration") -> None:
    assert type(one) is type(other), where
    if is_dataclass(one):
        for entry in fields(one):
            assert_same(getattr(one, entry.name), getattr(other, entry.name), f"{where}.{entry.name}")
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(one, np.ndarray | float):
        np.testing.assert_array_equal(one, other, err_msg=where)
    else:
        assert one == other, where


def test_gonio_s_own_file_keeps_everything_to_the_last_bit(calibration, tmp_path) -> None:
    write_calibration_as(tmp_path / "a.json", calibration)
    back = read_own_calibration(tmp_path / "a.json")
    assert_same(calibration, back)
    assert_same(calibration.intrinsics, read_intrinsics(tmp_path / "a.json"))


@pytest.mark.parametrize("name", ["a.toml", "a.qca.txt", "a.yml", "a.opencv.json"])
def test_other_programs_files_keep_the_rig(calibration, tmp_path, name) -> None:
    write_calibration_as(tmp_path / name, calibration)
    back = read_calibration(tmp_path / name)
    assert back.names == calibration.rig.names
    for one, other in zip(calibration.rig.cameras, back.cameras, strict=True):
        assert one.image_size_px == other.image_size_px
        np.testing.assert_allclose(other.intrinsic_px, one.intrinsic_px, rtol=1e-14, atol=1e-12)
        np.testing.assert_allclose(other.distortion, one.distortion, rtol=1e-14)
        # Rotations go through a vector, or are turned by quarter turns: rounding only.
        np.testing.assert_allclose(other.T_lab_cam, one.T_lab_cam, rtol=0, atol=1e-13)
    assert read_own_calibration(tmp_path / name) is None
    # Written again, the file is the same: nothing drifts from hand to hand.
    write_calibration_as(tmp_path / f"b{name[1:]}", replace(calibration, rig=back))
    again = read_calibration(tmp_path / f"b{name[1:]}")
    for one, other in zip(back.cameras, again.cameras, strict=True):
        np.testing.assert_allclose(other.T_lab_cam, one.T_lab_cam, rtol=0, atol=1e-14)


def test_opencv_s_own_reader_reads_what_is_written(calibration, tmp_path) -> None:
    cv2 = pytest.importorskip("cv2")
    for name in ("a.yml", "a.opencv.json"):
        write_calibration_as(tmp_path / name, calibration)
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_READ)
        node = storage.getNode("cameras").at(1)
        np.testing.assert_array_equal(node.getNode("camera_matrix").mat(), calibration.rig.cameras[1].intrinsic_px)
        assert node.getNode("name").string() == "cam2"


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("a.toml", "[cam]\nmatrix = 3", "calibration-incomplete"),
        ("a.toml", "x = 1", "calibration-unreadable"),
        (
            "a.toml",
            "[c]\nfisheye = true\nmatrix = []\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]",
            "calibration-lens-unknown",
        ),
        ("a.yml", "%YAML:1.0\n---\ncameras: 3", "calibration-unreadable"),
        ("a.yml", "%YAML:1.0\n---\n- [", "calibration-unreadable"),
        ("a.yml", "%YAML:1.0\n---\ncamera_matrix: 3\nimage_width: 2", "calibration-incomplete"),
        ("a.json", '{"format": "gonio calibration", "version": 1}', "calibration-unreadable"),
        ("a.json", "{", "calibration-unreadable"),
        ("a.txt", "hello", "calibration-format-unknown"),
    ],
)
def test_damaged_calibrations_are_refused_by_name(tmp_path, name, content, code) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as caught:
        read_calibration(tmp_path / name)
    assert caught.value.code == code
    assert name in caught.value.message
    assert caught.value.hint


def test_a_format_that_nobody_reads_is_not_written(calibration, tmp_path) -> None:
    with pytest.raises(InputError) as caught:
        write_calibration_as(tmp_path / "a.doc", calibration)
    assert caught.value.code == "calibration-format-unknown"


@pytest.mark.parametrize("name", list_board_cards())
def test_each_shipped_board_s_pdf_is_the_one_that_its_card_makes(tmp_path, name) -> None:
    path = tmp_path / f"{name}.pdf"
    assert print_board(load_board_card(name), path) == 1
    assert path.read_bytes() == (boards_dir() / f"{name}.pdf").read_bytes()


def test_a_large_board_is_cut_into_tiles_of_a_smaller_paper(tmp_path) -> None:
    assert print_board(load_board_card("charuco_a1"), tmp_path / "a.pdf", "A4") >= 8  # A1 has the area of eight A4


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("kind = 'charuco'", "board-card-unreadable"),
        ("kind = 'checkerboard'\ninner_corners = [4, 7]\nsquare_mm = 60\ncolour = 1", "board-card-unreadable"),
        ("kind = 'checkerboard'\ninner_corners = [4]\nsquare_mm = 60", "board-card-unreadable"),
        ("kind = 'checkerboard'\ninner_corners = [1, 7]\nsquare_mm = 60", "board-invalid"),
        (
            "kind = 'charuco'\ninner_corners = [4, 7]\nsquare_mm = 60\nmarker_mm = 70\ndictionary='DICT_4X4_50'",
            "board-invalid",
        ),
        ("kind = 'checkerboard'\ninner_corners = [40, 7]\nsquare_mm = 60\n[print]\npaper = 'A4'", "board-too-large"),
        ("=", "board-card-unreadable"),
    ],
)
def test_impossible_cards_are_refused(tmp_path, text, code) -> None:
    (tmp_path / "board.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_board_card(tmp_path / "board.toml")
    assert caught.value.code == code
    assert "board.toml" in caught.value.message


def test_a_card_that_is_made_is_read(tmp_path) -> None:
    (tmp_path / "a.toml").write_text(card_text("8 x 5", 30, "A3", "DICT_4X4_50", inverted=True))
    card = read_board_card(tmp_path / "a.toml")
    assert (card.board.corners_across, card.board.inverted, card.paper) == (8, True, "A3")
    with pytest.raises(InputError):
        card_text("8", 30, "A3", "", inverted=False)


POINTS = """[points.a]
lab_m = [0, 0, 0]
cam1 = [10, 20]
[points.b]
cam2 = [30, 40.5]
"""


def test_floor_points(tmp_path: Path) -> None:
    path = tmp_path / "floor_points.toml"
    path.write_text(POINTS)
    points = read_floor_points(path, ("cam2", "cam1"))
    assert points.names == ("a", "b")
    np.testing.assert_array_equal(points.uv_px[:, :, 0], [[np.nan, 30], [10, np.nan]])
    np.testing.assert_array_equal(points.xyz_lab_m[0], [0, 0, 0])
    assert np.isnan(points.xyz_lab_m[1]).all()
    assert read_floor_points(path, None).uv_px.shape == (2, 2, 2)
    for text in (POINTS.replace("cam2", "cam3"), POINTS.replace("[10, 20]", "[10]"), "points = 3", "["):
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            read_floor_points(path, ("cam1", "cam2"))
        assert caught.value.code == "floor-points-unreadable"
