"""Inverse dynamics: agreement with OpenSim 4.6 on its own example, speed against it, and whether error bars hold.

Recording: OpenSim's Gait2354 example, where it lies in ``../shared/data``; the error bars are checked on the built-in body.
"""

import json
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.ik import PAIRS
from gonio.bench.peers import peer_python, run_in_peer
from gonio.bench.recordings import GAIT2354, need
from gonio.errors import GonioError
from gonio.formats.markerset import read_markerset
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.dynamics import zero_lag
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.dynamics.uncertainty import lasting, propagate
from gonio.kernel.kinematics.covariance import add_covariance
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.pipeline.opensim_dynamics import read_wrenches, run_dynamics
from gonio.pipeline.opensim_tools import run_kinematics
from gonio.records import BodyModel
from gonio.resources import models_dir

SETUP, MOTION, MODEL = "subject01_Setup_InverseDynamics.xml", "subject01_walk1_ik.mot", "subject01_simbody.osim"
LOADS = "subject01_walk1_grf.xml"
ROUNDS = 3  # as OpenSim's side has
COUPLER = """<ConstraintSet name="constraintset"><objects><CoordinateCouplerConstraint name="toes">
<coupled_coordinates_function><LinearFunction><coefficients>0.5 0.1</coefficients></LinearFunction>
</coupled_coordinates_function>
<independent_coordinate_names>ankle_angle_r</independent_coordinate_names>
<dependent_coordinate_name>mtp_angle_r</dependent_coordinate_name></CoordinateCouplerConstraint></objects></ConstraintSet>"""


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
    need(GAIT2354)
    python = peer_python(build_dir, "opensim", "opensim==4.6")
    worst_nm = 0.0
    for name, vary in VARIANTS.items():
        setup = _example(build_dir, f"id_{name}")
        vary(setup.parent)
        ours = run_dynamics(setup)[2].files[0]
        run_in_peer(python, "opensim_id", setup, setup.parent, ours)
        worst_nm = max(worst_nm, _largest_difference(read_mot(ours), setup.parent / "theirs.sto"))
        if name == "plain":
            reference = GAIT2354 / "OutputReference" / "inverse_dynamics.sto"
            difference_nm = _largest_difference(read_mot(ours), reference)
            opened = np.load(setup.parent / "read.npz")
            assert tuple(opened["labels"]) == read_mot(ours).labels
            file_nm = float(np.abs(opened["values"] - read_mot(ours).values).max())
            bench.add("sto_opened_by_opensim_max_diff_nm", file_nm, "Nm", at_most=1e-9)
            # Baselines: 5e-9 Nm against 4.6; the shipped file was written by an older version, which is 6.7e-5 Nm off 4.6.
            bench.add("max_diff_nm_reference", difference_nm, "Nm", at_most=1e-3)
    bench.add("max_diff_nm_same_input", worst_nm, "Nm", at_most=1e-3)
    _race(bench, python, _whole_trial(build_dir))


def _race(bench: Bench, python: Path, setup: Path) -> None:
    """Run both sides in turn on the whole trial: our solver against their tool's frames a second and their bare solver.

    Theirs runs on one core and ours on all; their bare solver has no external forces to deal with, ours two.
    """
    _, motion, _ = run_dynamics(setup)
    model = read_osim(setup.parent / MODEL)
    wrenches = read_wrenches(setup.parent / LOADS, model, motion)
    # Over and over up to a recording of minutes: what it costs a frame, not what it costs to begin.
    rounds = 20_000 // len(motion.times_s)
    long = [np.tile(part, (rounds, 1)) for part in (motion.q, motion.velocity, motion.acceleration)]
    pushed = tuple(
        Wrench(body=w.body, force_n=np.tile(w.force_n, (rounds, 1)), moment_nm=np.tile(w.moment_nm, (rounds, 1)))
        for w in wrenches
    )
    fps, ratios = [], []
    for _ in range(PAIRS):
        run_in_peer(python, "opensim_id", setup, setup.parent)
        times = json.loads((setup.parent / "times.json").read_text())
        own = len(long[0]) / _best_s(lambda: solve_dynamics(model, long[0], long[1], long[2], pushed))
        their_tool, their_solver = times["rows"] / times["tool_s"], times["calls"] / times["solver_s"]
        fps.append((own, their_tool, their_solver))
        ratios.append((own / their_tool, own / their_solver, times["tool_s"] / _best_s(lambda: run_dynamics(setup))))
    for name, value in zip(
        ("fps_solver", "fps_opensim_tool", "fps_opensim_solver"), np.median(fps, axis=0), strict=True
    ):
        bench.add(name, value, "1/s")
    solver, bare, tool = np.median(ratios, axis=0)
    # Measured on two cores that others used too: 535 to 559, 5 and 25. Their tool does the solver's work in 1/100 of its time.
    bench.add("solver_ratio_opensim", solver, "1", at_least=250.0)
    bench.add("solver_ratio_opensim_bare", bare, "1")
    bench.add("tool_ratio_opensim", tool, "1", at_least=12.0)


def _whole_trial(build_dir: Path) -> Path:
    """Give a setup for all 2.5 s of the example, with the motion that gonio finds for them."""
    folder = _example(build_dir, "id_whole").parent
    setup = folder / "subject01_Setup_IK.xml"
    setup.write_text(re.sub(r"<time_range>[^<]*<", "<time_range>0 2.5<", setup.read_text()))
    motion = run_kinematics(setup)[1].files[0]
    if motion.resolve() != folder / MOTION:
        shutil.copy(motion, folder / MOTION)
    dynamics = folder / SETUP
    dynamics.write_text(re.sub(r"<time_range>[^<]*<", "<time_range>0 2.5<", dynamics.read_text()))
    return dynamics


