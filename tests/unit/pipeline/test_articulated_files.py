"""A folder in, a motion out; and what is wrong with a folder is said by name."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest

from gonio.errors import GonioError, InputError
from gonio.formats.articulated import articulated_schema
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.virtual_lab.articulated import (
    BODIES,
    VirtualBody,
    virtual_background,
    virtual_body,
    virtual_turntable,
)
from gonio.pipeline.articulated import articulated_lines, cameras_of, solve_folder
from gonio.records import Camera, Rig

Fill = Callable[[Path, VirtualBody], None]
Wall = tuple[np.ndarray, np.ndarray, np.ndarray]


def room() -> list[Wall]:
    """Give walls, the far ones first: a corner and two edges that span each."""
    return [
        (np.array([-2.5, 0, -3]), np.array([0, 0, 6.0]), np.array([0, 2.5, 0])),
        (np.array([-2.5, 0, -3]), np.array([5.0, 0, 0]), np.array([0, 2.5, 0])),
        (np.array([-2.5, 0, 3]), np.array([5.0, 0, 0]), np.array([0, 2.5, 0])),
        (np.array([-2.5, 0, -3]), np.array([4.0, 0, 0]), np.array([0, 0, 6.0])),
        (np.array([-1.2, 0, -0.9]), np.array([0.5, 0, 0.6]), np.array([0, 0.8, 0])),
        (np.array([-1.2, 0, 0.9]), np.array([0.6, 0, -0.4]), np.array([0, 0.6, 0])),
    ]


def photograph(camera: Camera, walls: list[Wall], seed: int) -> np.ndarray:
    """Photograph textured walls, each pixel what its ray meets first."""
    width, height = camera.image_size_px
    v, u = np.mgrid[:height, :width].astype(float)
    K = camera.intrinsic_px
    rays = (
        np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1) @ camera.T_lab_cam[:3, :3].T
    )
    o = camera.centre_lab_m
    picture, nearest = np.full((height, width), 128.0), np.full((height, width), np.inf)
    for number, (corner, first, second) in enumerate(walls):
        rng = np.random.default_rng(number)
        texture = cv2.GaussianBlur(rng.uniform(0, 255, (400, 400)).astype(np.float32), (0, 0), 1.5)
        texture = np.clip((texture - 128) * 4 + 128, 0, 255)
        normal = np.cross(first, second)
        far = ((corner - o) @ normal) / (rays @ normal)
        hit = o + far[..., None] * rays - corner
        a, b = hit @ first / (first @ first), hit @ second / (second @ second)
        seen = (far > 0) & (far < nearest) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        shade = cv2.remap(texture, (a * 399).astype(np.float32), (b * 399).astype(np.float32), cv2.INTER_LINEAR)
        picture, nearest = np.where(seen, shade, picture), np.where(seen, far, nearest)
    return np.clip(picture + np.random.default_rng(seed).normal(0, 2, picture.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def body() -> VirtualBody:
    return virtual_body(BODIES["mannequin"], 1, noise_px=0.0)


def test_a_folder_is_solved(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    fill(tmp_path, body)
    solve_folder(tmp_path)
    document = json.loads((tmp_path / "motion.json").read_text())
    jsonschema.validate(document, articulated_schema())
    assert [joint["part"] for joint in document["joints"]] == ["base", "shoulder"]
    for joint in document["joints"]:
        found = [picture["T_world_part"] for picture in joint["pictures"]]
        # Cameras pass through a file of rotation vectors: rounding of 1e-16 times the amplification of 1e4 or so.
        np.testing.assert_allclose(found, body.Ts_world_part[joint["part"]], atol=1e-6)
        assert joint["wrong_marks"] == []
    np.testing.assert_allclose(document["joints"][1]["centre_m"], BODIES["mannequin"][1].joint_m, atol=1e-6)


def test_tracks_may_be_json(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    fill(tmp_path, body)
    rows = list(csv.DictReader((tmp_path / "tracks.csv").read_text().splitlines()))
    first = solve_folder(tmp_path)
    (tmp_path / "tracks.csv").unlink()
    marks = [{**row, "u_px": float(row["u_px"]), "v_px": float(row["v_px"])} for row in rows]
    (tmp_path / "tracks.json").write_text(json.dumps(marks))
    assert solve_folder(tmp_path).model_dump() == first.model_dump()


BACKGROUND = """
[background]
image_size_px = [720, 540]
floor_points = ["f0", "f1", "f2", "f3"]
heights = [{{ picture = "picture 1", height_m = {height}, sd_m = 0.001 }}]
principal_sd_px = 0
k1_sd = 0
"""


def fill_background(folder: Path, body: VirtualBody, fill: Fill, noise_px: float) -> None:
    """Put marks of the background in the place of the cameras; the first four points are the floor's."""
    fill(folder, body)
    (folder / "cameras.toml").unlink()
    height = float(body.cameras[0].centre_lab_m[1])
    without_floor = (folder / "body.toml").read_text().replace("[floor]\nnormal = [0, 2, 0]\noffset_m = 0.0\n", "")
    (folder / "body.toml").write_text(BACKGROUND.format(height=height) + without_floor)
    background, _ = virtual_background(body.cameras, 1, noise_px=noise_px)
    rows = ["picture,point,u_px,v_px"]
    for i, name in enumerate(background.pictures):
        rows += [
            f"{name},f{k},{float(u)!r},{float(v)!r}" for k, (u, v) in enumerate(background.uv_px[i]) if np.isfinite(u)
        ]
    (folder / "background.csv").write_text("\n".join(rows) + "\n")


