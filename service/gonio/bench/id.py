"""Inverse dynamics: agreement with OpenSim 4.6 on its own example, speed against it, and whether error bars hold.

Recording: OpenSim's Gait2354 example, where it lies in ``../shared/data``; the error bars are checked on the built-in body.
"""

import json
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gonio.bench import Bench
from gonio.bench.ik import EXAMPLE, PAIRS
from gonio.bench.peers import peer_python, run_in_peer
from gonio.errors import GonioError, ResourceError
from gonio.formats.mot import read_mot
from gonio.formats.osim import read_osim
from gonio.formats.osim_setup import read_dynamics_setup
from gonio.kernel.dynamics.opensim import differentiate
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.dynamics.uncertainty import propagate
from gonio.pipeline.opensim_dynamics import read_wrenches, run_dynamics
from gonio.pipeline.opensim_tools import run_kinematics
from gonio.records import BodyModel
from gonio.resources import models_dir

SETUP = "subject01_Setup_InverseDynamics.xml"


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("id")
    try:
        _compare_with_opensim(bench, build_dir)
    except GonioError as error:
        bench.leave_out("max_diff_nm_*, *_ratio_opensim*", error)
    _cover(bench)
    return bench.to_json()


def _compare_with_opensim(bench: Bench, build_dir: Path) -> None:
    if not EXAMPLE.is_dir():
        raise ResourceError(
            "OpenSim's Gait2354 example is not there.", hint=f"Put it into {EXAMPLE}.", code="bench-data-missing"
        )
    python = peer_python(build_dir, "opensim", "opensim==4.6")
    setup = _example(build_dir, "id_example")
    theirs = (build_dir / "bench" / "id_opensim").resolve()
    theirs.mkdir(parents=True, exist_ok=True)
    run_in_peer(python, "opensim_id", setup, theirs)
    result = run_dynamics(setup)[2]
    ours = read_mot(result.files[0])
    # Baselines: 5e-9 Nm against 4.6; the shipped file was written by an older version, from which 4.6 is 6.7e-5 Nm off.
    bench.add("max_diff_nm_same_input", _largest_difference(ours, theirs / "inverse_dynamics.sto"), "Nm", at_most=1e-3)
    reference = EXAMPLE / "OutputReference" / "inverse_dynamics.sto"
    bench.add("max_diff_nm_reference", _largest_difference(ours, reference), "Nm", at_most=1e-3)
    _race(bench, python, _whole_trial(build_dir), theirs)


def _race(bench: Bench, python: Path, setup: Path, theirs: Path) -> None:
    """Run both sides in turn on the whole trial: our solver against their tool's frames a second and their bare solver."""
    _, motion, _ = run_dynamics(setup)
    model = read_osim(setup.parent / "subject01_simbody.osim")
    loads_file = read_dynamics_setup(setup).loads_file
    assert loads_file is not None  # the example's setup names one
    wrenches = read_wrenches(loads_file, model, motion)
    # Over and over up to a recording of minutes: what it costs a frame, not what it costs to begin.
    rounds = 20_000 // len(motion.times_s)
    long = [np.tile(part, (rounds, 1)) for part in (motion.q, motion.velocity, motion.acceleration)]
    pushed = tuple(
        Wrench(body=w.body, force_n=np.tile(w.force_n, (rounds, 1)), moment_nm=np.tile(w.moment_nm, (rounds, 1)))
        for w in wrenches
    )
    solver, bare, tool = [], [], []
    for _ in range(PAIRS):
        run_in_peer(python, "opensim_id", setup, theirs)
        times = json.loads((theirs / "times.json").read_text())
        own_fps = len(long[0]) / _best_s(lambda: solve_dynamics(model, long[0], long[1], long[2], pushed))
        solver.append(own_fps / (times["rows"] / times["tool_s"]))
        bare.append(own_fps / (times["calls"] / times["solver_s"]))
        tool.append(times["tool_s"] / _best_s(lambda: run_dynamics(setup)))
    bench.add("solver_ratio_opensim", float(np.median(solver)), "1")
    bench.add("solver_ratio_opensim_bare", float(np.median(bare)), "1")
    bench.add("tool_ratio_opensim", float(np.median(tool)), "1")


