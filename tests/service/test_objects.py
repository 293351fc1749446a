"""An articulated object over HTTP: marks up, motion down; what is missing or not to be told is said by name."""

from pathlib import Path

import numpy as np
import pytest

from gonio.errors import GonioError
from gonio.kernel.virtual_lab.articulated import BODIES, virtual_background, virtual_body

BODY = virtual_body(BODIES["lid"], 1, noise_px=0.2)
TREE = """
[background]
image_size_px = [720, 540]
floor_points = ["f0", "f1", "f2", "f3"]
heights = [{{ picture = "picture 1", height_m = {}, sd_m = 0.001 }}]
[parts.lid]
joint = "hinge"
"""


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    background, _ = virtual_background(BODY.cameras, 1, noise_px=0.2)
    tree, tracks, behind = (tmp_path / name for name in ("body.toml", "tracks.csv", "background.csv"))
    tree.write_text(TREE.format(float(BODY.cameras[0].centre_lab_m[1])))
    rows, still = ["picture,part,point,u_px,v_px"], ["picture,point,u_px,v_px"]
    for i, name in enumerate(background.pictures):
        rows += [f"{name},lid,p{k},{float(u)!r},{float(v)!r}" for k, (u, v) in enumerate(BODY.parts[0].uv_px[i])]
        seen = [(k, uv) for k, uv in enumerate(background.uv_px[i]) if np.isfinite(uv[0])]
        still += [f"{name},f{k},{float(u)!r},{float(v)!r}" for k, (u, v) in seen]
    tracks.write_text("\n".join(rows) + "\n")
    behind.write_text("\n".join(still) + "\n")
    return [tree, tracks, behind]


def test_marks_become_a_report(lab, files, tmp_path):
    session = lab.client.create_session(kind="articulated_object", name="a lid")["id"]
    for path in files:
        lab.client.upload(session, path)
    roles = {file["name"]: file["role"] for file in lab.client.files(session)}
    assert roles == {"body.toml": "joint_tree", "tracks.csv": "tracks", "background.csv": "background"}
    job = lab.client.wait(lab.client.analyse(session)["id"], timeout_s=120)
    report = lab.client.report(job["id"])
    (joint,) = report["joints"]
    assert joint["joint"] == "hinge"
    truth = BODY.Ts_parent_part["lid"]
    for picture, T in zip(joint["pictures"], truth, strict=True):
        turn = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        assert abs(picture["turn_deg"] - turn) <= max(4 * picture["turn_sd_deg"], 1e-3)
    assert len(report["cameras"]["pictures"]) == 4
    assert {path.name for path in lab.client.download(job["id"], tmp_path / "out")} == {"report.json", "report.html"}


def test_what_is_missing_is_said(lab, files):
    session = lab.client.create_session(kind="articulated_object")["id"]
    for expected in ("joint_tree", "tracks", "camera was"):
        with pytest.raises(GonioError, match=expected) as caught:
            lab.client.analyse(session)
        assert caught.value.code == "object-files-missing"
        lab.client.upload(session, files.pop(0))
