"""OpenSim's inverse dynamics on its own setup file: ``gonio id``.

It reads and writes what OpenSim's InverseDynamicsTool would, with its padding, filter, splines and time grid.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.osim import read_osim
from gonio.formats.osim_setup import ExternalForce, read_dynamics_setup, read_external_loads
from gonio.kernel.body.forward import body_poses
from gonio.kernel.dynamics.opensim import SmoothMotion, differentiate, interpolate_forces
from gonio.kernel.dynamics.recursive import Dynamics, Wrench, solve_dynamics, wrench_at_point
from gonio.pipeline.opensim_tools import ToolResult
from gonio.records import BodyModel

GROUND_NAMES = {"ground", ""}

LARGEST_TURN_RAD = 4 * np.pi
"""Nobody turns a joint twice round: larger values in a file that promises radians are degrees."""


def run_dynamics(setup_file: Path) -> tuple[Dynamics, SmoothMotion, ToolResult]:
    """Do what an InverseDynamicsTool's setup says.

    Args:
        setup_file: The setup, unchanged.

    Returns:
        The generalized forces, the motion that they were computed for, and the file that was written.

    Raises:
        InputError: a file is wrong or lacks something: a column, a body, times that forces and motion share. The message
            names the file and the element.
    """
    setup = read_dynamics_setup(setup_file)
    model = read_osim(setup.model_file)
    times_s, q, remarks = _read_coordinates(setup.coordinates_file, model)
    start_s, end_s = setup.time_range_s
    if start_s > times_s[-1] or end_s < times_s[0]:
        raise InputError(
            f"{setup.coordinates_file.name} runs from {times_s[0]:g} to {times_s[-1]:g} s: "
            f"nothing of it lies between {start_s:g} and {end_s:g} s.",
            hint="Change the setup's <time_range>.",
        )
    motion = differentiate(times_s, q, setup.cutoff_hz, setup.time_range_s)
    wrenches = read_wrenches(setup.loads_file, model, motion) if setup.loads_file is not None else ()
    dynamics = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, wrenches)
    output = setup.output_file or setup_file.with_name("inverse_dynamics.sto")
    write_mot(output, table_of_forces(model, motion, dynamics))
    return dynamics, motion, ToolResult((output,), remarks)


def table_of_forces(model: BodyModel, motion: SmoothMotion, dynamics: Dynamics) -> Table:
    """Make the table as OpenSim writes it: ``_moment`` for turns, ``_force`` for slides."""
    endings = ["moment" if turns else "force" for turns in model.coordinates.rotational]
    return Table(
        name="Inverse Dynamics Generalized Forces",
        labels=tuple(f"{name}_{ending}" for name, ending in zip(dynamics.coordinate_names, endings, strict=True)),
        times_s=motion.times_s,
        values=dynamics.forces,
        in_degrees=False,
    )


def _read_coordinates(
    file: Path, model: BodyModel
) -> tuple[Float[np.ndarray, " frame"], Float[np.ndarray, "frame coordinate"], tuple[str, ...]]:
    """Read a motion in the model's order, rad and m; a coordinate that the file lacks keeps its default, and that is said."""
    table = read_mot(file)
    coordinates, remarks = model.coordinates, []
    q = np.tile(coordinates.default, (len(table.times_s), 1))
    for index, name in enumerate(coordinates.names):
        if name not in table.labels:
            if coordinates.coupled_to[index] < 0:
                remarks.append(f"{file.name} has no column {name}: it keeps its default.")
            continue
        q[:, index] = table.of(name)
        if coordinates.rotational[index]:
            if table.in_degrees:
                q[:, index] = np.deg2rad(q[:, index])
            elif np.nanmax(np.abs(q[:, index])) > LARGEST_TURN_RAD:
                raise InputError(
                    f"{file.name} promises radians, but {name} reaches {np.nanmax(np.abs(q[:, index])):.0f}.",
                    hint="If these are degrees, its header must say inDegrees=yes.",
                    code="degrees-suspected",
                )
    if len(remarks) == sum(coordinates.coupled_to < 0):
        raise InputError(
            f"{file.name} has no column for any coordinate of the model.", hint="Is it the motion of another model?"
        )
    return table.times_s, q, tuple(remarks)


def read_wrenches(loads_file: Path, model: BodyModel, motion: SmoothMotion) -> tuple[Wrench, ...]:
    """Read the external loads and interpolate them to the motion's times."""
    loads = read_external_loads(loads_file)
    table = read_mot(loads.data_file)
    given_at = {name: i for i, name in enumerate(table.labels)}
    sampled = interpolate_forces(table.times_s, table.values, motion.times_s)

    def columns(identifier: str) -> Float[np.ndarray, "frame 3"] | None:  # of x, y, z; None where there are none
        if not identifier:
            return None
        labels = [f"{identifier}{axis}" for axis in "xyz"]
        if missing := [label for label in labels if label not in given_at]:
            raise InputError(
                f"{loads.data_file.name} has no column {missing[0]}, which {loads_file.name} names.",
                hint=f"It has: {', '.join(table.labels)}.",
            )
        return sampled[:, [given_at[label] for label in labels]]

    elsewhere = {frame for force in loads.forces for frame in (force.force_expressed_in, force.point_expressed_in)}
    needs_poses = bool(elsewhere - GROUND_NAMES) or any(not force.point for force in loads.forces)
    poses = body_poses(model, motion.q) if needs_poses else np.empty((len(motion.q), 0, 4, 4))
    return tuple(
        _wrench(given, model, poses, columns(given.force), columns(given.point), columns(given.torque))
        for given in loads.forces
    )


def _wrench(
    given: ExternalForce,
    model: BodyModel,
    poses: Float[np.ndarray, "frame body 4 4"],
    force: Float[np.ndarray, "frame 3"] | None,
    point: Float[np.ndarray, "frame 3"] | None,
    torque: Float[np.ndarray, "frame 3"] | None,
) -> Wrench:
    """Bring one external force to the lab; without a point it acts at the body's origin."""
    frames, body = len(poses), model.bodies.index(given.body)
    pull = np.zeros((frames, 3)) if force is None else force
    twist = np.zeros((frames, 3)) if torque is None else torque
    if given.force_expressed_in not in GROUND_NAMES:
        R_lab_frame = poses[:, model.bodies.index(given.force_expressed_in), :3, :3]
        pull, twist = np.einsum("fij,fj->fi", R_lab_frame, pull), np.einsum("fij,fj->fi", R_lab_frame, twist)
    place = poses[:, body, :3, 3] if point is None else point
    if point is not None and given.point_expressed_in not in GROUND_NAMES:
        frame = poses[:, model.bodies.index(given.point_expressed_in)]
        place = np.einsum("fij,fj->fi", frame[:, :3, :3], point) + frame[:, :3, 3]
    return wrench_at_point(given.body, pull, place, twist)
