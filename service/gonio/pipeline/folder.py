"""Find the recordings in a folder, for an analysis without a server."""

from pathlib import Path

from gonio.errors import InputError
from gonio.pipeline.run import CaptureFile

VIDEO_SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts"}
CALIBRATION_SUFFIXES = (".qca.txt",)
MARKER_SET_SUFFIX = ".markerset.toml"
PRESSURE_CARD_SUFFIX = "pressure.toml"
PLATE_SUFFIXES = {".c3d", ".mot", ".sto"}


def find_capture_files(folder: Path) -> list[CaptureFile]:
    """List the recordings in a folder and its subfolders, by their suffixes; also a body model and its marker set.

    Raises:
        InputError: ``folder-missing``, or ``folder-empty`` if it holds no videos.
    """
    if not folder.is_dir():
        raise InputError(
            f"{folder} is no folder.",
            hint="Give the folder that holds the videos and the calibration.",
            code="folder-missing",
        )
    found: list[CaptureFile] = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if path.name.lower().endswith(CALIBRATION_SUFFIXES):
            found.append(CaptureFile(path=path, name=path.name, role="calibration"))
        elif path.name.lower().endswith(MARKER_SET_SUFFIX):
            found.append(CaptureFile(path=path, name=path.name, role="marker_set"))
        elif path.name.lower().endswith(PRESSURE_CARD_SUFFIX):
            found.append(CaptureFile(path=path, name=path.name, role="pressure_card"))
        elif path.suffix.lower() == ".csv":
            found.append(CaptureFile(path=path, name=path.name, role="pressure"))
        elif path.suffix.lower() in PLATE_SUFFIXES:
            found.append(CaptureFile(path=path, name=path.name, role="force_plates"))
        elif path.suffix.lower() == ".osim":
            found.append(CaptureFile(path=path, name=path.name, role="body_model"))
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            found.append(CaptureFile(path=path, name=path.name, role="video"))
    if not any(file.role == "video" for file in found):
        raise InputError(
            f"{folder} holds no videos.",
            hint=f"Videos end in {', '.join(sorted(VIDEO_SUFFIXES))}; the calibration in {', '.join(CALIBRATION_SUFFIXES)}.",
            code="folder-empty",
        )
    return found
