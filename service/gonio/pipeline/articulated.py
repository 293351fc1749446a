"""From a folder with cameras, joint tree and marks to the motion of an articulated body."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from gonio.errors import InputError
from gonio.formats.articulated import (
    ArticulatedDocument,
    floor_of,
    joint_document,
    read_body_card,
    read_tracks,
    write_motion,
)
from gonio.formats.calibration import read_calibration
from gonio.kernel.articulated.chain import solve_body
from gonio.records import Camera

CAMERAS, TRACKS = ("cameras.json", "cameras.toml"), ("tracks.csv", "tracks.json")


def solve_folder(folder: Path, output: Path | None = None) -> ArticulatedDocument:
    """Solve the body in a folder and write ``motion.json`` into it, or to ``output``.

    The folder holds ``cameras.json`` or ``cameras.toml`` (any calibration file that gonio reads, with one camera a picture,
    named after it), ``body.toml``, and ``tracks.csv`` or ``tracks.json``.

    Raises:
        InputError: A file is missing or wrong; the message names it.
        CaptureError: A joint's motion can't be told from these pictures; the code says why.
    """
    cameras = cameras_of(folder)
    card = read_body_card(one_of(folder, ("body.toml",)))
    pictures = tuple(camera.name for camera in cameras)
    parts, points = read_tracks(one_of(folder, TRACKS), card, pictures)
    reference = card.reference or pictures[0]
    if reference not in pictures:
        raise InputError(
            f"body.toml: the reference picture {reference} has no camera.",
            hint=f"Choose one of {', '.join(pictures)}.",
            code="body-unreadable",
        )
    with threadpool_limits(limits=1, user_api="blas"):
        motions = solve_body(cameras, parts, floor_of(card), reference=pictures.index(reference))
    by_name = {part.name: part for part in parts}
    joints = []
    for motion in motions:
        quats = Rotation.from_matrix(motion.Ts_parent_part[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
        joints.append(joint_document(motion, by_name[motion.part], pictures, points[motion.part], np.asarray(quats)))
    document = ArticulatedDocument(reference=reference, joints=joints)
    write_motion(output or folder / "motion.json", document)
    return document


def cameras_of(folder: Path) -> tuple[Camera, ...]:
    """Read the folder's cameras, one a picture."""
    return read_calibration(one_of(folder, CAMERAS)).cameras


def one_of(folder: Path, names: tuple[str, ...]) -> Path:
    """Give the first of these files that the folder has.

    Raises:
        InputError: ``file-missing``.
    """
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise InputError(
        f"{folder} has no {' or '.join(names)}.",
        hint="A folder needs cameras.json or .toml, body.toml, and tracks.csv or .json: see docs/howto/articulated.md.",
        code="file-missing",
    )
