"""From a folder with cameras or their background, joint tree and marks to the motion of an articulated body."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, InputError
from gonio.formats.articulated import (
    ArticulatedDocument,
    BodyCard,
    RefusedPart,
    cameras_document,
    floor_of,
    joint_document,
    picture_names,
    read_body_card,
    read_cameras,
    read_tracks,
    write_motion,
)
from gonio.formats.background import BackgroundCard, read_background
from gonio.formats.calibration import read_calibration, read_own_calibration
from gonio.kernel.articulated.background import locate_pictures
from gonio.kernel.articulated.chain import in_tree_order, solve_body
from gonio.kernel.parallel import one_blas_thread
from gonio.records import Background, Camera, Floor, JointMotion, LocatedPictures, Part
from gonio.vision.background import find_background
from gonio.vision.stills import IMAGE_SUFFIXES, read_grey

CAMERAS, TRACKS = ("cameras.json", "cameras.toml"), ("tracks.csv", "tracks.json")
BACKGROUND, PICTURES = ("background.csv", "background.json"), "pictures"


@dataclass(frozen=True)
class Photographs:
    """Where the camera was for each picture, how well that is known (None: taken as exact), and the floor."""

    cameras: tuple[Camera, ...]
    covariance: Float[np.ndarray, "unknown unknown"] | None
    floor: Floor | None
    located: LocatedPictures | None
    background_points: list[str]


def solve_folder(folder: Path, output: Path | None = None) -> ArticulatedDocument:
    """Solve the body in a folder and write ``motion.json`` into it, or to ``output``.

    The folder holds ``body.toml`` and ``tracks.csv`` or ``tracks.json``, and what tells where the camera was: a
    ``cameras.json`` or ``cameras.toml`` (any calibration file that gonio reads, with one camera a picture, named after it), or
    marks of the background in ``background.csv`` or ``background.json``, or the photographs in a folder ``pictures``.

    Raises:
        InputError: A file is missing or wrong; the message names it.
        CaptureError: The cameras or no joint's motion can be told from these pictures; the code says why.
    """
    card = read_body_card(one_of(folder, ("body.toml",)))
    photographs = locate(
        card,
        _any_of(folder, CAMERAS),
        _any_of(folder, BACKGROUND),
        pictures_in(folder / PICTURES),
        one_of(folder, TRACKS),
    )
    document = solve_photographed(card, photographs, one_of(folder, TRACKS))
    if not document.joints:
        first = document.refused[0]
        raise CaptureError(first.message, hint=first.hint, code=first.code)
    write_motion(output or folder / "motion.json", document)
    return document


def cameras_of(folder: Path, motion: ArticulatedDocument) -> tuple[Camera, ...]:
    """Give the cameras that a motion was solved with, one a picture: the folder's, or those that the background told."""
    if motion.cameras:
        return read_cameras(motion.cameras)
    pictures = tuple(picture.picture for picture in motion.joints[0].pictures)
    return _for_each(read_calibration(one_of(folder, CAMERAS)).cameras, pictures)


def pictures_in(folder: Path) -> dict[str, Path]:
    """Give the photographs of a folder by name, without their suffix, in alphabetical order; none if there is no folder."""
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return {path.stem: path for path in paths}


def locate(
    card: BodyCard, cameras: Path | None, background: Path | None, pictures: dict[str, Path], tracks: Path
) -> Photographs:
    """Read the cameras, or find them from the background (step A).

    Raises:
        InputError: A file is missing or wrong.
        CaptureError: The background does not tell the cameras.
    """
    if cameras is not None:
        own = read_own_calibration(cameras)
        rig = read_calibration(cameras)
        return Photographs(rig.cameras, own.covariance if own else None, floor_of(card), None, [])
    if background is None and not pictures:
        raise InputError(
            "Nothing tells where the camera was.",
            hint="Give cameras.json or .toml, or background.csv, or the photographs themselves in a folder pictures: see "
            "docs/howto/articulated.md.",
            code="file-missing",
        )
    marked, points = _background(card, background, pictures, tracks)
    with one_blas_thread():
        located = locate_pictures(marked)
    floor = Floor(normal=np.array([0.0, 1.0, 0.0]), offset_m=0.0) if marked.floor_points else floor_of(card)
    return Photographs(located.cameras, located.covariance, floor, located, points)


def _background(
    card: BodyCard, path: Path | None, pictures: dict[str, Path], tracks: Path
) -> tuple[Background, list[str]]:
    greys = {name: read_grey(file) for name, file in pictures.items()}
    sizes = {(grey.shape[1], grey.shape[0]) for grey in greys.values()}
    if len(sizes) > 1:
        raise InputError(
            f"The pictures are of {len(sizes)} sizes: {', '.join(f'{w} × {h}' for w, h in sorted(sizes))}.",
            hint="Give all pictures as the camera took them, none cut or turned.",
            code="pictures-differ",
        )
    marked, points = read_background(
        path, card.background or BackgroundCard(), pictures=tuple(greys),
        image_size_px=sizes.pop() if sizes else None, reference=card.reference,
    )  # fmt: skip
    if not greys:
        return marked, points
    parts, _ = read_tracks(tracks, card, marked.pictures)
    still = [_beside(parts, i, grey.shape) for i, grey in enumerate(greys.values())]
    found = find_background(list(greys.values()), still)
    return replace(marked, uv_px=np.concatenate([marked.uv_px, found], axis=1), found=found.shape[1]), points


