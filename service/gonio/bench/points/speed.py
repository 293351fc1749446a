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
    Spent,
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


def measure_ratios(bench: Bench, build_dir: Path) -> None:
    """Time both sides in turn on one walk of 3 s, OpenPose's 25 keypoints and four cameras: ratios of medians over pairs.

    ``triangulation_ratio``: Pose2Sim's own calls of its triangulation, without its files, over ours with covariance, on one
    thread. ``triangulation_step_ratio``: its step as users run it. ``chain_ratio``: its triangulation, filtering and
    kinematics over ours from keypoints to files, the body fitted to the pixels; ``chain_points_ratio`` with inverse
    kinematics of the points, which is what Pose2Sim does. Ratios are of the processor's seconds, which a busy machine
    hardly changes; the same of the clock's is ``…_wall`` and has no bound.

    Raises:
        ResourceError: the recording is not there, or Pose2Sim or aniposelib can't be run.
    """
    rivals, folder = open_rivals(build_dir), build_dir / "bench" / "speed"
    rig, points = read_balancing()
    frames, names = points.uv_px.shape[1], points.keypoint_names
    trial = write_trial(folder / "trial.npz", rig, points)
    ours: dict[str, list[Spent]] = {}
    theirs: dict[str, list[Spent]] = {}
    for _ in range(PAIRS):
        spent = run_pose2sim(rivals, trial, folder / "pose2sim", names, STEPS).spent
        chain = np.sum([spent[step] for step in ("triangulation", "filtering", "kinematics")], axis=0)
        for name, value in (*spent.items(), ("chain", (float(chain[0]), float(chain[1])))):
            theirs.setdefault(name, []).append(value)
        theirs.setdefault("aniposelib", []).append(run_aniposelib(rivals, trial, folder / "aniposelib.npz", names)[1])
        for name, work in (
            ("triangulation", _triangulation(rig, points, undistorts=False)),
            ("triangulation_step", _triangulation(rig, points, undistorts=True)),
            ("chain", lambda: _run_chain(rig, points, folder, pixels=True)),
            ("chain_points", lambda: _run_chain(rig, points, folder, pixels=False)),
        ):
            ours.setdefault(name, []).append(_best(work))
    their_s, our_s = ({name: np.median(spent, axis=0) for name, spent in side.items()} for side in (theirs, ours))
    for metric, their_name, our_name, worst in (
        ("triangulation_ratio_pose2sim", "bare_triangulation", "triangulation", 100.0),
        ("triangulation_step_ratio_pose2sim", "triangulation", "triangulation_step", None),
        ("triangulation_ratio_aniposelib", "aniposelib", "triangulation", None),
        ("chain_ratio_pose2sim", "chain", "chain", None),
        ("chain_points_ratio_pose2sim", "chain", "chain_points", 50.0),
    ):
        wall, cpu = their_s[their_name] / our_s[our_name]
        bench.add(metric, float(cpu), "1", at_least=worst)
        bench.add(f"{metric}_wall", float(wall), "1")
    for name, (wall_s, cpu_s) in our_s.items():
        bench.add(f"fps_{name}", frames / float(wall_s), "1/s")
        bench.add(f"cpu_ms_a_frame_{name}", 1e3 * float(cpu_s) / frames, "ms")
    bench.add("fps_chain_pose2sim", frames / float(their_s["chain"][0]), "1/s")
    bench.add("cpu_ms_a_frame_chain_pose2sim", 1e3 * float(their_s["chain"][1]) / frames, "ms")


def measure_growth(bench: Bench) -> None:
    """Measure time and memory of long trials, each in a process of its own: up to angles of points, and of pixels."""
    for kind in ("", "pixels_"):
        grown: list[tuple[float, float]] = []
        for frames in LONG:
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
            bench.add(f"{kind}cpu_ms_a_frame_{frames}", 1e3 * cpu_s / frames, "ms")
            bench.add(f"{kind}peak_rss_mb_{frames}", peak_mb, "MB")
        if len(grown) == len(LONG):
            # Linear, but for arrays that no longer fit the processor's caches: a frame of a trial a hundred times as long costs
            # at most half more.
            bench.add(f"{kind}cost_growth", grown[-1][0] / grown[0][0], "1", at_most=1.5)
            per_frame_kb = 1e3 * (grown[-1][1] - grown[0][1]) / (LONG[-1] - LONG[0])
            bench.add(f"{kind}memory_kb_a_frame", per_frame_kb, "kB")


def tell_growth(frames: int, with_pixels: bool) -> None:
    """Go the way of so many frames; write seconds, the processor's seconds (both without compiling) and peak memory, MB."""
    with tempfile.TemporaryDirectory() as folder:
        _run_chain(*_repeat_walk(60), Path(folder), pixels=with_pixels)
        rig, points = _repeat_walk(frames)
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        _run_chain(rig, points, Path(folder), pixels=with_pixels)
        seconds, cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    sys.stdout.write(f"{seconds} {cpu_s} {_peak_mb():.1f}")


def _peak_mb() -> float:
    """Give this process's own peak memory: what ``getrusage`` says begins with that of the process that started it."""
    status = Path("/proc/self/status")
    if status.is_file():
        peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(peak.split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # macOS: bytes


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


def _best(work: Callable[[], object], rounds: int = 5) -> Spent:
    """Give the shortest times of a few runs, the clock's and the processor's; the first of all compiles."""
    wall_s, cpu_s = [], []
    for _ in range(rounds):
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        work()
        wall_s.append(time.perf_counter() - start_s)
        cpu_s.append(time.process_time() - start_cpu_s)
    return min(wall_s), min(cpu_s)
