"""Do 95 % bands hold the truth in 95 % of the cases? Angles and torques, behind filter, derivatives and mechanics."""

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.dynamics.opensim import differentiate
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.kernel.dynamics.uncertainty import propagate
from gonio.records import BodyModel
from gonio.resources import models_dir

RATE_HZ, FRAMES, DRAWS, CUTOFF_HZ = 60.0, 150, 60, 6.0
TIMES_S = np.arange(FRAMES) / RATE_HZ
WATCHED = ("hip_flexion_r", "knee_angle_r", "ankle_angle_r", "knee_angle_l")


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


@pytest.mark.parametrize("correlation_s", [0.0, 0.1])
def test_the_bands_hold_the_truth_in_95_percent(correlation_s: float) -> None:
    model = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    rng = np.random.default_rng(5)
    truth_q, count = walk(model), len(model.coordinates.names)
    # A covariance with everything in it: 2° and 5 mm, some coordinates correlated with their neighbours.
    sd = np.where(model.coordinates.rotational, np.deg2rad(2.0), 0.005)
    root = np.diag(sd) @ (np.eye(count) + 0.4 * np.eye(count, k=1))
    covariance = root @ root.T
    smooth_truth = differentiate(TIMES_S, truth_q, CUTOFF_HZ)
    truth = solve_dynamics(model, smooth_truth.q, smooth_truth.velocity, smooth_truth.acceleration)
    columns = [model.coordinates.index(name) for name in WATCHED]
    inner = slice(30, -30)
    angle_hits, torque_hits = [], []
    bars = propagate(
        model,
        (smooth_truth.q, smooth_truth.velocity, smooth_truth.acceleration),
        np.tile(covariance, (len(smooth_truth.q), 1, 1)),
        rate_hz=RATE_HZ,
        cutoff_hz=CUTOFF_HZ,
        correlation_s=correlation_s,
    )
    decay = np.exp(-1 / RATE_HZ / correlation_s) if correlation_s else 0.0
    for _ in range(DRAWS):
        white = rng.normal(size=(FRAMES + 60, count))
        error = np.empty_like(white)
        error[0] = white[0]
        for frame in range(1, len(white)):
            error[frame] = decay * error[frame - 1] + np.sqrt(1 - decay**2) * white[frame]
        smooth = differentiate(TIMES_S, truth_q + error[60:] @ root.T, CUTOFF_HZ)
        found = solve_dynamics(model, smooth.q, smooth.velocity, smooth.acceleration)
        angle_hits.append((np.abs(smooth.q - smooth_truth.q) < 1.96 * bars.q)[inner][:, columns])
        torque_hits.append((np.abs(found.forces - truth.forces) < 1.96 * bars.forces)[inner][:, columns])
    # 60 draws × some 15 independent moments × 4 coordinates: the share of hits scatters by 0.36 %.
    assert 0.93 < np.mean(angle_hits) < 0.97
    assert 0.93 < np.mean(torque_hits) < 0.97
