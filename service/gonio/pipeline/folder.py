"""Find the recordings in a folder, for an analysis without a server."""

from pathlib import Path

from gonio.errors import InputError
from gonio.formats.openpose import holds_poses
from gonio.pipeline.run import CaptureFile, TrialRole

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts")
CALIBRATION_SUFFIXES = (".qca.txt", "calib.toml", "calibration.toml", "calibration.json", "calibration.yaml")
ENDINGS: tuple[tuple[tuple[str, ...], TrialRole], ...] = (
    (CALIBRATION_SUFFIXES, "calibration"),
    ((".markerset.toml",), "marker_set"),
    (("pressure.toml",), "pressure_card"),
    (("forces.toml", "force_coefficients.toml"), "force_coefficients"),
    ((".csv",), "pressure"),
    ((".c3d", ".mot", ".sto"), "force_plates"),
    ((".osim",), "body_model"),
    (VIDEO_SUFFIXES, "video"),
    ((".zip",), "keypoints"),
)
"""What a file is by the end of its name; the first that fits."""
OUR_FOLDER = "gonio"
"""Where results go by default: tables and videos of its own that must not come back as recordings."""


def find_capture_files(folder: Path) -> list[CaptureFile]:
    """List the recordings in a folder and its subfolders, by their suffixes; also a body model and its marker set.

    A subfolder with OpenPose's files of a camera, or a ZIP archive of them, is that camera's keypoints: as Pose2Sim has them.
    What an earlier analysis wrote there is none: a folder ``gonio``, or one with a ``report.json``.

    Raises:
        InputError: ``folder-missing``, or ``folder-empty`` if it holds neither videos nor keypoints.
    """
    if not folder.is_dir():
        raise InputError(
            f"{folder} is no folder.",
            hint="Give the folder that holds the videos and the calibration.",
            code="folder-missing",
        )
    paths = [path for path in sorted(folder.rglob("*")) if not _is_ours(path, folder)]
    found = [
        CaptureFile(path=path, name=path.name, role=role)
        for path in paths
        if path.is_file() and (role := _role_of(path.name.lower())) is not None
    ]
    for path in (p for p in paths if p.is_dir() and holds_poses(p)):
        found.append(CaptureFile(path=path, name=path.name, role="keypoints"))
    if not any(file.role in ("video", "keypoints") for file in found):
        raise InputError(
            f"{folder} holds no videos and no keypoints.",
            hint=f"Videos end in {', '.join(sorted(VIDEO_SUFFIXES))}; the calibration in {', '.join(CALIBRATION_SUFFIXES)}.",
            code="folder-empty",
        )
    return found


def _is_ours(path: Path, folder: Path) -> bool:
    above = path.relative_to(folder).parents
    return any(
        place.name == OUR_FOLDER or (place.name and (folder / place / "report.json").is_file()) for place in above
    )


def _role_of(name: str) -> TrialRole | None:
    return next((role for endings, role in ENDINGS if name.endswith(endings)), None)
