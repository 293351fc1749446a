"""The folder of an articulated body, which several tests fill."""

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from gonio.formats.marks import COLUMNS
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.virtual_lab.articulated import VirtualBody
from gonio.records import Rig

BODY = """
[floor]
normal = [0, 2, 0]
offset_m = 0.0
[parts.shoulder]
parent = "base"
joint = "spherical"
[parts.base]
joint = "free"
on_floor = ["p0", "p1", "p2", "p3"]
"""


def _fill(folder: Path, body: VirtualBody) -> None:
    write_toml_calibration(folder / "cameras.toml", Rig(cameras=body.cameras, source="virtual"))
    (folder / "body.toml").write_text(BODY)
    with (folder / "tracks.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for part in body.parts:
            for i, camera in enumerate(body.cameras):
                for k, (u, v) in enumerate(part.uv_px[i]):
                    writer.writerow([camera.name, part.name, f"p{k}", repr(float(u)), repr(float(v))])


@pytest.fixture(scope="session")
def fill() -> Callable[[Path, VirtualBody], None]:
    """Write a mannequin's cameras, joint tree and tracks into a folder."""
    return _fill
