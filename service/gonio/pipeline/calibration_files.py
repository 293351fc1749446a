"""What a calibration is made from: files in roles, and how they are found in a folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gonio.errors import InputError
from gonio.formats.board_card import BoardCard, load_board_card, read_board_card
from gonio.pipeline.folder import OUR_FOLDER, VIDEO_SUFFIXES
from gonio.pipeline.run import ROLE_NAMES, CalibrationRole, CaptureFile
from gonio.vision.stills import IMAGE_SUFFIXES

ROLE_FOLDERS: dict[str, CalibrationRole] = {
    "intrinsic": "lens", "intrinsics": "lens", "int": "lens", "lens": "lens", "lenses": "lens",
    "extrinsic": "sweep", "extrinsics": "sweep", "ext": "sweep", "sweep": "sweep", "floor": "floor",
}  # fmt: skip


@dataclass(frozen=True)
class CameraPictures:
    """A camera's recording in one role: a video, or photographs in their order."""

    camera: str
    paths: tuple[Path, ...]

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return len(self.paths) == 1 and self.paths[0].suffix.lower() in VIDEO_SUFFIXES


def find_calibration_files(folder: Path) -> list[CaptureFile]:
    """List what a folder and its subfolders hold for a calibration.

    Pictures are a lens's own in a folder called ``intrinsics`` (or ``lens``), the floor's in ``floor``, and the sweep
    everywhere else. A camera is called as its video, or as the folder of its photographs. The card is ``board.toml`` (or
    ``charuco.toml``), known lenses are ``optics.*``, floor points ``floor_points.toml``.

    Raises:
        InputError: ``folder-missing``, or ``folder-empty`` if it holds neither videos nor photographs.
    """
    if not folder.is_dir():
        raise InputError(
            f"{folder} is no folder.",
            hint="Give the folder with the cameras' videos of the board.",
            code="folder-missing",
        )
    found: list[CaptureFile] = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and OUR_FOLDER not in p.relative_to(folder).parts):
        suffix, stem = path.suffix.lower(), path.stem.lower()
        if suffix in IMAGE_SUFFIXES.union(VIDEO_SUFFIXES):
            role, camera = _role_and_camera(path.relative_to(folder), suffix in IMAGE_SUFFIXES)
            found.append(CaptureFile(path=path, name=path.name, role=role, camera=camera))
        elif stem.removesuffix(".qca") in ROLE_NAMES and suffix != ".pdf":  # a card's own print lies beside it
            role = ROLE_NAMES[stem.removesuffix(".qca")]
            found.append(CaptureFile(path=path, name=path.name, role=role))
    if not any(file.role in ("sweep", "lens") for file in found):
        raise InputError(
            f"{folder} holds no videos or photographs of a board.",
            hint="Put each camera's video there, named after the camera.",
            code="folder-empty",
        )
    return found


def pictures_of(files: Sequence[CaptureFile], role: CalibrationRole) -> tuple[CameraPictures, ...]:
    """Group the files of a role by camera.

    Raises:
        InputError: ``calibration-files-mixed``: a camera has two videos, or a video and photographs.
    """
    grouped: dict[str, list[CaptureFile]] = {}
    for file in files:
        if file.role == role:
            grouped.setdefault(file.camera or file.path.stem, []).append(file)
    for camera, own in grouped.items():
        if len(own) > 1 and any(file.path.suffix.lower() in VIDEO_SUFFIXES for file in own):
            raise InputError(
                f"Camera {camera} has several recordings as {role}: {', '.join(file.name for file in own)}.",
                hint="Give one video a camera, or photographs alone.",
                code="calibration-files-mixed",
            )
    return tuple(
        CameraPictures(camera, tuple(file.path for file in sorted(own, key=lambda f: f.name)))
        for camera, own in sorted(grouped.items())
    )


def read_card(files: Sequence[CaptureFile], wanted: str) -> BoardCard:
    """Give the board's card: the one that was named, else the one among the files.

    Raises:
        InputError: ``board-missing`` or ``board-ambiguous``; or what reading the card says.
    """
    if wanted:
        return load_board_card(wanted)
    cards = [file for file in files if file.role == "board"]
    if len(cards) != 1:
        raise InputError(
            "It is not known which board was filmed."
            if not cards
            else f"There are {len(cards)} cards of boards: {', '.join(file.name for file in cards)}.",
            hint="Give its card (board.toml), or the name of one of gonio's boards.",
            code="board-ambiguous" if cards else "board-missing",
        )
    return read_board_card(cards[0].path)


def only_file(files: Sequence[CaptureFile], role: CalibrationRole) -> CaptureFile | None:
    """Give the only file of a role, None where there is none.

    Raises:
        InputError: ``calibration-files-mixed``: there are several.
    """
    own = [file for file in files if file.role == role]
    if len(own) > 1:
        raise InputError(
            f"There are {len(own)} files as {role}: {', '.join(file.name for file in own)}.",
            hint="Delete all but one.",
            code="calibration-files-mixed",
        )
    return own[0] if own else None


def _role_and_camera(path: Path, is_photograph: bool) -> tuple[CalibrationRole, str]:
    """Tell from the folders what a picture is, and from its own name or its folder's whose."""
    folders = [part.lower() for part in path.parts[:-1]]
    roles: list[CalibrationRole] = [ROLE_FOLDERS[part] for part in reversed(folders) if part in ROLE_FOLDERS]
    role: CalibrationRole = roles[0] if roles else "sweep"
    own_folder = path.parent.name
    has_own = is_photograph and own_folder and own_folder.lower() not in (*ROLE_FOLDERS, "calibration")
    return role, _plain(own_folder if has_own else path.stem)


def _plain(name: str) -> str:
    """Take a camera's name out of Pose2Sim's ``int_cam01_img`` and ``cam01_ext``."""
    bare = re.sub(r"_(imgs?|images|vids?|videos?|int|ext)$", "", name, flags=re.IGNORECASE)
    return re.sub(r"^(int|ext|intrinsics?|extrinsics?)_", "", bare, flags=re.IGNORECASE) or name
