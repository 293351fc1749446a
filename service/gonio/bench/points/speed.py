"""How fast everything after the keypoints is, against Pose2Sim on the same trial, and how it grows with the trial's length."""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gonio.bench import Bench
from gonio.bench.points.chain import choose, find_motion, find_points
from gonio.bench.points.rivals import (
    CARD,
    MIN_CONFIDENCE,
    open_rivals,
    run_aniposelib,
    run_pose2sim,
    write_trial,
)
from gonio.bench.realism import read_balancing
from gonio.errors import GonioError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.triangulation.points import triangulate
from gonio.kernel.virtual_lab import PRESETS, film, make_rig, walk
from gonio.pipeline.params import Parameters
from gonio.pipeline.report import write_opensim_files
from gonio.records import ImagePoints, Rig
from gonio.resources import models_dir

PAIRS = 3
STEPS = ("triangulation", "filtering", "markerAugmentation", "kinematics")
RATE_HZ = 60.0
LONG = (1_000, 10_000, 100_000)
LONG_PIXELS = (1_000, 10_000)
"""The fit to the pixels of 100,000 frames takes a quarter of an hour and 10 GB: what two lengths show is enough."""


def measure_ratios(bench: Bench, build_dir: Path) -> None:
    """Time both sides in turn on one walk of 3 s, OpenPose's 25 keypoints and four cameras: ratios of medians over pairs.

    ``triangulation_ratio``: Pose2Sim's own calls of its triangulation, without its files, over ours with covariance, on one
    thread. ``triangulation_step_ratio``: its step as users run it. ``chain_ratio``: its triangulation, filtering and
    kinematics over ours from keypoints to files, the body fitted to the pixels; ``chain_points_ratio`` with inverse
    kinematics of the points, which is what Pose2Sim does.

    Raises:
        ResourceError: the recording is not there, or Pose2Sim or aniposelib can't be run.
    """
    rivals, folder = open_rivals(build_dir), build_dir / "bench" / "speed"
    rig, points = read_balancing()
    frames, names = points.uv_px.shape[1], points.keypoint_names
    trial = write_trial(folder / "trial.npz", rig, points)
    ours: dict[str, list[float]] = {}
    theirs: dict[str, list[float]] = {}
    for _ in range(PAIRS):
        seconds = run_pose2sim(rivals, trial, folder / "pose2sim", names, STEPS).seconds
        chain_s = seconds["triangulation"] + seconds["filtering"] + seconds["kinematics"]
        for name, value in (*seconds.items(), ("chain", chain_s)):
            theirs.setdefault(name, []).append(value)
        theirs.setdefault("aniposelib", []).append(run_aniposelib(rivals, trial, folder / "aniposelib.npz", names)[1])
        for name, work in (
            ("triangulation", _triangulation(rig, points, undistorts=False)),
            ("triangulation_step", _triangulation(rig, points, undistorts=True)),
            ("chain", lambda: _run_chain(rig, points, folder, pixels=True)),
            ("chain_points", lambda: _run_chain(rig, points, folder, pixels=False)),
        ):
            ours.setdefault(name, []).append(_best_s(work))
    typical = {name: float(np.median(values)) for name, values in theirs.items()}
    for metric, their_s, our_name, worst in (
        ("triangulation_ratio_pose2sim", typical["bare_triangulation"], "triangulation", 100.0),
        ("triangulation_step_ratio_pose2sim", typical["triangulation"], "triangulation_step", None),
        ("triangulation_ratio_aniposelib", typical["aniposelib"], "triangulation", None),
        ("chain_ratio_pose2sim", typical["chain"], "chain", None),
        ("chain_points_ratio_pose2sim", typical["chain"], "chain_points", 50.0),
    ):
        bench.add(metric, their_s / float(np.median(ours[our_name])), "1", at_least=worst)
    for name, values in ours.items():
        bench.add(f"fps_{name}", frames / float(np.median(values)), "1/s")
    bench.add("fps_chain_pose2sim", frames / typical["chain"], "1/s")


