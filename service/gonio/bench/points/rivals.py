"""One trial's keypoints for gonio and for its rivals, Pose2Sim and aniposelib: the same numbers for all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.bench.peers import peer_python, run_in_peer
from gonio.formats.openpose import BODY_25B, gonio_names
from gonio.records import ImagePoints, Rig
from gonio.resources import models_dir

CARD = models_dir() / "markersets" / "body25b.toml"
MIN_CONFIDENCE = 0.3
"""Of OpenPose's keypoints: Pose2Sim's default, and what gonio's rivals are given too."""


Spent = tuple[float, float]
"""Seconds: the clock's, and the processor's."""


@dataclass(frozen=True)
class Rivals:
    """Where the rivals run."""

    pose2sim: Path
    aniposelib: Path


@dataclass(frozen=True)
class Pose2SimPoints:
    """Pose2Sim's points (frame, keypoint, 3), raw and filtered, NaN for keypoints that it leaves out; what each step took."""

    raw: Float[np.ndarray, "frame keypoint 3"]
    filtered: Float[np.ndarray, "frame keypoint 3"]
    spent: dict[str, Spent]


def open_rivals(build_dir: Path) -> Rivals:
    """Make the rivals' environments.

    Raises:
        ResourceError: one can't be made.
    """
    return Rivals(
        pose2sim=peer_python(build_dir, "pose2sim", "pose2sim==0.10.49"),
        aniposelib=peer_python(build_dir, "aniposelib", "aniposelib==0.8.0"),
    )


def write_trial(path: Path, rig: Rig, points: ImagePoints) -> Path:
    """Write keypoints (those of BODY_25B) and calibration for the scripts that run the rivals."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = [points.keypoint_names.index(name) for name in gonio_names(BODY_25B)]
    np.savez(
        path,
        keypoint_names=BODY_25B,
        uv_px=points.uv_px[:, :, order],
        confidence=points.confidence[:, :, order],
        rate_hz=points.timebase.rate_hz,
        size_px=[camera.image_size_px for camera in rig.cameras],
        intrinsic_px=[camera.intrinsic_px for camera in rig.cameras],
        distortion=[camera.distortion for camera in rig.cameras],
        T_cam_lab=[np.linalg.inv(camera.T_lab_cam) for camera in rig.cameras],
    )
    return path


def run_pose2sim(
    rivals: Rivals,
    trial: Path,
    folder: Path,
    names: Sequence[str],
    steps: Sequence[str] = ("triangulation", "filtering"),
) -> Pose2SimPoints:
    """Let Pose2Sim do its steps on a trial that :func:`write_trial` wrote; points in the order of our ``names``."""
    folder = folder.resolve()
    run_in_peer(rivals.pose2sim, "pose2sim_points", trial.resolve(), folder, *steps)
    found, theirs = np.load(folder / "points.npz"), {}
    frames = len(found["raw"])
    for kind in ("raw", "filtered"):
        theirs[kind] = np.full((frames, len(names), 3), np.nan)
        if kind in found:  # its filter loses the last frame
            for column, name in enumerate(gonio_names([str(name) for name in found[f"{kind}_names"]])):
                if name in names:
                    theirs[kind][: len(found[kind]), names.index(name)] = found[kind][:, column]
    spent = {name: (wall_s, cpu_s) for name, (wall_s, cpu_s) in json.loads((folder / "times.json").read_text()).items()}
    return Pose2SimPoints(raw=theirs["raw"], filtered=theirs["filtered"], spent=spent)


def run_aniposelib(
    rivals: Rivals, trial: Path, out: Path, names: Sequence[str]
) -> tuple[Float[np.ndarray, "frame keypoint 3"], Spent]:
    """Let aniposelib optimise a trial's points, in the order of our ``names``; also give what that took."""
    run_in_peer(rivals.aniposelib, "aniposelib_points", trial.resolve(), out.resolve(), str(MIN_CONFIDENCE))
    found = np.load(out)
    order = [gonio_names(BODY_25B).index(name) for name in names]
    return found["xyz"][:, order], (float(found["seconds"][0]), float(found["seconds"][1]))
