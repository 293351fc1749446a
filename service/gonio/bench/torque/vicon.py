"""A marker laboratory's trial: events, knee flexion and knee moment against those in its own file (Vicon, Plug-in Gait).

Recording: BTK's Plug-in Gait example, 74 kg, two plates; the body model is scaled to its standing trial. Knee flexion is
compared with its mean difference removed, the moment where the foot stands on a plate of its own. ``vicon_event_ms`` is the
worst of the events found in the movement alone, as without plates; those of the plates stand beside it: the right one is
unloaded 24 ms after the file's foot-off. The file's events within 0.1 s of its ends are not asked for.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.recordings import VICON_PIG, need
from gonio.formats.c3d import C3d, read_c3d
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.formats.trc import Trajectories
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.body.placement import place_markers
from gonio.kernel.body.scaling import measure_scale_factors, scale_model
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.kernel.dynamics.zero_lag import differentiate
from gonio.kernel.forces.plates import assign_plates
from gonio.kernel.gait.events import events_from_force, events_from_movement
from gonio.kernel.gait.paths import foot_paths
from gonio.kernel.gait.progression import find_bouts
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import BodyModel, FootForces, FootPaths, GaitEvents, Motion, Timebase
from gonio.resources import models_dir

MASS_KG = 74.0
SIDES = ("right", "left")


class Trial(NamedTuple):
    """The walk as the file has it and as gonio finds it."""

    file: C3d
    model: BodyModel
    motion: Motion
    paths: FootPaths
    forces: FootForces


class Beside(NamedTuple):
    """A quantity of one knee beside Plug-in Gait's, where both are known."""

    ours: Float[np.ndarray, " frame"]
    plug_in: Float[np.ndarray, " frame"]

    @property
    def rmse(self) -> float:
        """Root mean square difference."""
        return float(np.sqrt(np.mean((self.ours - self.plug_in) ** 2)))

    @property
    def spread(self) -> float:
        """Root mean square difference, its mean removed."""
        return float(np.std(self.ours - self.plug_in))

    @property
    def r(self) -> float:
        """Correlation."""
        return float(np.corrcoef(self.ours, self.plug_in)[0, 1])


def measure_vicon(bench: Bench) -> None:
    """Add the metrics of the marker laboratory's trial.

    Raises:
        ResourceError: The recording is not there (``bench-data-missing``).
    """
    trial = read_trial(need(VICON_PIG))
    bench.explain(__doc__)
    flexion, moment = ([of(trial, side) for side in SIDES] for of in (knee_flexion_deg, knee_moment_nm_kg))
    moved, pushed = ([e for es in errors_ms(events, trial).values() for e in es] for events in find_events(trial))
    bench.add("vicon_events", len(moved), "of 12")
    bench.add("vicon_event_ms", max(map(abs, moved)), "ms", at_most=20.0)
    bench.add("vicon_event_ms_plates", max(map(abs, pushed)), "ms")
    bench.add("vicon_knee_flexion_deg", max(knee.spread for knee in flexion), "deg", at_most=4.0)
    bench.add("vicon_knee_moment_r", min(knee.r for knee in moment), "1", at_least=0.95)
    bench.add("vicon_knee_moment_rmse_nm_kg", max(knee.rmse for knee in moment), "Nm/kg", at_most=0.15)


def read_trial(folder: Path) -> Trial:
    """Read the trial, scale the body to the standing one, solve the motion and give each foot its plate's forces."""
    card = read_markerset(models_dir() / "markersets" / "plug_in_gait_lower.toml")
    generic = attach(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), card)
    static = _in_order(read_c3d(folder / "PiG_Calibration3_FF.c3d").markers, generic)
    scaled = scale_model(generic, measure_scale_factors(generic, card.measurements, static), mass_kg=MASS_KG)
    movable = replace(scaled.markers, fixed=np.zeros(len(scaled.markers.names), dtype=bool))
    model, _ = place_markers(replace(scaled, markers=movable), make_tasks(scaled, card), static)
    file = read_c3d(folder / "PiG_Motion3_FF.c3d")
    motion = solve_motion(model, make_tasks(model, card), _in_order(file.markers, model), file.markers.times_s)
    timebase = Timebase(rate_hz=file.markers.rate_hz, start_s=float(file.markers.times_s[0]))
    paths = foot_paths(model, motion, timebase)
    assert paths is not None
    assert file.plates is not None
    forces = assign_plates(file.plates, file.markers.times_s, paths.heel_lab_m, paths.toe_lab_m)
    return Trial(file, model, motion, paths, forces)


def find_events(trial: Trial) -> tuple[GaitEvents, GaitEvents]:
    """Give the events by movement and those by force."""
    moved = events_from_movement(trial.paths, find_bouts(trial.paths))
    pushed = events_from_force(trial.forces.times_s, trial.forces.wrench[..., 1], trial.paths.timebase)
    return moved, pushed


def errors_ms(events: GaitEvents, trial: Trial) -> dict[tuple[str, str], list[float]]:
    """Give how far each event, by label and side, is from the nearest of the file's."""
    found: dict[tuple[str, str], list[float]] = {}
    start_s, rate_hz = trial.paths.timebase.start_s, trial.paths.timebase.rate_hz
    for label, trains in (("Foot Strike", events.strikes), ("Foot Off", events.lifts)):
        for side, train in zip(SIDES, trains, strict=True):
            file_s = np.array([e.time_s for e in trial.file.events if e.label == label and e.side == side])
            times_s = start_s + train.frames / rate_hz
            found[label, side] = [1e3 * float(t - file_s[np.argmin(np.abs(file_s - t))]) for t in times_s]
    return found


def knee_flexion_deg(trial: Trial, side: str) -> Beside:
    """Give the knee's flexion beside Plug-in Gait's, degrees."""
    plug_in = trial.file.outputs.of(f"{side[0].upper()}KneeAnglesV")[:, 0]
    ours = np.degrees(trial.motion.of(f"knee_angle_{side[0]}"))
    known = np.isfinite(ours) & np.isfinite(plug_in)
    return Beside(ours[known], plug_in[known])


def knee_moment_nm_kg(trial: Trial, side: str) -> Beside:
    """Give the knee's extending moment beside Plug-in Gait's, while the foot stands on a plate of its own, Nm/kg."""
    smooth = differentiate(trial.motion.times_s, trial.motion.values, 6.0)
    wrenches = tuple(
        Wrench(
            body=f"calcn_{name[0]}",
            force_n=trial.forces.wrench[:, foot, :3],
            moment_nm=trial.forces.wrench[:, foot, 3:],
        )
        for foot, name in enumerate(SIDES)
    )
    dynamics = solve_dynamics(trial.model, smooth.q, smooth.velocity, smooth.acceleration, wrenches)
    # Plug-in Gait's moment extends, the model's coordinate flexes.
    ours = -dynamics.forces[:, dynamics.coordinate_names.index(f"knee_angle_{side[0]}")] / MASS_KG
    plug_in = trial.file.outputs.of(f"{side[0].upper()}KneeMoment")[:, 0] / 1000.0  # Nmm/kg
    loaded = (trial.forces.wrench[:, SIDES.index(side), 1] > 20) & np.isfinite(plug_in) & np.isfinite(ours)
    return Beside(ours[loaded], plug_in[loaded])


def _in_order(markers: Trajectories, model: BodyModel) -> Float[np.ndarray, "frame marker 3"]:
    return markers.xyz_m[:, [markers.names.index(name) for name in model.markers.names]]
