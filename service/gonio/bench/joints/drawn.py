"""The paper's evaluation on virtual versions of its five bodies, from pixels to the table.

Each body is drawn in four pictures of one moving, zooming camera, its faces papered with markers. What follows knows the
pictures and the cameras alone: the markers' corners are found in the pixels, masks are cut out of boxes by GrabCut, the joints
are solved, the parts carved. Beside it stands, as in the paper, a separate reconstruction of the same configurations: the
body stands still in each of them before ``STILL`` other cameras, its corners are triangulated, and the motion of each part
between configurations is that which lays its corners on each other. The table holds, for each joint, how far the two are apart:
quaternion dot product, length_1 and length_2, as medians over the seeds of the worst picture (the dot product: of the mean).
``GONIO_BENCH_DRAWN`` sets the number of bodies of each kind (3 without it).
"""

import os
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.joints.bodies import errors_of
from gonio.errors import GonioError
from gonio.kernel.articulated.chain import solve_body
from gonio.kernel.articulated.starts import nearest_to_rays
from gonio.kernel.carving.surface import carve_part
from gonio.kernel.geometry.cameras import normalize, project
from gonio.kernel.geometry.transforms import align, inverse
from gonio.kernel.virtual_lab.articulated import BODIES, Shape, VirtualBody, virtual_body, virtual_cameras
from gonio.pipeline.carving import Masks, silhouettes_of
from gonio.records import Camera, CarvedPart, Floor, Part
from gonio.vision.masks import cut_out
from gonio.vision.render_parts import HUES, Box, PaperedPart, Photo, find_marks, paper, photograph

STILL = 6
"""Cameras of the separate reconstruction, in each configuration."""

FINER = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]])
"""From the virtual cameras' 720 × 540 pixels to 1440 × 1080: the markers' cells are then wide enough to be read."""

TURN_RAD = (0.17, 0.7)
"""Turns from picture to picture, 10° to 40°: a box that turns farther, before a camera that walks ±45°, shows other faces."""

PLATE_M = 0.01
"""Thickness of the plate that a free part stands on; the corners printed on it are that high above the floor."""

BOX_PX = 4
"""How far around what is shown a user draws the box."""

MISFIT_PX = 0.5
"""A triangulated corner that is off by more in any picture was covered there by something else."""


def measure_drawn(bench: Bench) -> None:
    """Add the metrics of bodies that are found in pictures."""
    seeds = int(os.environ.get("GONIO_BENCH_DRAWN", "3"))
    bench.explain(__doc__)
    bench.notes.append(
        f"{seeds} drawn bodies of each kind, 4 pictures each; {STILL} cameras for the separate reconstruction."
    )
    failed = 0
    for shapes in BODIES.values():
        rows: dict[str, list[dict[str, float]]] = {shape.name: [] for shape in shapes}
        for seed in range(seeds):
            try:
                for part, row in _evaluated(shapes, seed).items():
                    rows[part].append(row)
            except GonioError as error:
                failed += 1
                bench.notes.append(f"{', '.join(rows)}, seed {seed}: {error}")
        for part, measured in rows.items():
            for name in measured[0] if measured else ():
                values = [row[name] for row in measured]
                at = f"drawn_{name}_{part.replace(' ', '_')}"
                bench.add(at, float(np.median(values)), UNITS[name], **LIMITS.get(name, {}))
    # Drawn at random, some pictures show too few marks of a part in common: they are refused by name, and that is right.
    bench.add("drawn_solved_pct", 100 * (1 - failed / (seeds * len(BODIES))), "%", at_least=80.0)


UNITS = {
    "marks": "", "turn_sd": "deg", "turn": "deg", "dot_below_1": "1e-6", "length_1": "mm", "length_2": "mm", "true_turn": "deg",
    "true_length_2": "mm", "mask_overlap": "%", "overlap": "%", "volume": "×",
}  # fmt: skip

LIMITS: dict[str, dict[str, float]] = {
    "overlap": {"at_least": 85.0},
    "turn": {"at_most": 2.0},
    "length_2": {"at_most": 5.0},
}
"""What the medians may be at worst."""


