"""Knee torque from foot pressure: each way to the shear against full plates, and whether the error bands hold.

Recording: OpenSim's Gait2354 walk on an instrumented treadmill, its plates reduced to vertical force and centre of pressure at
20 Hz. **This person is one of the 14 that the template was made of**: the numbers show that the method is built as it was
published, not how it does on people it never saw (5.3 Nm in walking, 0.070 Nm/kg, with the person's laboratory held out).
``gait2354_knee_peak_nm`` is by how much the largest torque of a knee is missed, whatever its sign, mean of both.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.recordings import GAIT2354, need
from gonio.formats.force_coefficients import builtin_force_coefficients
from gonio.formats.mot import read_mot
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, marker_positions
from gonio.kernel.dynamics import opensim
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.forces.estimate import ForceChoice, estimate_forces
from gonio.kernel.forces.torque import (
    SoleDoubt,
    doubtful_soles,
    find_torques,
    foot_wrenches,
    lasting_errors,
    sample_errors,
)
from gonio.kernel.forces.whole_body import observe
from gonio.kernel.kinematics.covariance import add_covariance
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.kernel.virtual_lab.soles import cop_on_soles
from gonio.pipeline.opensim_dynamics import read_wrenches
from gonio.records import BodyModel, FootPressure, ForceMethod, Markers, Tasks

MODEL, MOTION, LOADS = "subject01_simbody.osim", "subject01_walk1_ik.mot", "subject01_walk1_grf.xml"
CUTOFF_HZ, SOLES_HZ, NOISE_M, SEEDS = 6.0, 20.0, 0.015, 6
KNEES = ("knee_angle_r", "knee_angle_l")
METHODS: dict[ForceMethod, float] = {"vertical": 27.6, "newton_euler": 14.9, "pivot": 4.6, "template": 4.8}
"""The ways to the shear, with the worst error that is still as measured, Nm."""

KEYPOINTS = (
    *((f"{part}_{side}", (0.0, 0.0, 0.0)) for part in ("femur", "tibia", "talus", "calcn", "toes") for side in "rl"),
    *(("pelvis", (0.0, 0.0, z)) for z in (-0.12, 0.12)),
    *(("torso", place) for place in ((0.0, 0.37, -0.17), (0.0, 0.37, 0.17), (0.05, 0.6, 0.0))),
)
"""Where a detector would see the body: joints, shoulders, head."""


class Trial(NamedTuple):
    """The walk with full plates, and what soles would have shown of it."""

    model: BodyModel
    times_s: Float[np.ndarray, " frame"]
    q: Float[np.ndarray, "frame coordinate"]
    motion: SmoothMotion
    plates: tuple[Wrench, ...]
    cop_foot_m: Float[np.ndarray, "frame foot 2"]
    pressure: FootPressure
    knees_nm: Float[np.ndarray, "frame knee"]


def measure_gait2354(bench: Bench) -> None:
    """Add the metrics of the walk with full plates.

    Raises:
        ResourceError: The recording is not there (``bench-data-missing``).
    """
    trial = read_trial(need(GAIT2354))
    bench.explain(__doc__)
    for method, at_most in METHODS.items():
        knees_nm = knees_by(trial, method)
        rmse_nm, r = compare(knees_nm, trial.knees_nm)
        name = "" if method == "template" else f"_{method}"
        bench.add(f"gait2354_knee_rmse_nm{name}", rmse_nm, "Nm", at_most=at_most)
        bench.add(f"gait2354_knee_r{name}", r, "1", at_least=0.97 if method == "template" else None)
        if method == "template":
            bench.add("gait2354_knee_peak_nm", _peak_error_nm(knees_nm, trial.knees_nm), "Nm")
    _make_noisy(bench, trial)


def read_trial(folder: Path) -> Trial:
    """Read the example, and reduce its plates to what soles show."""
    model = read_osim(folder / "OutputReference" / MODEL)
    table = read_mot(folder / "OutputReference" / MOTION)
    q = np.stack([table.of(name) for name in model.coordinates.names], axis=1)
    q[:, model.coordinates.rotational] = np.deg2rad(q[:, model.coordinates.rotational])
    motion = _smooth(table.times_s, q)
    plates = read_wrenches(folder / LOADS, model, motion)
    force = np.stack([plate.force_n for plate in plates], axis=1)
    moment = np.stack([plate.moment_nm for plate in plates], axis=1)
    pressed = np.where(force[..., 1] > 20.0, force[..., 1], np.nan)
    # r × F = M on the floor y = 0, as far as it is not the free moment.
    cop_lab_m = np.stack([moment[..., 2] / pressed, 0 * pressed, -moment[..., 0] / pressed], axis=-1)
    cop_foot_m = cop_on_soles(model, motion.q, cop_lab_m)
    samples = round((motion.times_s[-1] - motion.times_s[0]) * SOLES_HZ) + 1
    sample_s = motion.times_s[0] + np.arange(samples) / SOLES_HZ
    nearest = np.abs(sample_s[:, None] - motion.times_s).argmin(axis=1)  # 20 Hz are every third frame of 60
    return Trial(
        model=model,
        times_s=table.times_s,
        q=q,
        motion=motion,
        plates=plates,
        cop_foot_m=cop_foot_m,
        pressure=FootPressure(
            times_s=sample_s,
            vertical_n=np.maximum(force[nearest, :, 1], 0.0),
            cop_foot_m=cop_foot_m[nearest],
        ),
        knees_nm=_knees(model, motion, plates),
    )


def knees_by(trial: Trial, method: ForceMethod) -> Float[np.ndarray, "frame knee"]:
    """Give the knees' torques with the shear of one method, Nm."""
    choice = ForceChoice(method=method, task="walking")
    body = observe(trial.model, trial.motion)
    forces = estimate_forces(trial.pressure, body, builtin_force_coefficients(), choice)
    return _knees(trial.model, trial.motion, foot_wrenches(forces))