def measure_growth(bench: Bench) -> None:
    """Measure time and memory of long trials, each in a process of its own: up to angles of points, and of pixels."""
    for kind, lengths in (("", LONG), ("pixels_", LONG_PIXELS)):
        grown: list[tuple[float, float]] = []
        for frames in lengths:
            code = "import sys; from gonio.bench.points.speed import tell_growth as f; f(int(sys.argv[1]), bool(sys.argv[2]))"
            done = subprocess.run(  # noqa: S603 - our own code
                [sys.executable, "-c", code, str(frames), kind], capture_output=True, text=True, check=False
            )
            if done.returncode:
                bench.leave_out(f"{kind}fps_{frames}", GonioError(done.stderr[-300:], hint="Run it alone to see more."))
                break
            seconds, cpu_s, peak_mb = map(float, done.stdout.split()[-3:])
            grown.append((cpu_s / frames, peak_mb))
            bench.add(f"{kind}fps_{frames}", frames / seconds, "1/s")
            bench.add(f"{kind}peak_rss_mb_{frames}", peak_mb, "MB")
        if len(grown) == len(lengths):
            # Linear: a frame of the longest trial costs no more of the processor than one of the shortest, and a quarter.
            bench.add(f"{kind}cost_growth", grown[-1][0] / grown[0][0], "1", at_most=1.25)
            per_frame_kb = 1e3 * (grown[-1][1] - grown[0][1]) / (lengths[-1] - lengths[0])
            bench.add(f"{kind}memory_kb_a_frame", per_frame_kb, "kB")


def tell_growth(frames: int, with_pixels: bool) -> None:
    """Go the way of so many frames; write seconds, the processor's seconds (both without compiling) and peak memory, MB."""
    with tempfile.TemporaryDirectory() as folder:
        _run_chain(*_repeat_walk(60), Path(folder), pixels=with_pixels)
        rig, points = _repeat_walk(frames)
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        _run_chain(rig, points, Path(folder), pixels=with_pixels)
        seconds, cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes here
    sys.stdout.write(f"{seconds} {cpu_s} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6:.1f}")


def _repeat_walk(frames: int) -> tuple[Rig, ImagePoints]:
    """Film a walk of three seconds, and go to and fro in time for as long as it takes: nothing jumps."""
    walker = walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.2)
    trial = film(walker, make_rig(), read_markerset(CARD), effects=PRESETS["occluded"], rate_hz=RATE_HZ, duration_s=3.0)
    there = trial.points.uv_px.shape[1]
    turn = np.arange(frames) % (2 * there - 2)
    order = np.where(turn < there, turn, 2 * there - 2 - turn)
    points = replace(trial.points, uv_px=trial.points.uv_px[:, order], confidence=trial.points.confidence[:, order])
    return trial.rig, points


def _triangulation(rig: Rig, points: ImagePoints, *, undistorts: bool) -> Callable[[], object]:
    """Give the work of triangulating what Pose2Sim triangulates: it leaves eyes and ears out."""
    cameras = len(rig.cameras)
    kept = [not name.endswith(("eye", "ear")) for name in points.keypoint_names]
    uv_px = points.uv_px[:, :, kept]
    confidence = np.where(points.confidence >= MIN_CONFIDENCE, points.confidence, 0.0)[:, :, kept].reshape(cameras, -1)
    straight_px = undistort_rig(rig, uv_px)

    def work() -> object:
        seen_px = undistort_rig(rig, uv_px) if undistorts else straight_px
        return triangulate(projection_matrices(rig), focal_lengths_px(rig), seen_px.reshape(cameras, -1, 2), confidence)

    return work


def _run_chain(rig: Rig, points: ImagePoints, folder: Path, *, pixels: bool) -> None:
    """Go from keypoints to files: points, the scaled body, its motion, TRC, MOT and the model."""
    chosen: Parameters = choose(min_confidence=MIN_CONFIDENCE, pixels=pixels, refine_cameras=False)
    found = find_points(points, rig, chosen.reconstruction)
    body, motion = find_motion(points, found, chosen)
    write_opensim_files(found.smooth, motion, body.file, folder)


def _best_s(work: Callable[[], object], rounds: int = 5) -> float:
    """Give the shortest time of a few runs; the first of all compiles."""
    times: list[float] = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)
