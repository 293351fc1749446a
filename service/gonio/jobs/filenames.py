"""Which names an uploaded file may have: a name is taken as it is or refused, nothing is renamed in silence."""

import unicodedata
from pathlib import PurePath
from typing import get_args
from urllib.parse import unquote

from gonio.errors import InputError
from gonio.pipeline.run import ROLE_NAMES, CalibrationRole, ObjectRole, Role, TrialRole

MAX_BYTES = 255
"""The longest file name that the usual file systems take."""
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".m2ts", ".mpg", ".mpeg", ".webm", ".wmv")
IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
FORCE_COEFFICIENTS = ("forces.toml", "force_coefficients.toml")
PRESSURE_CARDS = ("pressure.toml", "pressure_card.toml")
OTHERS: dict[str, Role] = {
    ".osim": "body_model",
    ".zip": "keypoints",
    ".csv": "pressure",
    ".c3d": "force_plates",
    ".mot": "force_plates",
    ".sto": "force_plates",
}
CALIBRATIONS = (".toml", ".xml", ".txt", ".json", ".yaml", ".yml", ".calib")


def check_file_name(name: str) -> None:
    """Refuse a name that isn't plainly the name of one file.

    Raises:
        InputError: ``bad-file-name``, with the reason.
    """
    # Browsers and HTTP libraries percent-encode what they can't send, so what such a name stands for is looked at too.
    for text in {name, unquote(name, errors="surrogateescape")}:
        reason = _fault(text)
        if reason is not None:
            raise InputError(
                f"The file name {name[:80]!r} is not allowed: it {reason}.",
                hint=f"Give the file a plain name of at most {MAX_BYTES} bytes, such as cam01.mp4, and send it again.",
                code="bad-file-name",
            )


ROLES: dict[str, tuple[Role, ...]] = {
    "human_multicamera": get_args(TrialRole),
    "human_monocular": get_args(TrialRole),
    "articulated_object": get_args(ObjectRole),
    "calibration": get_args(CalibrationRole),
}
"""What the files of each kind of session may be."""
_OF_A_TRIAL = (
    "Videos end in .mp4, .mov or the like, a calibration in .toml, .json, .xml or .txt, a table of soles in .csv."
)
TELLING_NAMES = {
    "human_multicamera": _OF_A_TRIAL,
    "human_monocular": _OF_A_TRIAL,
    "articulated_object": "Call it body.toml, tracks.csv, cameras.json or background.csv; photographs end in .jpg or .png.",
    "calibration": "Call it board.toml, optics.toml or floor_points.toml; videos end in .mp4, .mov or the like.",
}
"""What a name must be like to tell the role, by the kind of session."""


def guess_role(name: str, kind: str) -> Role:
    """Tell from its name what a file is in a session of some kind.

    Raises:
        InputError: ``role-unknown``.
    """
    suffix = PurePath(name).suffix.lower()
    if kind == "articulated_object":
        guessed = _guess_object_role(PurePath(name).stem.lower(), suffix)
        if guessed is not None:
            return guessed
    elif kind == "calibration":
        if suffix in VIDEOS + IMAGES:
            return "sweep"
        named = ROLE_NAMES.get(PurePath(name).stem.lower().removesuffix(".qca"))
        if named is not None and suffix in CALIBRATIONS:
            return named
    elif suffix in VIDEOS:
        return "video"
    elif name.lower().endswith(PRESSURE_CARDS):
        return "pressure_card"
    elif name.lower().endswith(FORCE_COEFFICIENTS):
        return "force_coefficients"
    elif suffix in CALIBRATIONS:
        return "calibration"
    elif suffix in OTHERS:
        return OTHERS[suffix]
    raise InputError(
        f"The name {name!r} doesn't tell what the file is.",
        hint=f"{TELLING_NAMES[kind]} Or send the form field `role`: one of {', '.join(ROLES[kind])}.",
        code="role-unknown",
    )


def _guess_object_role(stem: str, suffix: str) -> Role | None:
    if suffix in IMAGES:
        return "picture"
    named: dict[str, Role] = {
        "body": "joint_tree", "tracks": "tracks", "background": "background", "cameras": "calibration"
    }  # fmt: skip
    return named.get(stem)


def check_role(role: Role, name: str, kind: str, camera: str | None) -> None:
    """Refuse a file that a session of its kind has no use for.

    Raises:
        InputError: ``role-wrong``, or ``camera-missing`` for a photograph of nobody knows which camera.
    """
    if role not in ROLES[kind]:
        raise InputError(
            f"A session of kind {kind} has no files of role {role}.",
            hint=f"Its files are: {', '.join(ROLES[kind])}.",
            code="role-wrong",
        )
    if PurePath(name).suffix.lower() in IMAGES and camera is None and role != "picture":
        raise InputError(
            f"It is not known which camera took the photograph {name}.",
            hint="Send the form field `camera` with its name.",
            code="camera-missing",
        )


def _fault(name: str) -> str | None:
    if not name.strip():
        return "is empty"
    if name in (".", ".."):
        return "is that of a folder"
    if "/" in name or "\\" in name:
        return "holds a path separator"
    # Control characters, undecodable bytes, line separators; and what makes a name look like another one.
    if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in "\u202a\u202b\u202c\u202d\u202e" for c in name):
        return "holds a character that can't be seen or decoded"
    if len(name.encode()) > MAX_BYTES:
        return f"is longer than {MAX_BYTES} bytes"
    return None
