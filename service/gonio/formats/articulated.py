"""Read an articulated body's inputs, ``body.toml`` and ``tracks.csv`` or ``tracks.json``, and write its result as JSON.

::

    # body.toml
    reference = "picture 1"           # the picture in which each part's frame is the world's; the first without it
    [floor]                           # needed only by parts that stand on it
    normal = [0, 1, 0]
    offset_m = 0.0
    [parts.base]
    joint = "free"                    # free, spherical, hinge, planar or prismatic
    on_floor = ["b1", "b2"]           # points that touch the floor in every picture
    [parts.arm]
    parent = "base"
    joint = "spherical"
    # length = { points = ["a1", "a4"], length_m = 0.31, sd_m = 0.001 }   # instead of a floor, for a free part

Without a file of the cameras, a table ``[background]`` (:mod:`gonio.formats.background`) says what of the background gives
them a measure. ``tracks.csv`` has the columns ``picture,part,point,u_px,v_px``, a row for each point that is seen;
``tracks.json`` is a list of objects with the same names. docs/howto/articulated.md shows both at work.
"""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, ValidationError

from gonio.errors import InputError
from gonio.formats.background import BackgroundCard
from gonio.formats.marks import LengthCard, bad_marks, read_marks
from gonio.formats.strict import Strict
from gonio.records import UNKNOWNS, Camera, Floor, JointKind, JointMotion, KnownLength, LocatedPictures, Part

FORMAT = "gonio articulated motion"

Three = tuple[float, float, float]
Matrix3 = tuple[Three, Three, Three]


class _PartCard(Strict):
    joint: JointKind
    parent: str | None = None
    on_floor: list[str] = Field(default_factory=list)
    length: LengthCard | None = None


class _FloorCard(Strict):
    normal: Three
    offset_m: float


class BodyCard(Strict):
    """The joint tree as ``body.toml`` has it."""

    parts: dict[str, _PartCard] = Field(min_length=1)
    floor: _FloorCard | None = None
    background: BackgroundCard | None = None
    reference: str | None = None


class Mark(Strict):
    """One mark of a part."""

    picture: str
    part: str
    point: str
    u_px: float
    v_px: float