def compare(found: Float[np.ndarray, "frame knee"], truth: Float[np.ndarray, "frame knee"]) -> tuple[float, float]:
    """Give the root mean square error over both knees, and the mean of their correlations; the end frames are left out."""
    inside = slice(1, -1)  # there the filter makes all accelerations zero
    rmse = float(np.sqrt(np.mean((found[inside] - truth[inside]) ** 2)))
    return rmse, float(
        np.mean([np.corrcoef(f, t)[0, 1] for f, t in zip(found[inside].T, truth[inside].T, strict=True)])
    )


def _peak_error_nm(found: Float[np.ndarray, "frame knee"], truth: Float[np.ndarray, "frame knee"]) -> float:
    """Give by how much the knees' largest torques are missed, either way, on average."""
    inside = slice(1, -1)
    return float(np.abs(np.abs(found[inside]).max(axis=0) - np.abs(truth[inside]).max(axis=0)).mean())


def _make_noisy(bench: Bench, trial: Trial) -> None:
    """See the body by keypoints with errors of 15 mm, and press on soles with the errors of real ones."""
    model = trial.model
    seen = replace(
        model,
        markers=Markers(
            names=tuple(f"k{i}" for i in range(len(KEYPOINTS))),
            body=np.array([model.bodies.index(name) for name, _ in KEYPOINTS]),
            location_body_m=np.array([place for _, place in KEYPOINTS]),
            fixed=np.ones(len(KEYPOINTS), dtype=bool),
        ),
    )
    tasks = Tasks(
        marker_weights=np.ones(len(KEYPOINTS)),
        coordinate_weights=np.full(len(model.coordinates.names), 1e-4),
        coordinate_targets=model.coordinates.default,
        target_sd=np.zeros(len(model.coordinates.names)),
    )
    true_m = marker_positions(seen, trial.q)
    covariance_m2 = np.broadcast_to(NOISE_M**2 * np.eye(3), (*true_m.shape[:2], 3, 3)).copy()
    full, found, covered = [], [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        errors = lasting_errors(rng, trial.times_s, true_m[0].size).reshape(true_m.shape)
        observed = true_m + NOISE_M * errors
        solved = solve_motion(seen, tasks, observed, trial.times_s)
        solved = add_covariance(solved, seen, tasks, observed, covariance_m2)
        motion = _smooth(trial.times_s, solved.values)
        full.append(_knees(model, motion, _on_noisy_feet(trial, motion)))
        knees, band = _with_bands(trial, motion, solved.values, solved.covariance, _realistic(trial.pressure, rng))
        found.append(knees)
        covered.append(np.abs(knees - trial.knees_nm)[1:-1] <= band[1:-1])
    all_nm, full_nm = (float(np.mean([compare(knees, trial.knees_nm)[0] for knees in runs])) for runs in (found, full))
    bench.add("gait2354_knee_rmse_nm_realistic", all_nm, "Nm", at_most=10.0)
    bench.add("gait2354_knee_rmse_nm_realistic_full_force", full_nm, "Nm")
    bench.add("gait2354_knee_added_nm_realistic", np.sqrt(max(all_nm**2 - full_nm**2, 0.0)), "Nm", at_most=6.0)
    bench.add("coverage95_torque_pct", 100 * float(np.mean(covered)), "%", at_least=90.0, at_most=98.0)


def _with_bands(
    trial: Trial,
    motion: SmoothMotion,
    q: Float[np.ndarray, "frame coordinate"],
    covariance: Float[np.ndarray, "frame coordinate coordinate"] | None,
    pressure: FootPressure,
) -> tuple[Float[np.ndarray, "frame knee"], Float[np.ndarray, "frame knee"]]:
    """Give the knees' torques and half the width of their bands."""
    coefficients, choice = builtin_force_coefficients(), ForceChoice(task="walking")
    forces = estimate_forces(pressure, observe(trial.model, motion), coefficients, choice)
    draw = doubtful_soles(pressure, trial.model, coefficients, choice, SoleDoubt())
    rest = sample_errors(trial.model, trial.times_s, q, covariance, _smooth, draw)
    torques = find_torques(trial.model, motion, forces, coefficients, rest)
    columns = [torques.index(name) for name in KNEES]
    return torques.values[:, columns], torques.band[:, columns]


def _realistic(pressure: FootPressure, rng: np.random.Generator) -> FootPressure:
    """Add what real soles do: gain 5 %, places off by 5 mm and 3 mm of noise, 10 N of noise, clock re-aligned to 5 ms."""
    force = pressure.vertical_n * (1 + 0.05 * rng.standard_normal(2))
    force += np.where(pressure.vertical_n > 0, 10.0 * rng.standard_normal(force.shape), 0.0)
    place = pressure.cop_foot_m + 0.005 * rng.standard_normal((2, 2))
    return FootPressure(
        times_s=pressure.times_s + 0.005 * rng.standard_normal(),
        vertical_n=np.maximum(force, 0.0),
        cop_foot_m=place + 0.003 * rng.standard_normal(place.shape),
    )


def _on_noisy_feet(trial: Trial, motion: SmoothMotion) -> tuple[Wrench, ...]:
    """Move the plates' true forces with the feet: what is left is the movement's own error."""
    moved = []
    true, wrong = body_poses(trial.model, trial.motion.q), body_poses(trial.model, motion.q)
    for wrench in trial.plates:
        body = trial.model.bodies.index(wrench.body)
        turn = wrong[:, body] @ np.linalg.inv(true[:, body])
        pressed = np.where(wrench.force_n[:, 1] > 20.0, wrench.force_n[:, 1], np.nan)
        cop = np.stack([wrench.moment_nm[:, 2] / pressed, 0 * pressed, -wrench.moment_nm[:, 0] / pressed], axis=1)
        free = wrench.moment_nm - np.cross(cop, wrench.force_n)
        place = np.einsum("fij,fj->fi", turn[:, :3, :3], cop) + turn[:, :3, 3]
        moment = np.cross(place * [1.0, 0.0, 1.0], wrench.force_n) + free
        moved.append(replace(wrench, force_n=np.where(np.isnan(moment), 0.0, wrench.force_n), moment_nm=moment))
    return tuple(moved)


def _knees(model: BodyModel, motion: SmoothMotion, wrenches: tuple[Wrench, ...]) -> Float[np.ndarray, "frame knee"]:
    dynamics = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, wrenches)
    return np.stack([dynamics.of(name) for name in KNEES], axis=1)


_smooth: Callable[[Float[np.ndarray, " frame"], Float[np.ndarray, "frame coordinate"]], SmoothMotion] = partial(
    opensim.differentiate, cutoff_hz=CUTOFF_HZ
)