def _whole_trial(build_dir: Path) -> Path:
    """Give a setup for all 2.5 s of the example, with the motion that gonio finds for them."""
    folder = _example(build_dir, "id_whole").parent
    setup = folder / "subject01_Setup_IK.xml"
    setup.write_text(re.sub(r"<time_range>[^<]*<", "<time_range>0 2.5<", setup.read_text()))
    motion = run_kinematics(setup)[1].files[0]
    if motion.resolve() != folder / "subject01_walk1_ik.mot":
        shutil.copy(motion, folder / "subject01_walk1_ik.mot")
    dynamics = folder / SETUP
    dynamics.write_text(re.sub(r"<time_range>[^<]*<", "<time_range>0 2.5<", dynamics.read_text()))
    return dynamics


def _example(build_dir: Path, name: str) -> Path:
    """Copy the example; the reference's own model and motion are its input."""
    folder = (build_dir / "bench" / name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for path in (p for p in EXAMPLE.iterdir() if p.is_file()):
        shutil.copy(path, folder)
    for file in ("subject01_simbody.osim", "subject01_walk1_ik.mot"):
        shutil.copy(EXAMPLE / "OutputReference" / file, folder)
    setup = folder / SETUP
    text = re.sub(r"<output_gen_force_file>[^<]*<", "<output_gen_force_file>ours.sto<", setup.read_text())
    setup.write_text(text)
    return setup


def _largest_difference(ours: Any, theirs: Path) -> float:  # noqa: ANN401 - a table
    """Give the largest difference of any generalized force at any time that both have."""
    other = read_mot(theirs)
    rows = [int(np.argmin(np.abs(other.times_s - t))) for t in ours.times_s]
    same = np.abs(other.times_s[rows] - ours.times_s) < 1e-5
    return max(float(np.abs(ours.of(name) - other.of(name)[rows])[same].max()) for name in ours.labels)


def _best_s(work: Callable[[], object], rounds: int = 5) -> float:
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def _cover(bench: Bench) -> None:
    """Draw errors of 2° and 5 mm that last 0.1 s, and count how often the 95 % bands hold the truth."""
    rate_hz, frames, draws = 60.0, 200, 100
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    rng, times_s = np.random.default_rng(1), np.arange(frames) / rate_hz
    truth_q = _walk(model, times_s)
    sd = np.where(model.coordinates.rotational, np.deg2rad(2.0), 0.005)
    smooth = differentiate(times_s, truth_q, 6.0)
    state = smooth.q, smooth.velocity, smooth.acceleration
    truth = solve_dynamics(model, *state).forces
    covariance = np.tile(np.diag(sd**2), (frames, 1, 1))
    bars = propagate(model, state, covariance, rate_hz=rate_hz, cutoff_hz=6.0, correlation_s=0.1)
    decay = np.exp(-1 / rate_hz / 0.1)
    inner, joints = (
        slice(30, -30),
        [i for i, name in enumerate(model.coordinates.names) if name[:4] in {"hip_", "knee", "ankl"}],
    )
    angles, torques = [], []
    for _ in range(draws):
        white = rng.normal(size=(frames + 60, len(sd))) * np.sqrt(1 - decay**2)
        error = np.zeros_like(white)
        for frame in range(1, len(white)):
            error[frame] = decay * error[frame - 1] + white[frame]
        drawn = differentiate(times_s, truth_q + error[60:] * sd, 6.0)
        forces = solve_dynamics(model, drawn.q, drawn.velocity, drawn.acceleration).forces
        angles.append(np.abs(drawn.q - smooth.q)[inner][:, joints] < 1.96 * bars.q[inner][:, joints])
        torques.append(np.abs(forces - truth)[inner][:, joints] < 1.96 * bars.forces[inner][:, joints])
    bench.add("coverage95_angle_pct", 100 * float(np.mean(angles)), "%", at_least=93.0, at_most=97.0)
    bench.add("coverage95_torque_pct", 100 * float(np.mean(torques)), "%", at_least=93.0, at_most=97.0)


def _walk(model: BodyModel, times_s: np.ndarray) -> np.ndarray:
    q = np.tile(model.coordinates.default, (len(times_s), 1))
    for side, phase in (("r", 0.0), ("l", np.pi)):
        for name, mean, swing in (("hip_flexion", 0.2, 0.4), ("knee_angle", 0.5, 0.4), ("ankle_angle", 0.0, 0.2)):
            q[:, model.coordinates.index(f"{name}_{side}")] = mean + swing * np.cos(2 * np.pi * times_s + phase)
    return q