def _evaluated(shapes: tuple[Shape, ...], seed: int) -> dict[str, dict[str, float]]:
    body = virtual_body(shapes, seed, noise_px=0.0, turn_rad=TURN_RAD)
    cameras = _finer(body.cameras)
    papered = _papered(shapes)
    photos = [_photo(camera, body, papered, i, seed) for i, camera in enumerate(cameras)]
    parts = tuple(_tracked(shape, part, photos) for shape, part in zip(shapes, papered, strict=True))
    floor = Floor(normal=np.array([0.0, 1.0, 0.0]), offset_m=PLATE_M)
    motions = solve_body(cameras, parts, floor)
    masks, mask_overlap = _cut(shapes, cameras, photos)
    separate = _separate(body, papered, seed)
    table: dict[str, dict[str, float]] = {}
    for motion, shape in zip(motions, shapes, strict=True):
        _, turn, dot, length_1, length_2 = errors_of(separate, motion)
        truth = errors_of(replace(body, xyz_m=separate.xyz_m), motion)
        carved = _carved(shape.name, masks, cameras, motion.Ts_world_part)
        ideal = _carved(shape.name, _true_masks(shapes, cameras, photos), cameras, body.Ts_world_part[shape.name])
        table[shape.name] = {
            "marks": float(motion.used.sum(axis=1).mean()), "turn_sd": float(np.degrees(motion.rotation_sd_rad[1:].mean())),
            "turn": turn, "dot_below_1": 1e6 * (1 - dot), "length_1": 1e3 * length_1,
            "length_2": 1e3 * length_2, "true_turn": truth[1], "true_length_2": 1e3 * truth[4],
            "mask_overlap": 100 * mask_overlap[shape.name], "overlap": 100 * float(carved.overlap.mean()),
            "volume": carved.volume_m3 / ideal.volume_m3,
        }  # fmt: skip
    return table


