"""Masks and a solved motion in, solids out: in the right place, in the right pose, with the right colour."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from gonio.cli import app
from gonio.errors import CaptureError, InputError
from gonio.formats.articulated import ArticulatedDocument
from gonio.formats.carving import carving_schema
from gonio.kernel.carving.raster import draw, project_vertices
from gonio.kernel.virtual_lab.articulated import BODIES, VirtualBody, virtual_body
from gonio.pipeline.articulated import solve_folder
from gonio.pipeline.carving import carve_folder
from gonio.vision.masks import cut_out, write_mask

SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
COLOURS = {"base": (40, 160, 60), "shoulder": (190, 60, 40)}


def photograph(folder: Path, body: VirtualBody) -> None:
    """Paint the mannequin's two boxes, the nearer one over the other, and each one's mask of what is seen of it."""
    (folder / "pictures").mkdir()
    for i, camera in enumerate(body.cameras):
        P = camera.intrinsic_px @ camera.T_cam_lab[:3]
        size = camera.image_size_px[::-1]
        depths = {}
        for shape in BODIES["mannequin"]:
            T = body.Ts_world_part[shape.name][i]
            corners = (np.array(shape.middle_m) + SIGNS * shape.size_m) @ T[:3, :3].T + T[:3, 3]
            faces = np.array(trimesh.convex.convex_hull(corners).faces)
            hull = trimesh.convex.convex_hull(corners).vertices
            depths[shape.name], _ = draw(project_vertices(P, np.array(hull)), faces, size)
        rgb = np.full((*size, 3), 90, np.uint8)
        for name, depth in depths.items():
            shown = np.isfinite(depth) & (depth <= np.minimum.reduce(list(depths.values())))
            write_mask(folder / "masks" / name / f"{camera.name}.png", shown)
            rgb[shown] = COLOURS[name]
        cv2.imwrite(str(folder / "pictures" / f"{camera.name}.png"), rgb[..., ::-1])


@pytest.fixture(scope="module")
def solved(
    tmp_path_factory: pytest.TempPathFactory, fill: Callable[[Path, VirtualBody], None]
) -> tuple[Path, VirtualBody, ArticulatedDocument]:
    folder = tmp_path_factory.mktemp("mannequin")
    body = virtual_body(BODIES["mannequin"], 3, noise_px=0.0, pictures=6)
    fill(folder, body)
    photograph(folder, body)
    return folder, body, solve_folder(folder)


def test_the_parts_are_carved_where_they_are(solved: tuple[Path, VirtualBody, ArticulatedDocument]) -> None:
    folder, body, _ = solved
    ran = CliRunner().invoke(app, ["articulated", str(folder), "--voxels", "64"])
    assert ran.exit_code == 0, ran.output
    document = json.loads((folder / "carving.json").read_text())
    jsonschema.validate(document, carving_schema())
    assert document["findings"] == []
    for part in document["parts"]:
        # One voxel of 64 all around a box of 64 × 22 × 22 is a tenth of its picture; half of it counts.
        assert min(part["overlap"].values()) > 0.85
        assert np.mean(list(part["overlap"].values())) > 0.94
        shape = next(s for s in BODIES["mannequin"] if s.name == part["part"])
        # A visual hull holds the body, but for its border voxels; how much more it is depends on the six views.
        assert 0.97 < part["volume_m3"] / np.prod(shape.size_m) < 2.5
        mesh = trimesh.load_mesh(folder / f"parts/{part['part']}.ply")
        assert mesh.is_watertight
        seen = np.array(mesh.visual.vertex_colors)[:, :3]
        seen = seen[(seen != 128).any(axis=1)]
        # Pixels at the silhouettes mix with what is behind, so the middle counts.
        assert np.abs(np.median(seen, axis=0) - COLOURS[part["part"]]).max() <= 3
        for i, camera in enumerate(body.cameras):
            scene = trimesh.load_scene(folder / f"parts/body {camera.name}.glb")
            T, name = scene.graph[part["part"]]
            np.testing.assert_allclose(T, body.Ts_world_part[part["part"]][i], atol=1e-5)
            low, high = scene.geometry[name].bounds
            assert (low < shape.middle_m).all()
            assert (shape.middle_m < high).all()
        # glTF's colours are linear: sRGB 160 is (0.6275 + 0.055) / 1.055 to the power of 2.4 = 0.3515, or 90.
        if part["part"] == "base":
            linear = np.array(scene.geometry["base"].visual.vertex_attributes["color"])[:, :3]
            assert abs(np.median(linear[(linear[:, 0] != linear[:, 1])][:, 1]) - 90) <= 3


def test_a_wrong_motion_shows_in_the_overlap(solved: tuple[Path, VirtualBody, ArticulatedDocument]) -> None:
    folder, body, motion = solved
    wrong = motion.model_copy(deep=True)
    base = wrong.joints[0].pictures[2]
    base.T_world_part[2][3] += 0.08  # across the line of sight
    document = carve_folder(folder, body.cameras, wrong, 48)
    codes = {each.code: each.where for each in document.findings if each.where.startswith("base")}
    assert set(codes) == {"hull-overlap-low", "picture-misfits"}
    assert codes["picture-misfits"] == "base in picture 3"


def test_a_mask_that_lacks_a_piece_is_named(
    tmp_path: Path, solved: tuple[Path, VirtualBody, ArticulatedDocument]
) -> None:
    _, body, motion = solved
    photograph(tmp_path, body)
    path = tmp_path / "masks/base/picture 4.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: (2 * rows[0] + rows[-1]) // 3] = False
    write_mask(path, mask)
    document = carve_folder(tmp_path, body.cameras, motion, 48)
    assert document.parts[0].overlap["picture 4"] > max(list(document.parts[0].overlap.values())[:3])
    blamed = [each.where for each in document.findings if each.code == "picture-misfits"]
    # The shoulder, 16 of 48 voxels wide, is at the edge of a finding by the voxels' size alone.
    assert [where for where in blamed if where.startswith("base")] == ["base in picture 4"]


Spoil = Callable[[Path], object]
WRONG: dict[str, tuple[Spoil, str]] = {
    "another size": (lambda m: write_mask(m / "base/picture 2.png", np.ones((50, 60), bool)), "mask-wrong-size"),
    "empty": (lambda m: write_mask(m / "base/picture 2.png", np.zeros((540, 720), bool)), "mask-empty"),
    "full": (lambda m: write_mask(m / "base/picture 2.png", np.ones((540, 720), bool)), "mask-full"),
    "cut": (lambda m: write_mask(m / "base/picture 2.png", np.indices((540, 720))[0] < 300), "mask-cut"),
    "no picture": (lambda m: (m / "base/picture 2.png").write_bytes(b"no picture"), "image-unreadable"),
    "an unknown part": (lambda m: (m / "elbow").mkdir(), "mask-unknown-part"),
    "an unknown picture": (lambda m: (m / "base/picture 2.png").rename(m / "base/left.png"), "mask-unknown-picture"),
    "one mask": (lambda m: [(m / f"base/picture {i}.png").unlink() for i in range(2, 7)], "masks-too-few"),
    "none": (lambda m: [path.unlink() for path in m.glob("*/*")], "masks-missing"),
    "another photo": (lambda m: write_mask(m / "../pictures/picture 2.png", np.ones((50, 60), bool)), "picture-wrong-size"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_masks_are_refused_by_name(
    tmp_path: Path, solved: tuple[Path, VirtualBody, ArticulatedDocument], case: str
) -> None:
    _, body, motion = solved
    photograph(tmp_path, body)
    spoil, code = WRONG[case]
    spoil(tmp_path / "masks")
    with pytest.raises(InputError) as refused:
        carve_folder(tmp_path, body.cameras, motion, 32)
    assert refused.value.code == code


def test_parts_without_masks_and_pictures_are_told(
    tmp_path: Path, solved: tuple[Path, VirtualBody, ArticulatedDocument]
) -> None:
    _, body, motion = solved
    photograph(tmp_path, body)
    for path in (*tmp_path.glob("pictures/*"), *tmp_path.glob("masks/shoulder/*")):
        path.unlink()
    document = carve_folder(tmp_path, body.cameras, motion, 32)
    told = {(each.code, each.where) for each in document.findings}
    assert {("part-not-carved", "shoulder"), ("part-without-colours", "base")} <= told
    with pytest.raises(InputError) as refused:
        carve_folder(tmp_path, body.cameras, motion, 5000)
    assert refused.value.code == "voxels-unfit"


def test_grabcut_finds_a_thing_in_its_box(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = np.hypot(*(np.indices((400, 600)) - np.array([[[190]], [[320]]])) / np.array([[[90]], [[130]]])) < 1
    rgb = np.where(truth[..., None], (170, 80, 60), (90, 110, 120)) + rng.normal(0, 12, (400, 600, 3))
    rgb = np.clip(rgb, 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "left.png"), rgb[..., ::-1])
    mask = tmp_path / "masks" / "lid" / "left.png"
    ran = CliRunner().invoke(
        app, ["mask", str(tmp_path / "left.png"), "--box", "185,95,455,285", "--output", str(mask)]
    )
    assert ran.exit_code == 0, ran.output
    found = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) > 127
    assert (found & truth).sum() / (found | truth).sum() > 0.97
    left = np.indices(truth.shape)[1] < 300
    assert not (cut_out(rgb, (185, 95, 455, 285), without=left) & left).any()
    for box in ((0, 0, 600, 400), (500, 300, 700, 390), (10, 10, 12, 300)):
        with pytest.raises(InputError) as refused:
            cut_out(rgb, box)
        assert refused.value.code == "box-unfit"
    with pytest.raises(CaptureError) as failed:
        cut_out(np.full((400, 600, 3), 90, np.uint8), (185, 95, 455, 285))
    assert failed.value.code == "nothing-cut-out"