def test_marks_of_the_background_do_in_place_of_cameras(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    fill_background(tmp_path, body, fill, 0.0)
    solved = solve_folder(tmp_path)
    document = json.loads((tmp_path / "motion.json").read_text())
    jsonschema.validate(document, articulated_schema())
    for found, camera in zip(document["cameras"]["pictures"], body.cameras, strict=True):
        np.testing.assert_allclose(found["T_world_cam"], camera.T_lab_cam, atol=1e-4)
        assert found["focal_px"] == pytest.approx(camera.intrinsic_px[0, 0], rel=1e-4)
        assert found["shift_sd_m"] > 0
    for written, camera in zip(cameras_of(tmp_path, solved), body.cameras, strict=True):
        np.testing.assert_allclose(written.intrinsic_px, camera.intrinsic_px, rtol=1e-4)
    for joint in document["joints"]:
        found = [picture["T_world_part"] for picture in joint["pictures"]]
        np.testing.assert_allclose(found, body.Ts_world_part[joint["part"]], atol=1e-3)


@pytest.mark.parametrize(
    ("file", "old", "new", "code"),
    [
        ("background.csv", "picture,point", "picture,name", "tracks-unreadable"),
        ("background.csv", "picture 2,f0,", "picture 2,f1,", "tracks-unreadable"),
        ("body.toml", '"f3"]', '"f99"]', "body-unreadable"),
        ("body.toml", 'picture = "picture 1"', 'picture = "picture 9"', "body-unreadable"),
        ("body.toml", "image_size_px = [720, 540]", "", "body-unreadable"),
        ("body.toml", "heights = [{", "heightz = [{", "body-unreadable"),
    ],
)
def test_what_is_wrong_with_a_background_is_said(
    tmp_path: Path, body: VirtualBody, fill: Fill, file: str, old: str, new: str, code: str
) -> None:
    fill_background(tmp_path, body, fill, 0.3)
    edit(tmp_path / file, old, new)
    with pytest.raises(InputError) as error:
        solve_folder(tmp_path)
    assert error.value.code == code
    assert file in error.value.message


TURNTABLE = """
[parts.thing]
joint = "hinge"
length = {{ points = ["p0", "p1"], length_m = {length}, sd_m = 0.001 }}
"""


def test_one_camera_stands_for_all_pictures_of_a_turntable(tmp_path: Path, fill: Fill) -> None:
    body = virtual_turntable(3)
    fill(tmp_path, body)
    one = Rig(cameras=(replace(body.cameras[0], name="camera"),), source="virtual")
    write_toml_calibration(tmp_path / "cameras.toml", one)
    length = body.parts[0].length
    assert length is not None
    (tmp_path / "body.toml").write_text(TURNTABLE.format(length=length.length_m))
    document = solve_folder(tmp_path)
    (joint,) = document.joints
    for i, picture in enumerate(joint.pictures):
        assert picture.turn_deg == pytest.approx(15 * i, abs=3 * picture.turn_sd_deg + 1e-9)
    assert [camera.name for camera in cameras_of(tmp_path, document)] == [picture.picture for picture in joint.pictures]


def test_a_picture_with_few_believed_marks_is_unsure(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    uv = body.parts[1].uv_px.copy()
    uv[2, 5:] = np.nan
    fill(tmp_path, replace(body, parts=(body.parts[0], replace(body.parts[1], uv_px=uv))))
    rows = (tmp_path / "tracks.csv").read_text().splitlines()
    (tmp_path / "tracks.csv").write_text("\n".join(row for row in rows if "nan" not in row) + "\n")
    (shoulder,) = (joint for joint in solve_folder(tmp_path).joints if joint.part == "shoulder")
    sure = [picture for picture in shoulder.pictures if not picture.unsure]
    assert [picture.picture for picture in sure] == ["picture 1", "picture 2", "picture 4"]
    assert shoulder.pictures[2].turn_sd_deg < 3


def test_a_part_that_is_not_told_leaves_the_others(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    still = replace(body.parts[1], uv_px=body.parts[0].uv_px[:, :20])  # the shoulder is stuck on the base
    fill(tmp_path, replace(body, parts=(body.parts[0], still)))
    document = solve_folder(tmp_path)
    assert [joint.part for joint in document.joints] == ["base"]
    assert [(part.part, part.code) for part in document.refused] == [("shoulder", "no-motion")]
    assert any("no-motion" in line for line in articulated_lines(document))


def test_the_background_is_found_in_photographs(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    """Photographs of a textured room: its floor is marked by hand at four places, the rest is found."""
    fill_background(tmp_path, body, fill, 0.2)
    marks = (tmp_path / "background.csv").read_text().splitlines()
    by_hand = [row for row in marks if row.split(",")[1] in ("point", "f0", "f1", "f2", "f3")]
    (tmp_path / "background.csv").write_text("\n".join(by_hand) + "\n")
    (tmp_path / "pictures").mkdir()
    for i, camera in enumerate(body.cameras):
        cv2.imwrite(str(tmp_path / "pictures" / f"{camera.name}.png"), photograph(camera, room(), i))
    document = solve_folder(tmp_path)
    assert document.cameras is not None
    assert document.cameras.found_points > 40
    for found, camera in zip(document.cameras.pictures, body.cameras, strict=True):
        off = np.linalg.norm(np.array(found.T_world_cam)[:3, 3] - camera.centre_lab_m)
        assert off < max(4 * found.shift_sd_m, 0.02)


def edit(path: Path, old: str, new: str, count: int = -1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


WRONG = {
    "a cycle": ("body.toml", '[parts.base]\njoint = "free"', '[parts.base]\nparent = "shoulder"\njoint = "spherical"'),
    "an unknown joint": ("body.toml", '"spherical"', '"ball"'),
    "no TOML": ("body.toml", "[floor]", "[floor"),
    "a floor without direction": ("body.toml", "[0, 2, 0]", "[0, 0, 0]"),
    "a point nobody marked": ("body.toml", '"p3"]', '"p99"]'),
    "an unknown part": ("tracks.csv", ",shoulder,", ",elbow,"),
    "an unknown picture": ("tracks.csv", "picture 2,", "picture 9,"),
    "a mark that is no number": ("tracks.csv", "p5,", "p5,x"),
    "a column missing": ("tracks.csv", "u_px", "u"),
}
CODES = {"a cycle": "joint-tree-broken"}


@pytest.mark.parametrize("case", WRONG)
def test_bad_files_are_refused_by_name(tmp_path: Path, body: VirtualBody, fill: Fill, case: str) -> None:
    fill(tmp_path, body)
    name, old, new = WRONG[case]
    edit(tmp_path / name, old, new, 1)
    with pytest.raises(InputError) as refused:
        solve_folder(tmp_path)
    expected = CODES.get(case, "body-unreadable" if name == "body.toml" else "tracks-unreadable")
    assert refused.value.code == expected


def test_a_part_with_two_points_and_missing_files_are_refused(tmp_path: Path, body: VirtualBody, fill: Fill) -> None:
    fill(tmp_path, body)
    lines = (tmp_path / "tracks.csv").read_text().splitlines(keepends=True)
    kept = [line for line in lines if ",shoulder," not in line or ",p0," in line or ",p1," in line]
    (tmp_path / "tracks.csv").write_text("".join(kept))
    with pytest.raises(InputError) as refused:
        solve_folder(tmp_path)
    assert refused.value.code == "part-with-few-points"
    (tmp_path / "tracks.csv").unlink()
    with pytest.raises(GonioError) as missing:
        solve_folder(tmp_path)
    assert missing.value.code == "file-missing"
