"""Do the files of a report open in OpenSim unchanged, with the same numbers? A walk goes out and comes back."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gonio.bench import Bench
from gonio.bench.peers import peer_python, run_in_peer
from gonio.errors import GonioError
from gonio.kernel.body.forward import marker_positions
from gonio.pipeline.body import scale_to_subject
from gonio.pipeline.motion import BodyMotion, solve_points
from gonio.pipeline.params import Subject
from gonio.pipeline.report import write_opensim_files
from gonio.records import MEASURED, LabPoints, Motion, Timebase
from gonio.vision.model_cards import load_card

FRAMES, RATE_HZ = 120, 60.0


def run(build_dir: Path) -> dict[str, Any]:
    """Write a report's files of a made-up walk, let OpenSim 4.6 read them, and compare."""
    bench = Bench("files")
    try:
        python = peer_python(build_dir, "opensim", "opensim==4.6")
        with TemporaryDirectory() as folder:
            _measure(bench, python, Path(folder))
    except GonioError as error:
        bench.leave_out("all", error)
    return bench.to_json()


def _measure(bench: Bench, python: Path, folder: Path) -> None:
    points = _walk()
    body = scale_to_subject(points, Subject(mass_kg=72.6, sex="male")).value
    motion = solve_points(body, points)
    found = BodyMotion(motion=motion, model=body.model, two_step=motion, fit=None, distrusted="")
    trc, mot, osim = write_opensim_files(points, found, body.file, folder)
    run_in_peer(python, "opensim_files", trc, mot, osim, folder / "read.npz")
    read = np.load(folder / "read.npz")
    _compare(bench, points, motion, read)
    bench.add("model_mass_difference_kg", abs(float(read["mass_kg"]) - body.model.mass_kg), "kg", at_most=1e-6)
    own = marker_positions(body.model, motion.values)[read["frames"]]
    order = [list(body.model.markers.names).index(name) for name in read["marker_names"]]
    bench.add("model_markers_max_mm", 1e3 * float(np.abs(read["markers_m"] - own[:, order]).max()), "mm", at_most=1e-3)


def _compare(bench: Bench, points: LabPoints, motion: Motion, read: Any) -> None:  # noqa: ANN401 - an npz file
    trc_mm = np.abs(read["trc_mm"] - 1e3 * points.xyz_lab_m)
    missing = np.isnan(points.xyz_lab_m)
    bench.add("trc_max_mm", float(trc_mm[~missing].max()), "mm", at_most=0.01)
    bench.add("trc_gaps_kept", float(np.isnan(read["trc_mm"])[missing].mean()), "1", at_least=1.0)
    degrees = np.where(motion.rotational, np.degrees(motion.values), motion.values)
    bench.add("mot_max_deg", float(np.nanmax(np.abs(read["mot"] - degrees))), "°", at_most=1e-6)


def _walk() -> LabPoints:
    """Make keypoints of a standing body that sways, with gaps: what they do doesn't matter, only that it returns."""
    card = load_card("blazepose_heavy").keypoints
    assert card is not None  # a landmark card has them
    names = card.names
    height_m = {"nose": 1.6, "ear": 1.6, "eye": 1.65, "mouth": 1.55, "shoulder": 1.4, "elbow": 1.1, "wrist": 0.85}
    height_m |= {"pinky": 0.78, "index": 0.78, "thumb": 0.8, "hip": 0.9, "knee": 0.48, "ankle": 0.08, "heel": 0.03}
    time_s = np.arange(FRAMES) / RATE_HZ
    xyz = np.zeros((FRAMES, len(names), 3))
    for i, name in enumerate(names):
        side = -1.0 if "left" in name else 1.0 if "right" in name else 0.0
        part = next((p for p in height_m if p in name.replace("foot_index", "foot")), "")
        wide = 0.18 if part in {"shoulder", "elbow", "wrist", "pinky", "index", "thumb"} else 0.09
        xyz[:, i] = [
            0.14 if "foot_index" in name else -0.05 if part == "heel" else 0.0,
            height_m.get(part, 0.02),
            side * wide,
        ]
        xyz[:, i, 0] += 0.2 * xyz[:, i, 1] * np.sin(2 * np.pi * time_s)
    gaps = np.random.default_rng(1).random(xyz.shape[:2]) < 0.03
    xyz[gaps] = np.nan
    return LabPoints(
        camera_names=(),
        keypoint_names=names,
        timebase=Timebase(rate_hz=RATE_HZ),
        xyz_lab_m=xyz,
        origin=np.where(gaps, 0, MEASURED).astype(np.uint8),
        covariance_m2=np.full((*xyz.shape, 3), np.nan),
        residual_px=np.zeros((0, *xyz.shape[:2], 2)),
    )
