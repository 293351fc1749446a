"""OpenSim's tools on their own setup files: ``gonio scale`` and ``gonio ik``.

They read and write what OpenSim's would: paths are relative to the setup's folder, marker and coordinate tasks have OpenSim's
cost, and files have its formats.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.mot import table_of_motion, write_mot
from gonio.formats.osim import read_osim, read_osim_markers
from gonio.formats.osim_setup import (
    PlacementSetup,
    ScaleSetup,
    read_kinematics_setup,
    read_scale_setup,
    write_scale_set,
)
from gonio.formats.osim_writer import write_osim
from gonio.formats.trc import Trajectories, read_trc
from gonio.kernel.body.placement import place_markers
from gonio.kernel.body.scaling import measure_scale_factors, scale_model
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import NOT_CONVERGED, TOO_FEW_MARKERS, BodyModel, Markers, Motion

_TIME_SLACK_S = 1e-6  # times in files are rounded; OpenSim takes the frames of a closed interval


@dataclass(frozen=True)
class ToolResult:
    """What a tool wrote, and what its user should know, one sentence each."""

    files: tuple[Path, ...]
    remarks: tuple[str, ...]


def run_kinematics(setup_file: Path) -> tuple[Motion, ToolResult]:
    """Do what an InverseKinematicsTool's setup says.

    A coordinate that no marker and no task tells of takes its default, as in OpenSim; frames with too few markers are NaN.

    Args:
        setup_file: The setup, unchanged.

    Returns:
        The motion, and the motion file that was written.

    Raises:
        InputError: a file is wrong or lacks something; a trial without a frame in the time range; a marker of the setup that
            the trial lacks. The message names the file and the element.
    """
    setup = read_kinematics_setup(setup_file)
    model, trial = read_osim(setup.model_file), read_trc(setup.marker_file)
    tasks = setup.tasks.for_model(model, trial.names)
    motion = solve_motion(model, tasks, *_in_model_order(model, trial, setup.time_range_s, setup.marker_file))
    motion, unseen = _fill_unseen(motion, model)
    output = setup.output_motion_file or setup_file.with_name(f"{setup_file.stem}_ik.mot")
    write_mot(output, table_of_motion(motion))
    remarks = [f"{name} is seen by no marker: it keeps its default." for name in unseen]
    count = len(motion.times_s)
    if unknown := int(np.isnan(motion.values).any(axis=1).sum()):
        remarks.append(
            f"In {unknown} of {count} frames too few markers are seen: what they leave unknown is nan in {output.name}."
        )
    if diverged := int((motion.status == NOT_CONVERGED).sum()):
        remarks.append(f"{diverged} of {count} frames did not converge.")
    return motion, ToolResult((output,), tuple(remarks))


def _fill_unseen(motion: Motion, model: BodyModel) -> tuple[Motion, tuple[str, ...]]:
    """Give coordinates that no frame tells of their default, and their names."""
    solved = motion.status != TOO_FEW_MARKERS
    unseen = np.isnan(motion.values[solved]).all(axis=0) & bool(solved.any())
    values = np.where(solved[:, None] & unseen, model.coordinates.default, motion.values)
    return replace(motion, values=values), tuple(model.coordinates.names[index] for index in np.flatnonzero(unseen))


def run_scale(setup_file: Path) -> tuple[BodyModel, ToolResult]:
    """Do what a ScaleTool's setup says: measure, scale, place the markers, write the models.

    Args:
        setup_file: The setup, unchanged.

    Returns:
        The last model of the chain (with placed markers if the setup has a marker placer), and the files that were written.

    Raises:
        InputError: a file is wrong or lacks something; the message names the file and the element.
        CaptureError: a pair of markers that measures a body was never seen together.
    """
    setup = read_scale_setup(setup_file)
    generic = read_osim(setup.model_file)
    if setup.marker_set_file is not None:
        generic = _with_markers(generic, read_osim_markers(setup.marker_set_file, generic))
    factors, remarks = _find_factors(setup, generic)
    model = scale_model(generic, factors, mass_kg=setup.mass_kg, keep_shares=setup.preserve_mass_distribution)
    model = replace(model, name=setup.name)
    files: list[Path] = []
    if setup.scale_set_file is not None:
        write_scale_set(setup.scale_set_file, model.bodies.names, factors)
        files.append(setup.scale_set_file)
    if setup.scaled_model_file is not None:
        write_osim(setup.scaled_model_file, model, setup.model_file)
        files.append(setup.scaled_model_file)
    if setup.placing is not None:
        model = _place(setup.placing, model, setup.model_file, files)
    return model, ToolResult(tuple(files), remarks)


def _find_factors(setup: ScaleSetup, model: BodyModel) -> tuple[Float[np.ndarray, "body 3"], tuple[str, ...]]:
    """Measure the factors and lay the manual ones over or under them; bodies that the model lacks are remarked on."""
    known = tuple(m for m in setup.measurements if set(m.bodies) <= set(model.bodies.names))
    strange = [body for m in setup.measurements for body in m.bodies if body not in model.bodies.names]
    strange += [body for body in setup.manual_factors if body not in model.bodies.names]
    factors = np.ones((len(model.bodies.names), 3))
    if not setup.manual_last:
        _lay_manual(factors, setup, model)
    if known:
        if setup.measured_file is None:
            raise InputError("The ModelScaler names no marker file.", hint="Give it a <marker_file> to measure in.")
        trial = read_trc(setup.measured_file)
        seen, _ = _in_model_order(model, trial, setup.measured_range_s, setup.measured_file)
        measured = measure_scale_factors(model, known, seen, average="mean", symmetric=False)
        for measurement in known:
            axes = ["XYZ".index(axis) for axis in measurement.axes]
            for body in measurement.bodies:
                factors[model.bodies.index(body), axes] = measured[model.bodies.index(body), axes]
    if setup.manual_last:
        _lay_manual(factors, setup, model)
    return factors, tuple(
        f"The model has no body {body}: its scale factor is not used." for body in dict.fromkeys(strange)
    )


def _lay_manual(factors: Float[np.ndarray, "body 3"], setup: ScaleSetup, model: BodyModel) -> None:
    for body, manual in setup.manual_factors.items():
        if body in model.bodies.names:
            factors[model.bodies.index(body)] = manual


def _place(placing: PlacementSetup, model: BodyModel, template: Path, files: list[Path]) -> BodyModel:
    trial = read_trc(placing.marker_file)
    seen, times_s = _in_model_order(model, trial, placing.time_range_s, placing.marker_file)
    placed, pose = place_markers(model, placing.tasks.for_model(model, trial.names), seen)
    if placing.output_motion_file is not None:
        write_mot(placing.output_motion_file, table_of_motion(replace(pose, times_s=times_s[:1])))
        files.append(placing.output_motion_file)
    if placing.output_model_file is not None:
        write_osim(placing.output_model_file, placed, template)
        files.append(placing.output_model_file)
    return placed


def _with_markers(model: BodyModel, more: Markers) -> BodyModel:
    """Add markers to a model; those of a name that it has replace its own."""
    own = model.markers
    kept = [index for index, name in enumerate(own.names) if name not in more.names]
    markers = Markers(
        names=(*(own.names[index] for index in kept), *more.names),
        body=np.concatenate([own.body[kept], more.body]),
        location_body_m=np.concatenate([own.location_body_m[kept], more.location_body_m]),
        fixed=np.concatenate([own.fixed[kept], more.fixed]),
    )
    return replace(model, markers=markers)


def _in_model_order(
    model: BodyModel, trial: Trajectories, time_range_s: tuple[float, float], file: Path
) -> tuple[Float[np.ndarray, "frame marker 3"], Float[np.ndarray, " frame"]]:
    """Give the model's markers as the trial saw them within a range of time, NaN where it lacks one, and the times."""
    start_s, end_s = time_range_s
    inside = (trial.times_s >= start_s - _TIME_SLACK_S) & (trial.times_s <= end_s + _TIME_SLACK_S)
    if not np.any(inside):
        raise InputError(
            f"{file.name} has no frame between {start_s:g} and {end_s:g} s: "
            f"it runs from {trial.times_s[0]:g} to {trial.times_s[-1]:g} s.",
            hint="Change the setup's <time_range>.",
        )
    seen = np.full((int(inside.sum()), len(model.markers.names), 3), np.nan)
    for marker, name in enumerate(model.markers.names):
        if name in trial.names:
            seen[:, marker] = trial.xyz_m[inside, trial.names.index(name)]
    return seen, trial.times_s[inside]
