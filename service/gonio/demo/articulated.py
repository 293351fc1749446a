"""A virtual mannequin before one moving, zooming camera: uploaded, solved from its marks alone, and held against the truth."""

import csv
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation

from gonio.demo.over_http import analyse, demo_service, upload
from gonio.formats.articulated import ArticulatedDocument
from gonio.formats.marks import COLUMNS
from gonio.kernel.virtual_lab.articulated import BODIES, VirtualBody, virtual_background, virtual_body
from gonio.pipeline.articulated import articulated_lines

NOISE_PX, SEED = 0.3, 1

TREE = """[background]
image_size_px = [720, 540]
floor_points = ["f0", "f1", "f2", "f3"]
heights = [{{ picture = "picture 1", height_m = {height!r}, sd_m = 0.001 }}]
[parts.base]
joint = "free"
on_floor = ["p0", "p1", "p2", "p3"]
[parts.shoulder]
parent = "base"
joint = "spherical"
"""


def run_articulated_demo(output: Path, console: Console) -> Path:
    """Write the marks of a virtual mannequin and its background, upload, solve, compare; give the report's page."""
    body = virtual_body(BODIES["mannequin"], SEED, noise_px=NOISE_PX)
    console.print(f"Marks: a virtual mannequin in {len(body.cameras)} pictures of one camera, {NOISE_PX} px noise")
    files = write_object(body, output / "session")
    with demo_service(output, console) as gonio:
        session = gonio.create_session(kind="articulated_object", name="Demo: virtual mannequin")["id"]
        upload(gonio, session, files, console)
        job = analyse(gonio, session, console)
        paths = {path.name: path for path in gonio.download(job["id"], output / "report")}
    document = ArticulatedDocument.model_validate_json(paths["report.json"].read_bytes())
    for line in articulated_lines(document):
        console.print(line, soft_wrap=True)
    for part, worst in off_by_deg(document, body).items():
        console.print(f"{part}: worst turn is {worst:.2f}° from the truth", soft_wrap=True)
    console.print(f"Report: [bold]{paths['report.html'].absolute()}[/]", soft_wrap=True)
    return paths["report.html"]


def off_by_deg(document: ArticulatedDocument, body: VirtualBody) -> dict[str, float]:
    """Give each part's worst turn against the truth, degrees."""
    worst = {}
    for joint in document.joints:
        found = Rotation.from_quat([[*picture.quat_wxyz[1:], picture.quat_wxyz[0]] for picture in joint.pictures])
        truth = Rotation.from_matrix(body.Ts_parent_part[joint.part][:, :3, :3])
        worst[joint.part] = float(np.degrees((found * truth.inv()).magnitude().max()))
    return worst


def write_object(body: VirtualBody, folder: Path) -> list[Path]:
    """Write ``body.toml``, ``tracks.csv`` and ``background.csv``, as somebody who marked the pictures would."""
    folder.mkdir(parents=True, exist_ok=True)
    tree, tracks, behind = (folder / name for name in ("body.toml", "tracks.csv", "background.csv"))
    tree.write_text(TREE.format(height=float(body.cameras[0].centre_lab_m[1])), encoding="utf-8")
    background, _ = virtual_background(body.cameras, SEED, noise_px=NOISE_PX)
    with tracks.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for part in body.parts:
            for i, camera in enumerate(body.cameras):
                writer.writerows([camera.name, part.name, f"p{k}", *uv.tolist()] for k, uv in enumerate(part.uv_px[i]))
    with behind.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["picture", "point", "u_px", "v_px"])
        for i, name in enumerate(background.pictures):
            seen = enumerate(background.uv_px[i])
            writer.writerows([name, f"f{k}", *uv.tolist()] for k, uv in seen if np.isfinite(uv[0]))
    return [tree, tracks, behind]
