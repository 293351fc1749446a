"""Read what tells where the camera was: the table ``[background]`` of ``body.toml``, and ``background.csv`` or ``.json``.

::

    [background]
    image_size_px = [4000, 3000]       # may be left out where the pictures themselves are given
    floor_points = ["f1", "f2", "f3"]  # three or more; f1 becomes the origin, f2 lies along X
    heights = [{ picture = "left", height_m = 1.42, sd_m = 0.01 }]
    lengths = [{ points = ["f1", "f2"], length_m = 0.60, sd_m = 0.001 }]   # heights, lengths or both
    # focal_px = { left = 3100.0 }     # of pictures whose zoom is known; focal_sd_px says how well
    # principal_px, distortion         # of a lens that is known; principal_sd_px and k1_sd say how well

``background.csv`` has the columns ``picture,point,u_px,v_px``; docs/howto/articulated.md shows it at work.
"""

from pathlib import Path

import numpy as np
from pydantic import Field

from gonio.errors import InputError
from gonio.formats.marks import LengthCard, bad_marks, read_marks
from gonio.formats.strict import Strict
from gonio.records import Background, CameraHeight, KnownLength, Lens

PRINCIPAL_SD, K1_SD = 0.01, 0.03
"""Where a lens is not known: its principal point is off the picture's middle by so many longer sides, its k1 off 0."""


class _HeightCard(Strict):
    picture: str
    height_m: float = Field(gt=0)
    sd_m: float = Field(default=0.01, ge=0)


class BackgroundCard(Strict):
    """What is known of the background, the camera's height and the lens."""

    image_size_px: tuple[int, int] | None = None
    floor_points: list[str] = Field(default_factory=list)
    lengths: list[LengthCard] = Field(default_factory=list)
    heights: list[_HeightCard] = Field(default_factory=list)
    focal_px: dict[str, float] = Field(default_factory=dict)
    focal_sd_px: float = Field(default=0.0, ge=0)
    principal_px: tuple[float, float] | None = None
    principal_sd_px: float | None = Field(default=None, ge=0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    k1_sd: float | None = Field(default=None, ge=0)


class BackgroundMark(Strict):
    """One mark of what stands still."""

    picture: str
    point: str
    u_px: float
    v_px: float


def read_background(
    path: Path | None,
    card: BackgroundCard,
    *,
    pictures: tuple[str, ...] = (),
    image_size_px: tuple[int, int] | None = None,
    reference: str | None = None,
) -> tuple[Background, list[str]]:
    """Read marks and card; gives the names of the points in order too.

    Args:
        path: The table; None where all points are going to be found in the pictures.
        card: The table ``[background]``.
        pictures: The pictures' names; those of the table in its order without them.
        image_size_px: The pictures' size, where they are given.
        reference: The reference picture's name; the first without it.

    Raises:
        InputError: ``tracks-unreadable``, ``body-unreadable`` with the field, or what :class:`~gonio.records.Background`
            refuses.
    """
    marks = read_marks(path, BackgroundMark) if path else []
    names = list(pictures or dict.fromkeys(mark.picture for mark in marks))
    points = list(dict.fromkeys(mark.point for mark in marks))
    uv = np.full((len(names), len(points), 2), np.nan)
    for row, mark in enumerate(marks, start=1):
        assert path is not None
        columns = tuple(BackgroundMark.model_fields)
        if mark.picture not in names:
            raise bad_marks(path, f"mark {row} is in {mark.picture}, which is no picture", names, columns=columns)
        at = names.index(mark.picture), points.index(mark.point)
        if np.isfinite(uv[at]).any():
            raise bad_marks(path, f"mark {row} is the second of point {mark.point} in {mark.picture}", columns=columns)
        uv[at] = mark.u_px, mark.v_px
    return Background(
        pictures=tuple(names),
        uv_px=uv,
        lens=_lens(card, names, image_size_px or card.image_size_px),
        floor_points=tuple(_index(points, name, "floor_points") for name in card.floor_points),
        lengths=tuple(
            KnownLength(
                first=_index(points, each.points[0], "lengths"),
                second=_index(points, each.points[1], "lengths"),
                length_m=each.length_m,
                sd_m=each.sd_m,
            )
            for each in card.lengths
        ),
        heights=tuple(
            CameraHeight(picture=_index(names, each.picture, "heights"), height_m=each.height_m, sd_m=each.sd_m)
            for each in card.heights
        ),
        reference=_index(names, reference, "reference") if reference else 0,
    ), points


def _lens(card: BackgroundCard, names: list[str], size: tuple[int, int] | None) -> Lens:
    if size is None:
        raise InputError(
            "body.toml: background.image_size_px is missing, and there are no pictures to take it from.",
            hint="Give the pictures' width and height, such as image_size_px = [4000, 3000].",
            code="body-unreadable",
        )
    focal = np.full(len(names), np.nan)
    for name, value in card.focal_px.items():
        focal[_index(names, name, "focal_px")] = value
    known = card.principal_px is not None
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    principal_sd = 0.0 if known else PRINCIPAL_SD * max(size)
    return Lens(
        image_size_px=size,
        focal_px=focal,
        focal_sd_px=card.focal_sd_px,
        principal_px=np.array(card.principal_px or middle),
        principal_sd_px=principal_sd if card.principal_sd_px is None else card.principal_sd_px,
        distortion=np.array(card.distortion),
        k1_sd=(0.0 if any(card.distortion) else K1_SD) if card.k1_sd is None else card.k1_sd,
    )


def _index(names: list[str], name: str, field: str) -> int:
    if name in names:
        return names.index(name)
    raise InputError(
        f"body.toml: background.{field} names {name}, which is marked nowhere.",
        hint=f"Known are {', '.join(names) or 'none: give background.csv'}.",
        code="body-unreadable",
    )
