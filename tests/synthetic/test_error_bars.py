"""Do 95 % bands hold the truth in 95 % of the cases? Angles and torques, behind filter, derivatives and mechanics."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.dynamics import opensim, zero_lag
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.kernel.dynamics.uncertainty import Smoother, lasting, propagate, white
from gonio.kernel.kinematics.covariance import add_covariance
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import BodyModel
from gonio.resources import models_dir

RATE_HZ, FRAMES, DRAWS, CUTOFF_HZ = 60.0, 150, 60, 6.0
TIMES_S = np.arange(FRAMES) / RATE_HZ
WATCHED = ("hip_flexion_r", "knee_angle_r", "ankle_angle_r", "knee_angle_l")
SMOOTHERS: dict[str, Smoother] = {
    "opensim": partial(opensim.differentiate, cutoff_hz=CUTOFF_HZ),
    "zero_lag": partial(zero_lag.differentiate, cutoff_hz=CUTOFF_HZ),
}


def walk(model: BodyModel) -> np.ndarray:
    q = np.tile(model.coordinates.default, (FRAMES, 1))
    for side, phase in (("r", 0.0), ("l", np.pi)):
        wave = 2 * np.pi * TIMES_S + phase
        for name, mean, swing, lead in (
            ("hip_flexion", 0.2, 0.4, 0.0),
            ("knee_angle", 0.5, 0.4, 0.9),
            ("ankle_angle", 0, 0.2, 2),
        ):
            q[:, model.coordinates.index(f"{name}_{side}")] = mean + swing * np.cos(wave - lead)
    q[:, model.coordinates.index("pelvis_tx")] = 1.2 * TIMES_S
    return q


def drift(rng: np.random.Generator, shape: tuple[int, ...], correlation_s: float) -> np.ndarray:
    """Errors of unit variance, the first axis over time, that fall to 1/e in ``correlation_s``."""
    decay = np.exp(-1 / RATE_HZ / correlation_s) if correlation_s else 0.0
    error = rng.normal(size=shape)
    for frame in range(1, len(error)):
        error[frame] = decay * error[frame - 1] + np.sqrt(1 - decay**2) * error[frame]
    return error


@pytest.mark.parametrize("way", SMOOTHERS)
@pytest.mark.parametrize("correlation_s", [0.0, 0.1])
def test_the_bands_hold_the_truth_in_95_percent(correlation_s: float, way: str) -> None:
    """In the middle, near both ends, and where a camera is lost for a quarter of a second and the errors are threefold."""
    model, smoother = read_osim(models_dir() / "bodies" / "fullbody_male.osim"), SMOOTHERS[way]
    rng = np.random.default_rng(5)
    truth_q, count = walk(model), len(model.coordinates.names)
    # A covariance with everything in it: 1° and 3 mm, some coordinates correlated with their neighbours.
    sd = np.where(model.coordinates.rotational, np.deg2rad(1.0), 0.003)
    gain = np.where((TIMES_S > 1.0) & (TIMES_S < 1.25), 3.0, 1.0)
    root = gain[:, None, None] * (np.diag(sd) @ (np.eye(count) + 0.4 * np.eye(count, k=1)))
    smooth_truth = smoother(TIMES_S, truth_q)
    truth = solve_dynamics(model, smooth_truth.q, smooth_truth.velocity, smooth_truth.acceleration)
    correlation = lasting(correlation_s) if correlation_s else white
    bars = propagate(model, smooth_truth, smoother, TIMES_S, root @ root.swapaxes(1, 2), correlation=correlation)
    angle_hits, torque_hits = np.zeros((FRAMES, count)), np.zeros((FRAMES, count))
    for _ in range(DRAWS):
        smooth = smoother(TIMES_S, truth_q + np.einsum("fab,fb->fa", root, drift(rng, truth_q.shape, correlation_s)))
        found = solve_dynamics(model, smooth.q, smooth.velocity, smooth.acceleration)
        angle_hits += np.abs(smooth.q - smooth_truth.q) < 1.96 * bars.q
        torque_hits += np.abs(found.forces - truth.forces) < 1.96 * bars.forces
    columns = [model.coordinates.index(name) for name in WATCHED]
    # The first and the last frame are left out: OpenSim's reflection makes their accelerations 0 whatever the errors are.
    for part, allowed in ((slice(1, -1), 0.02), (np.r_[1:10, 140:149], 0.035), (slice(55, 80), 0.035)):
        # 60 draws × some 15 independent moments × 4 coordinates: the share of hits scatters by 0.36 %; near the ends, and
        # in the gap, 60 × 2 × 4 of them by 1.0 %.
        assert np.mean(angle_hits[part][:, columns]) / DRAWS == pytest.approx(0.95, abs=allowed)
        assert np.mean(torque_hits[part][:, columns]) / DRAWS == pytest.approx(0.95, abs=allowed)


def test_the_bands_hold_from_the_markers_to_the_torques() -> None:
    """Markers with errors that last, inverse kinematics with its own covariance, and the bars of that very trial."""
    markerset = read_markerset(models_dir() / "markersets" / "blazepose33.toml")
    model = attach(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), markerset)
    smoother, rng = SMOOTHERS["zero_lag"], np.random.default_rng(3)
    # The truth keeps the coordinates that are pulled to a target exactly there: a bar for their freedom would be too long.
    tasks = make_tasks(model, markerset)
    tasks = replace(tasks, target_sd=0 * tasks.target_sd)
    truth_q = walk(model)
    smooth_truth = smoother(TIMES_S, truth_q)
    truth = solve_dynamics(model, smooth_truth.q, smooth_truth.velocity, smooth_truth.acceleration)
    seen, sd_m = marker_positions(model, truth_q), 0.004
    noise = np.tile(sd_m**2 * np.eye(3), (*seen.shape[:2], 1, 1))
    columns, draws = [model.coordinates.index(name) for name in WATCHED], 16
    angle_hits, torque_hits = [], []
    for _ in range(draws):
        observed = seen + sd_m * drift(rng, seen.shape, 0.1)
        motion = add_covariance(solve_motion(model, tasks, observed, TIMES_S), model, tasks, observed, noise)
        smooth = smoother(TIMES_S, motion.values)
        assert motion.covariance is not None
        bars = propagate(model, smooth, smoother, TIMES_S, motion.covariance, correlation=lasting(0.1))
        found = solve_dynamics(model, smooth.q, smooth.velocity, smooth.acceleration)
        angle_hits.append((np.abs(smooth.q - smooth_truth.q) < 1.96 * bars.q)[:, columns])
        torque_hits.append((np.abs(found.forces - truth.forces) < 1.96 * bars.forces)[:, columns])
    # 16 draws × some 10 independent moments × 4 coordinates: 0.9 %.
    assert np.mean(angle_hits) == pytest.approx(0.95, abs=0.025)
    assert np.mean(torque_hits) == pytest.approx(0.95, abs=0.025)