def _beside(parts: tuple[Part, ...], picture: int, shape: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    """Give where a picture shows no part: outside the convex hull of each part's marks."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    still = np.ones(shape, dtype=bool)
    for part in parts:
        uv = part.uv_px[picture]
        uv = uv[np.isfinite(uv[:, 0])]
        try:
            sides = ConvexHull(uv).equations if len(uv) > 2 else []
        except QhullError:
            continue
        inside = np.ones(shape, dtype=bool)
        for a, b, c in sides:
            inside &= a * columns + b * rows + c <= 0
        still &= ~inside if len(sides) else True
    return still


def solve_photographed(card: BodyCard, photographs: Photographs, tracks: Path) -> ArticulatedDocument:
    """Solve all parts that the pictures tell of; those that they do not are listed as refused, with their children.

    Raises:
        InputError: The marks or the joint tree are wrong, or do not fit the cameras.
    """
    cameras, covariance = _for_each(photographs.cameras, picture_names(tracks)), photographs.covariance
    pictures = tuple(camera.name for camera in cameras)
    if covariance is not None:  # a camera that stands for several pictures has the same errors in all
        times = len(cameras) // len(photographs.cameras)
        photographs = replace(photographs, covariance=np.tile(covariance, (times, times)))
    photographs = replace(photographs, cameras=cameras)
    parts, points = read_tracks(tracks, card, pictures)
    reference = card.reference or pictures[0]
    if reference not in pictures:
        raise InputError(
            f"body.toml: the reference picture {reference} has no camera.",
            hint=f"Choose one of {', '.join(pictures)}.",
            code="body-unreadable",
        )
    motions, refused = _solve(parts, photographs, pictures.index(reference))
    by_name = {part.name: part for part in parts}
    joints = []
    for motion in motions:
        quats = Rotation.from_matrix(motion.Ts_parent_part[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
        joints.append(
            joint_document(
                motion, by_name[motion.part], pictures, points[motion.part], np.asarray(quats),
                reference=pictures.index(reference),
            )
        )  # fmt: skip
    located = photographs.located
    return ArticulatedDocument(
        reference=reference,
        joints=joints,
        refused=refused,
        cameras=cameras_document(located, photographs.background_points) if located else None,
    )


def _for_each(cameras: tuple[Camera, ...], pictures: tuple[str, ...]) -> tuple[Camera, ...]:
    """Let a single camera stand for all pictures, if none has its name: it stood still."""
    if len(cameras) != 1 or cameras[0].name in pictures:
        return cameras
    return tuple(replace(cameras[0], name=picture) for picture in pictures)


def _solve(
    parts: tuple[Part, ...], photographs: Photographs, reference: int
) -> tuple[tuple[JointMotion, ...], list[RefusedPart]]:
    """Solve the body; a part that the pictures do not tell of is left out with all that hangs on it, and the rest solved."""
    refused: list[RefusedPart] = []
    left = in_tree_order(parts)
    while left:
        try:
            with one_blas_thread():
                motions = solve_body(
                    photographs.cameras, left, photographs.floor, reference=reference,
                    camera_covariance=photographs.covariance,
                )  # fmt: skip
        except CaptureError as error:
            gone = [part for part in left if part.name == error.details.get("part")]
            if not gone:
                raise
            refused.append(_refused(gone[0], error.code, error.message, error.hint))
            for part in left:
                if part.parent in [each.name for each in gone]:
                    gone.append(part)
                    message = f"Part {part.name}: it hangs on {part.parent}, whose motion can't be told."
                    refused.append(_refused(part, "parent-refused", message, f"See to {part.parent} first."))
            left = tuple(part for part in left if part not in gone)
        else:
            return motions, refused
    return (), refused


def _refused(part: Part, code: str, message: str, hint: str) -> RefusedPart:
    return RefusedPart(part=part.name, parent=part.parent, joint=part.kind, code=code, message=message, hint=hint)


def articulated_lines(document: ArticulatedDocument) -> list[str]:
    """Say what was found, a line a joint."""
    lines = []
    if document.cameras is not None:
        worst = max(document.cameras.pictures, key=lambda picture: picture.shift_sd_m)
        lines.append(
            f"cameras: known to {1000 * worst.shift_sd_m:.2g} mm and {worst.turn_sd_deg:.2g}° or better, noise "
            f"{document.cameras.noise_px:.2g} px"
        )
    for joint in document.joints:
        sd = max(picture.turn_sd_deg for picture in joint.pictures)
        doubt = "; a different motion explains the pictures nearly as well" if joint.ambiguous else ""
        turns = ", ".join(f"{picture.turn_deg:.1f}" for picture in joint.pictures)
        lines.append(
            f"{joint.part}: {joint.joint}, turned by {turns}°, known to {sd:.2g}°, noise {joint.noise_px:.2g} px{doubt}"
        )
    lines += [f"{part.part}: refused ({part.code}). {part.message} → {part.hint}" for part in document.refused]
    return lines


def _any_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def one_of(folder: Path, names: tuple[str, ...]) -> Path:
    """Give the first of these files that the folder has.

    Raises:
        InputError: ``file-missing``.
    """
    found = _any_of(folder, names)
    if found is None:
        raise InputError(
            f"{folder} has no {' or '.join(names)}.",
            hint="A folder needs body.toml, tracks.csv or .json, and cameras or their background: see "
            "docs/howto/articulated.md.",
            code="file-missing",
        )
    return found