def _example(build_dir: Path, name: str) -> Path:
    """Copy the example; the reference's own model and motion are its input."""
    folder = (build_dir / "bench" / name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for path in (p for p in GAIT2354.iterdir() if p.is_file()):
        shutil.copy(path, folder)
    for file in (MODEL, MOTION):
        shutil.copy(GAIT2354 / "OutputReference" / file, folder)
    return folder / SETUP


def _round_times(folder: Path) -> None:
    """Round the motion's times to milliseconds, as .trc files have them: OpenSim then resamples."""
    table = read_mot(folder / MOTION)
    rounded = np.round(table.times_s, 3)
    write_mot(
        folder / MOTION,
        Table(name=table.name, labels=table.labels, times_s=rounded, values=table.values, in_degrees=True),
    )


def _couple(folder: Path) -> None:
    text = re.sub(r"<ConstraintSet.*?</ConstraintSet>", COUPLER, (folder / MODEL).read_text(), flags=re.DOTALL)
    (folder / MODEL).write_text(text)


def _in_body_frames(folder: Path) -> None:
    text = (folder / LOADS).read_text().replace("in_body> ground", "in_body> pelvis")
    (folder / LOADS).write_text(text)


def _unfiltered(folder: Path) -> None:
    text = re.sub(r"6\.00000000(?= </lowpass)", "-1", (folder / SETUP).read_text())
    (folder / SETUP).write_text(text)


VARIANTS: dict[str, Callable[[Path], None]] = {
    "plain": lambda _: None,
    "uneven": _round_times,
    "coupled": _couple,
    "body_frames": _in_body_frames,
    "unfiltered": _unfiltered,
}
"""Changes of the example, under which both sides must still agree."""


def _largest_difference(ours: Table, theirs: Path) -> float:
    """Give the largest difference of any generalized force; NaN if a time or a force has no match."""
    other = read_mot(theirs)
    if ours.times_s.shape != other.times_s.shape or np.abs(ours.times_s - other.times_s).max() > 1e-5:
        return float("nan")
    if set(ours.labels) != set(other.labels):
        return float("nan")
    return max(float(np.abs(ours.of(name) - other.of(name)).max()) for name in ours.labels)


def _best_s(work: Callable[[], object]) -> float:
    times: list[float] = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def _cover(bench: Bench) -> None:
    """Count how often 95 % bands hold the truth, from markers through inverse kinematics and the filter to torques.

    Markers have errors of 4 mm that last 0.1 s, threefold for those of the left leg during a quarter of a second.
    """
    rate_hz, frames, draws, sd_m = 60.0, 200, 100, 0.004
    markerset = read_markerset(models_dir() / "markersets" / "blazepose33.toml")
    model = attach(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), markerset)
    # The walk keeps the coordinates that are pulled to a target exactly there: their freedom is no error here.
    tasks = make_tasks(model, markerset)
    tasks = replace(tasks, target_sd=0 * tasks.target_sd)
    smoother, rng, times_s = (
        partial(zero_lag.differentiate, cutoff_hz=6.0),
        np.random.default_rng(1),
        np.arange(frames) / rate_hz,
    )
    truth_q = _walk(model, times_s)
    smooth = smoother(times_s, truth_q)
    truth = solve_dynamics(model, smooth.q, smooth.velocity, smooth.acceleration).forces
    seen = marker_positions(model, truth_q)
    on_left = np.array([name.startswith("left") for name in model.markers.names])
    lost = on_left & ((times_s > 1.5) & (times_s < 1.75))[:, None]
    sd = np.where(lost, 3 * sd_m, sd_m)[:, :, None]
    noise = sd[..., None] ** 2 * np.eye(3)
    joints = [i for i, name in enumerate(model.coordinates.names) if name[:4] in {"hip_", "knee", "ankl"}]
    angles, torques = [], []
    for _ in range(draws):
        observed = seen + sd * _lasting_errors(rng, seen.shape, np.exp(-1 / rate_hz / 0.1))
        motion = add_covariance(solve_motion(model, tasks, observed, times_s), model, tasks, observed, noise)
        assert motion.covariance is not None
        found = smoother(times_s, motion.values)
        bars = propagate(model, found, smoother, times_s, motion.covariance, correlation=lasting(0.1))
        forces = solve_dynamics(model, found.q, found.velocity, found.acceleration).forces
        angles.append((np.abs(found.q - smooth.q) < 1.96 * bars.q)[:, joints])
        torques.append((np.abs(forces - truth) < 1.96 * bars.forces)[:, joints])
    bench.add("coverage95_angle_pct", 100 * float(np.mean(angles)), "%", at_least=93.0, at_most=97.0)
    bench.add("coverage95_torque_pct", 100 * float(np.mean(torques)), "%", at_least=93.0, at_most=97.0)


def _lasting_errors(
    rng: np.random.Generator, shape: tuple[int, ...], decay: float
) -> Float[np.ndarray, "frame marker 3"]:
    """Draw errors of unit variance, each frame's correlated with the next one's by ``decay``."""
    error = rng.normal(size=shape)
    for frame in range(1, len(error)):
        error[frame] = decay * error[frame - 1] + np.sqrt(1 - decay**2) * error[frame]
    return error


def _walk(model: BodyModel, times_s: Float[np.ndarray, " frame"]) -> Float[np.ndarray, "frame coordinate"]:
    q = np.tile(model.coordinates.default, (len(times_s), 1))
    for side, phase in (("r", 0.0), ("l", np.pi)):
        for name, mean, swing in (("hip_flexion", 0.2, 0.4), ("knee_angle", 0.5, 0.4), ("ankle_angle", 0.0, 0.2)):
            q[:, model.coordinates.index(f"{name}_{side}")] = mean + swing * np.cos(2 * np.pi * times_s + phase)
    return q
