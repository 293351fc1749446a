"""From masks and a solved motion to each part in 3D, and the whole body as in any picture (the paper's step D)."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gonio.errors import CaptureError, InputError
from gonio.formats.articulated import ArticulatedDocument
from gonio.formats.carving import CarvedPartDocument, CarvingDocument, CarvingFinding, write_carving
from gonio.formats.meshes import Posed, write_glb, write_ply
from gonio.kernel.articulated.chain import corrected_cameras
from gonio.kernel.carving.surface import VOXELS, carve_part
from gonio.pipeline.findings import finding
from gonio.records import Camera, CarvedPart, Finding, Silhouette
from gonio.vision.masks import read_mask
from gonio.vision.stills import IMAGE_SUFFIXES, read_rgb

MASKS, PICTURES, PARTS = "masks", "pictures", "parts"

LOW_OVERLAP = 0.85
"""Right masks and motions give 0.93 to 0.99, half a voxel and half a pixel all around (``gonio bench articulated``)."""

LEAST_JUDGED = 4
"""Of fewer silhouettes, any two that are left fit together nearly always: none can be blamed."""

COARSE_VOXELS = 64

VOXELS_ALLOWED = (16, 512)

Masks = dict[str, dict[str, np.ndarray]]


def carve_folder(
    folder: Path, cameras: tuple[Camera, ...], motion: ArticulatedDocument, voxels: int = VOXELS
) -> CarvingDocument:
    """Carve all parts that have masks; writes ``carving.json`` and ``parts/*.glb`` and ``.ply`` into the folder.

    The folder holds ``masks/PART/PICTURE.png`` and, for colours, ``pictures/PICTURE.jpg`` or another kind of picture.

    Args:
        folder: The folder of :func:`gonio.pipeline.articulated.solve_folder`.
        cameras: One a picture.
        motion: How the parts moved.
        voxels: Of each part's longest side.

    Raises:
        InputError: A mask or a picture is wrong; the message names it.
        CaptureError: ``hull-unbounded`` or ``hull-empty``; the message names the part.
    """
    if not VOXELS_ALLOWED[0] <= voxels <= VOXELS_ALLOWED[1]:
        raise InputError(
            f"A part can't have {voxels} voxels along its side.",
            hint="Choose {} to {}; 128 is fine for most.".format(*VOXELS_ALLOWED),
            code="voxels-unfit",
        )
    names = [joint.part for joint in motion.joints]
    masks = read_masks(folder / MASKS, names, cameras)
    pictures = _read_pictures(folder / PICTURES, cameras)
    Ts = {joint.part: np.array([p.T_world_part for p in joint.pictures]) for joint in motion.joints}
    carved: dict[str, CarvedPart] = {}
    findings: list[Finding] = []
    for name in masks:
        silhouettes = tuple(silhouettes_of(name, masks, cameras, Ts[name], pictures))
        try:
            carved[name] = carve_part(silhouettes, voxels)
        except CaptureError as error:
            raise CaptureError(f"Part {name}: {error.message}", hint=error.hint, code=error.code) from error
        findings += _judged(name, silhouettes, carved[name].overlap)
    out = folder / PARTS
    out.mkdir(exist_ok=True)
    parts = [
        CarvedPartDocument(
            part=name, volume_m3=part.volume_m3, voxel_m=part.step_m, coloured=float(part.mesh.coloured.mean()),
            overlap={c.name: float(o) for c, o in zip(_masked(cameras, masks[name]), part.overlap, strict=True)},
            files=_write(out, name, {name: (part.mesh, np.eye(4))}),
        )
        for name, part in carved.items()
    ]  # fmt: skip
    bodies = {
        camera.name: _write(out, f"body {camera.name}", {name: (p.mesh, Ts[name][i]) for name, p in carved.items()})
        for i, camera in enumerate(cameras)
    }
    findings += [finding("part-not-carved", where=name) for name in names if name not in carved]
    findings += [finding("part-without-colours", where=name) for name in carved if not pictures]
    document = CarvingDocument(
        reference=motion.reference, parts=parts, bodies=bodies, findings=[_told(each) for each in findings]
    )
    write_carving(folder / "carving.json", document)
    return document


def read_masks(folder: Path, parts: list[str], cameras: tuple[Camera, ...]) -> Masks:
    """Read ``PART/PICTURE.png``; gives the masks of each part by picture, parts without any left out.

    Raises:
        InputError: ``mask-unknown-part``, ``mask-unknown-picture``, ``masks-too-few``, ``masks-missing``, or a mask is
            unusable.
    """
    by_name = {camera.name: camera for camera in cameras}
    masks: Masks = {}
    for place in sorted(path for path in folder.iterdir() if not path.name.startswith(".")):
        if not place.is_dir() or place.name not in parts:
            raise InputError(
                f"{folder.name}/{place.name} is no folder of a part.",
                hint=f"Put the masks into {folder.name}/PART/PICTURE.png. The parts are {', '.join(parts)}.",
                code="mask-unknown-part",
            )
        own: dict[str, np.ndarray] = {}
        for path in sorted(path for path in place.iterdir() if not path.name.startswith(".")):
            if path.suffix.lower() != ".png" or path.stem not in by_name:
                raise InputError(
                    f"{folder.name}/{place.name}/{path.name} is no PNG of a picture.",
                    hint=f"Name each mask after its picture: {', '.join(f'{name}.png' for name in by_name)}.",
                    code="mask-unknown-picture",
                )
            own[path.stem] = read_mask(path, by_name[path.stem].image_size_px)
        if len(own) == 1:
            raise InputError(
                f"Part {place.name} has one mask only: one silhouette has no depth.",
                hint="Give masks in two pictures or more, better four.",
                code="masks-too-few",
            )
        if own:
            masks[place.name] = own
    if not masks:
        raise InputError(
            f"There is no mask in {folder.name}.",
            hint=f"Put them into {folder.name}/PART/PICTURE.png, or take the folder away.",
            code="masks-missing",
        )
    return masks


def silhouettes_of(
    part: str, masks: Masks, cameras: tuple[Camera, ...], Ts_world_part: np.ndarray, pictures: dict[str, np.ndarray]
) -> Iterator[Silhouette]:
    """Give what each picture with a mask shows of a part, from its corrected camera (eq. 20).

    Where another part is seen, it may hide this one: those pixels say nothing.
    """
    corrected = corrected_cameras(np.stack([camera.T_lab_cam for camera in cameras]), Ts_world_part)
    for camera, T in zip(cameras, corrected, strict=True):
        if camera.name not in masks[part]:
            continue
        shown = masks[part][camera.name]
        hidden = np.zeros_like(shown)
        for other, its in masks.items():
            if other != part and camera.name in its:
                hidden |= its[camera.name]
        yield Silhouette(
            camera=replace(camera, T_lab_cam=T), shown=shown, hidden=hidden & ~shown, rgb=pictures.get(camera.name)
        )


def _masked(cameras: tuple[Camera, ...], own: dict[str, np.ndarray]) -> list[Camera]:
    return [camera for camera in cameras if camera.name in own]


def _read_pictures(folder: Path, cameras: tuple[Camera, ...]) -> dict[str, np.ndarray]:
    pictures: dict[str, np.ndarray] = {}
    for camera in cameras:
        paths = [p for p in sorted(folder.glob("*")) if p.stem == camera.name and p.suffix.lower() in IMAGE_SUFFIXES]
        if not paths:
            continue
        rgb = read_rgb(paths[0])
        if rgb.shape[1::-1] != tuple(camera.image_size_px):
            raise InputError(
                f"{folder.name}/{paths[0].name} has {rgb.shape[1]} × {rgb.shape[0]} pixels, its camera "
                f"{camera.image_size_px[0]} × {camera.image_size_px[1]}.",
                hint="Give the photograph that was calibrated, without cutting or scaling it.",
                code="picture-wrong-size",
            )
        pictures[camera.name] = rgb
    return pictures


def _write(folder: Path, name: str, parts: Posed) -> list[str]:
    write_glb(folder / f"{name}.glb", parts)
    write_ply(folder / f"{name}.ply", parts)
    return [f"{folder.name}/{name}.{kind}" for kind in ("glb", "ply")]


def _judged(part: str, silhouettes: tuple[Silhouette, ...], overlap: np.ndarray) -> Iterator[Finding]:
    """Say that a part covers its masks badly, and which picture is to blame if leaving one out mends it.

    The blame has to be found so: a mask that lacks a piece carves it away everywhere, and is itself covered perfectly.
    """
    worst = int(np.argmin(overlap))
    if overlap[worst] >= LOW_OVERLAP:
        return
    where = f"{part} in {{}}"
    yield finding(
        "hull-overlap-low", where=where.format(silhouettes[worst].camera.name), value=100 * float(overlap[worst])
    )
    if len(silhouettes) < LEAST_JUDGED:
        return
    without: dict[str, float] = {}
    for left_out in silhouettes:
        others = tuple(each for each in silhouettes if each is not left_out)
        try:
            without[left_out.camera.name] = float(carve_part(others, COARSE_VOXELS).overlap.min())
        except CaptureError:
            continue
    picture, best = max(without.items(), key=lambda pair: pair[1], default=("", 0.0))
    if best >= LOW_OVERLAP:
        yield finding("picture-misfits", where=where.format(picture), value=100 * best)


def _told(each: Finding) -> CarvingFinding:
    return CarvingFinding.model_validate({name: getattr(each, name) for name in CarvingFinding.model_fields})
