"""A folder in, a motion out; and what is wrong with a folder is said by name."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from gonio.errors import GonioError, InputError
from gonio.formats.articulated import articulated_schema
from gonio.kernel.virtual_lab.articulated import BODIES, VirtualBody, virtual_body
from gonio.pipeline.articulated import solve_folder

Fill = Callable[[Path, VirtualBody], None]


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