def read_body_card(path: Path) -> BodyCard:
    """Read the joint tree.

    Raises:
        InputError: ``body-unreadable``; the message names the field and what is wrong with it.
    """
    try:
        return BodyCard.model_validate(tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except ValidationError as error:
        first = error.errors()[0]
        what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except (ValueError, OSError) as error:
        what = str(error).splitlines()[0]
    raise InputError(
        f"{path.name} can't be read as a joint tree: {what}.",
        hint="Give each part a table [parts.NAME] with joint = free, spherical, hinge, planar or prismatic.",
        code="body-unreadable",
    )


def floor_of(card: BodyCard) -> Floor | None:
    """Give the floor of a card; its normal is brought to unit length.

    Raises:
        InputError: ``body-unreadable``: the normal has no direction.
    """
    if card.floor is None:
        return None
    length = float(np.linalg.norm(card.floor.normal))
    if length == 0:
        raise InputError(
            "The floor's normal is zero.", hint="Give a vector that points up from the floor.", code="body-unreadable"
        )
    return Floor(normal=np.array(card.floor.normal) / length, offset_m=card.floor.offset_m / length)


def read_tracks(path: Path, card: BodyCard, pictures: tuple[str, ...]) -> tuple[tuple[Part, ...], dict[str, list[str]]]:
    """Read the marks of all parts; gives the parts, and the names of each one's points in order.

    Raises:
        InputError: ``tracks-unreadable`` (the row and the field are named), or ``part-with-few-points``.
    """
    marks = read_marks(path, Mark)
    names: dict[str, list[str]] = {part: [] for part in card.parts}
    for row, mark in enumerate(marks, start=1):
        if mark.part not in names:
            raise bad_marks(path, f"mark {row} is of part {mark.part}, which the joint tree does not have", names)
        if mark.picture not in pictures:
            raise bad_marks(path, f"mark {row} is in picture {mark.picture}, which has no camera", pictures)
        if mark.point not in names[mark.part]:
            names[mark.part].append(mark.point)
    tracks = {part: np.full((len(pictures), len(points), 2), np.nan) for part, points in names.items()}
    for row, mark in enumerate(marks, start=1):
        at = pictures.index(mark.picture), names[mark.part].index(mark.point)
        if np.isfinite(tracks[mark.part][at]).any():
            raise bad_marks(path, f"mark {row} is the second of {mark.part}'s point {mark.point} in {mark.picture}")
        tracks[mark.part][at] = mark.u_px, mark.v_px
    return tuple(_part(name, card.parts[name], tracks[name], names[name]) for name in card.parts), names


def picture_names(path: Path) -> tuple[str, ...]:
    """Give the pictures in the order in which the marks name them first.

    Raises:
        InputError: ``tracks-unreadable``.
    """
    return tuple(dict.fromkeys(mark.picture for mark in read_marks(path, Mark)))


def _part(name: str, card: _PartCard, uv_px: Float[np.ndarray, "picture point 2"], points: list[str]) -> Part:
    if len(points) < 6:
        raise InputError(
            f"Part {name} has too few points: {len(points)}.",
            hint="Mark six points or more on each part, better ten.",
            code="part-with-few-points",
        )
    named = [*card.on_floor, *(card.length.points if card.length else ())]
    for point in named:
        if point not in points:
            raise InputError(
                f"Part {name}: the joint tree names its point {point}, which is marked in no picture.",
                hint=f"Its points are {', '.join(points)}.",
                code="body-unreadable",
            )
    on_floor = np.zeros(uv_px.shape[:2], dtype=bool)
    on_floor[:, [points.index(point) for point in card.on_floor]] = True
    length = card.length and KnownLength(
        first=points.index(card.length.points[0]), second=points.index(card.length.points[1]),
        length_m=card.length.length_m, sd_m=card.length.sd_m,
    )  # fmt: skip
    return Part(name=name, parent=card.parent, kind=card.joint, uv_px=uv_px, on_floor=on_floor, length=length)


class PictureMotion(Strict):
    """Where one part is in one picture, against the reference picture."""

    picture: str
    quat_wxyz: tuple[float, float, float, float] = Field(description="Turn against the parent, w ≥ 0.")
    shift_m: Three = Field(description="Translation against the parent, of the world's origin as part of the part.")
    turn_deg: float
    turn_sd_deg: float = Field(description="Standard deviation of the turn: of the length of its error.")
    unsure: bool = Field(
        description="Whether that is beyond 3°, or a part that may turn about any axis has fewer than six believed marks "
        "in this picture or in the reference picture: so few can look the same in another pose."
    )
    T_world_part: list[list[float]] = Field(description="4 × 4: from the reference picture's world to this one's.")


class CameraMotion(Strict):
    """Where the camera was for one picture, as the background told it."""

    picture: str
    image_size_px: tuple[int, int]
    T_world_cam: list[list[float]] = Field(
        description="4 × 4: from the camera (x right, y down, z forward) to the world."
    )
    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = Field(description="OpenCV's (k1, k2, p1, p2, k3).")
    turn_sd_deg: float = Field(description="Standard deviation of the turn: of the length of its error.")
    shift_sd_m: float = Field(description="Standard deviation of the place, of the length of its error.")
    focal_sd_px: float


class CamerasDocument(Strict):
    """All pictures' cameras, as the background told them."""

    pictures: list[CameraMotion]
    covariance: list[list[float]] = Field(
        description="Of all cameras' unknowns, in the order camera, unknown: " + ", ".join(UNKNOWNS) + "."
    )
    points_m: dict[str, Three | None] = Field(description="The background's named points.")
    found_points: int = Field(
        description="How many points were found in the pictures beside the named ones, and believed."
    )
    wrong_marks: list[str] = Field(description="Named marks that were not believed, as picture/point.")
    noise_px: float


class JointDocument(Strict):
    """One joint's motion, place and error."""

    part: str
    parent: str | None
    joint: JointKind
    found_to_be_a_hinge: bool
    pictures: list[PictureMotion]
    centre_m: Three | None = Field(description="A spherical joint's centre in the reference picture's world.")
    centre_covariance_m2: Matrix3 | None
    axis: Three | None = Field(description="A hinge's axis or a prismatic joint's line.")
    axis_sd_deg: float | None
    axis_point_m: Three | None = Field(description="The point of a hinge's axis next to the part's middle.")
    points_m: dict[str, Three | None] = Field(description="Each point in the reference picture's world.")
    wrong_marks: list[str] = Field(description="Marks that were not believed, as picture/point.")
    noise_px: float
    ambiguous: bool = Field(description="Whether a different motion explains the pictures nearly as well.")


class RefusedPart(Strict):
    """A part whose motion was not told, or that hangs on one whose motion was not."""

    part: str
    parent: str | None
    joint: JointKind
    code: str
    message: str
    hint: str


class ArticulatedDocument(Strict):
    """The motion of an articulated body."""

    format: str = FORMAT
    version: int = 1
    reference: str
    joints: list[JointDocument]
    refused: list[RefusedPart] = Field(
        default=[], description="Parts whose motion these pictures do not tell, and why."
    )
    cameras: CamerasDocument | None = Field(default=None, description="Where the background told where the camera was.")


def articulated_schema() -> dict[str, Any]:
    """Give the result's JSON schema."""
    return ArticulatedDocument.model_json_schema()


def write_motion(path: Path, document: ArticulatedDocument) -> None:
    """Write the result."""
    path.write_text(document.model_dump_json(indent=2) + "\n", encoding="utf-8")


def joint_document(
    motion: JointMotion, part: Part, pictures: tuple[str, ...], points: list[str], quats: Float[np.ndarray, "picture 4"],
    *, reference: int,
) -> JointDocument:  # fmt: skip
    """Bring one joint's motion into the file's units; ``quats`` are its turns as wxyz with w ≥ 0."""
    sd = np.degrees(motion.rotation_sd_rad)
    turn = np.degrees(2 * np.arctan2(np.linalg.norm(quats[:, 1:], axis=1), quats[:, 0]))
    wrong = np.isfinite(part.uv_px[..., 0]) & ~motion.used
    # One pose of few points may have a twin in the picture; about a known axis it has none.
    believed = motion.used.sum(axis=1)
    few = (np.minimum(believed, believed[reference]) < SURE_MARKS) & (motion.kind in ("free", "spherical"))
    return JointDocument(
        part=part.name, parent=part.parent, joint=motion.kind, found_to_be_a_hinge=motion.found_hinge,
        pictures=[
            PictureMotion(
                picture=name, quat_wxyz=tuple(quats[i].tolist()), shift_m=_three(motion.Ts_parent_part[i, :3, 3]),
                turn_deg=float(turn[i]), turn_sd_deg=float(sd[i]), unsure=bool(sd[i] > UNSURE_DEG or few[i]),
                T_world_part=motion.Ts_world_part[i].tolist(),
            )
            for i, name in enumerate(pictures)
        ],
        centre_m=_maybe(motion.centre_m),
        centre_covariance_m2=None if np.isnan(motion.centre_m).any() else tuple(map(_three, motion.centre_covariance_m2)),  # pyright: ignore[reportArgumentType] - three rows
        axis=_maybe(motion.axis),
        axis_sd_deg=None if np.isnan(motion.axis).any() else float(np.degrees(np.sqrt(np.trace(motion.axis_covariance)))),
        axis_point_m=_maybe(motion.axis_point_m),
        points_m={name: _maybe(xyz) for name, xyz in zip(points, motion.xyz_m, strict=True)},
        wrong_marks=[f"{pictures[i]}/{points[k]}" for i, k in np.argwhere(wrong)],
        noise_px=motion.sigma_px, ambiguous=motion.other is not None,
    )  # fmt: skip


def cameras_document(located: LocatedPictures, points: list[str]) -> CamerasDocument:
    """Bring what the background told into the file's units; ``points`` names the first of its points, the others were found."""
    width = len(UNKNOWNS)
    pictures = []
    for i, camera in enumerate(located.cameras):
        block = located.covariance[width * i : width * (i + 1), width * i : width * (i + 1)]
        K = camera.intrinsic_px
        # The centre is −Rᵀ t: of the pose's small changes (turn, shift) only the shift moves it.
        pictures.append(
            CameraMotion(
                picture=camera.name, image_size_px=camera.image_size_px, T_world_cam=camera.T_lab_cam.tolist(),
                focal_px=float(K[0, 0]),
                principal_px=(float(K[0, 2]), float(K[1, 2])), distortion=tuple(camera.distortion.tolist()),
                turn_sd_deg=float(np.degrees(np.sqrt(np.trace(block[:3, :3])))),
                shift_sd_m=float(np.sqrt(np.trace(block[3:6, 3:6]))), focal_sd_px=float(np.sqrt(block[6, 6])),
            )
        )  # fmt: skip
    named = located.used[:, : len(points)]
    marked = np.isfinite(located.uv_px[:, : len(points), 0])
    return CamerasDocument(
        pictures=pictures,
        covariance=located.covariance.tolist(),
        points_m={name: _maybe(xyz) for name, xyz in zip(points, located.xyz_m[: len(points)], strict=True)},
        found_points=int(located.used[:, len(points) :].any(axis=0).sum()),
        wrong_marks=[f"{located.cameras[i].name}/{points[k]}" for i, k in np.argwhere(marked & ~named)],
        noise_px=located.sigma_px,
    )


def read_cameras(document: CamerasDocument) -> tuple[Camera, ...]:
    """Give the cameras that the background told."""
    return tuple(
        Camera(
            name=picture.picture,
            image_size_px=picture.image_size_px,
            intrinsic_px=np.array(
                [
                    [picture.focal_px, 0, picture.principal_px[0]],
                    [0, picture.focal_px, picture.principal_px[1]],
                    [0, 0, 1],
                ]
            ),
            distortion=np.array(picture.distortion),
            T_lab_cam=np.array(picture.T_world_cam),
        )
        for picture in document.pictures
    )


UNSURE_DEG = 3.0
"""A turn whose predicted standard deviation is beyond this is marked: nearly all gross errors are."""

SURE_MARKS = 6
"""Fewer believed marks of a part that may turn about any axis are no verdict: a second pose may fit them."""


def _three(values: Float[np.ndarray, "3"]) -> Three:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _maybe(values: Float[np.ndarray, "3"]) -> Three | None:
    return None if np.isnan(values).any() else _three(values)