def _finer(cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
    return tuple(replace(c, image_size_px=(1440, 1080), intrinsic_px=FINER @ c.intrinsic_px) for c in cameras)


def _papered(shapes: tuple[Shape, ...]) -> tuple[PaperedPart, ...]:
    parts: list[PaperedPart] = []
    tag = 0
    for shape, hue in zip(shapes, HUES, strict=False):
        boxes = [Box(np.array(shape.middle_m, dtype=float), np.array(shape.size_m, dtype=float))]
        if shape.kind == "free":
            boxes.append(Box(np.array([0, PLATE_M / 2, 0]), np.array([0.45, PLATE_M, 0.45])))
        parts.append(paper(tuple(boxes), tag, hue))
        tag += len(parts[-1].tags)
    return tuple(parts)


def _photo(camera: Camera, body: VirtualBody, papered: tuple[PaperedPart, ...], picture: int, seed: int) -> Photo:
    Ts = tuple(body.Ts_world_part[part.name][picture] for part in body.parts)
    return photograph(camera, papered, Ts, seed=1000 * seed + picture)


def _tracked(shape: Shape, papered: PaperedPart, photos: list[Photo]) -> Part:
    """Find a part's marks in all pictures; those that one picture alone shows say nothing and are left out."""
    uv = np.stack([find_marks(photo, papered.tags).reshape(-1, 2) for photo in photos])
    kept = np.isfinite(uv[..., 0]).sum(axis=0) >= 2
    low = np.abs(papered.marks_m.reshape(-1, 3)[kept, 1] - PLATE_M) < 1e-9
    on_floor = np.tile(low & (shape.kind == "free"), (len(photos), 1))
    return Part(name=shape.name, parent=shape.parent, kind=shape.kind, uv_px=uv[:, kept], on_floor=on_floor)


def _cut(shapes: tuple[Shape, ...], cameras: tuple[Camera, ...], photos: list[Photo]) -> tuple[Masks, dict[str, float]]:
    """Cut each part out of a box that is drawn around it; gives the masks, and the mean overlap with the true ones."""
    masks: Masks = {shape.name: {} for shape in shapes}
    overlap: dict[str, list[float]] = {shape.name: [] for shape in shapes}
    for camera, photo in zip(cameras, photos, strict=True):
        # Children first: what is theirs is not their parent's, though it lies in its box.
        taken = np.zeros(photo.part.shape, dtype=bool)
        for number, shape in reversed(list(enumerate(shapes))):
            truth = photo.shown(number)
            rows, columns = (np.flatnonzero(truth.any(axis=axis)) for axis in (1, 0))
            width, height = camera.image_size_px
            box = (
                max(int(columns[0]) - BOX_PX, 0), max(int(rows[0]) - BOX_PX, 0),
                min(int(columns[-1]) + BOX_PX + 1, width), min(int(rows[-1]) + BOX_PX + 1, height),
            )  # fmt: skip
            found = cut_out(photo.rgb, box, without=taken)
            taken |= found
            masks[shape.name][camera.name] = found
            overlap[shape.name].append(float((found & truth).sum() / (found | truth).sum()))
    return masks, {part: float(np.mean(values)) for part, values in overlap.items()}


def _true_masks(shapes: tuple[Shape, ...], cameras: tuple[Camera, ...], photos: list[Photo]) -> Masks:
    return {
        shape.name: {c.name: photo.shown(k) for c, photo in zip(cameras, photos, strict=True)}
        for k, shape in enumerate(shapes)
    }


def _carved(
    part: str, masks: Masks, cameras: tuple[Camera, ...], Ts_world_part: Float[np.ndarray, "picture 4 4"]
) -> CarvedPart:
    return carve_part(tuple(silhouettes_of(part, masks, cameras, Ts_world_part, {})))


def _separate(body: VirtualBody, papered: tuple[PaperedPart, ...], seed: int) -> VirtualBody:
    """Rebuild the body's corners in each configuration by itself; gives the body with the motions that follow from them."""
    points: dict[str, list[np.ndarray]] = {part.name: [] for part in body.parts}
    for picture in range(len(body.cameras)):
        cameras = _finer(virtual_cameras(np.random.default_rng([seed, picture]), STILL))
        photos = [_photo(camera, body, papered, picture, 10 + seed) for camera in cameras]
        for part, paper_of_it in zip(body.parts, papered, strict=True):
            marks = np.stack([find_marks(photo, paper_of_it.tags).reshape(-1, 2) for photo in photos])
            points[part.name].append(_triangulated(cameras, marks))
    world = {name: np.stack([_laid(xyz[0], each) for each in xyz]) for name, xyz in points.items()}
    parents = {shape.name: shape.parent for shape in body.parts}
    local = {name: T if (above := parents[name]) is None else inverse(world[above]) @ T for name, T in world.items()}
    middles = {name: xyz[0][np.isfinite(xyz[0][:, 0])] for name, xyz in points.items()}
    return replace(body, Ts_world_part=world, Ts_parent_part=local, xyz_m=middles)


def _triangulated(
    cameras: tuple[Camera, ...], uv_px: Float[np.ndarray, "camera point 2"]
) -> Float[np.ndarray, "point 3"]:
    """Give the points nearest to their rays; NaN where fewer than two cameras see one, or a ray misses it."""
    xy = np.stack([normalize(camera, uv) for camera, uv in zip(cameras, uv_px, strict=True)])
    rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
    rays = np.stack([ray @ camera.T_lab_cam[:3, :3].T for ray, camera in zip(rays, cameras, strict=True)])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centres = np.stack([camera.centre_lab_m for camera in cameras])
    xyz = np.stack([nearest_to_rays(centres, rays[:, k]) for k in range(rays.shape[1])])
    off = np.stack([np.linalg.norm(project(c, xyz) - uv, axis=1) for c, uv in zip(cameras, uv_px, strict=True)])
    seen = np.isfinite(off)
    good = (seen.sum(axis=0) >= 2) & (np.where(seen, off, 0).max(axis=0) < MISFIT_PX)
    return np.where(good[:, None], xyz, np.nan)


def _laid(before: Float[np.ndarray, "point 3"], after: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "4 4"]:
    both = np.isfinite(before[:, 0]) & np.isfinite(after[:, 0])
    return align(before[both], after[both])
