"""OpenSim's inverse dynamics on its own setup file: ``gonio id``.

It reads and writes what OpenSim's InverseDynamicsTool would, with its padding, filter, splines and time grid. That is one set
of conventions; the other is gonio's own, for who need not compare with OpenSim:

============  =============================================  ============================================
              opensim                                        gonio
============  =============================================  ============================================
low-pass      third order, both ways, cutoff not corrected   second order, both ways, cutoff corrected
uneven times  resampled at the smallest step                 uniform up to rounding, or an error
couplers      ignored: each coordinate has its own force     a dependent coordinate's force is its driver's
============  =============================================  ============================================
"""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.external_loads import ExternalForce, ExternalLoads, read_external_loads
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.osim import read_osim, read_osim_forces
from gonio.formats.osim_setup import DynamicsSetup, read_dynamics_setup
from gonio.kernel.body.forward import body_poses
from gonio.kernel.dynamics import opensim, zero_lag
from gonio.kernel.dynamics.opensim import SmoothMotion, interpolate_forces
from gonio.kernel.dynamics.recursive import Dynamics, Wrench, solve_dynamics, wrench_at_point
from gonio.pipeline.opensim_tools import ToolResult
from gonio.records import BodyModel

Conventions: TypeAlias = Literal["opensim", "gonio"]

GROUND_NAMES = {"ground", ""}

LARGEST_TURN_RAD = 4 * np.pi
"""Nobody turns a joint twice round: larger values in a file that promises radians are degrees."""

SMALLEST_TURN_DEG = np.pi
"""Nobody moves without an angle above three degrees: smaller ones throughout, in a file that promises degrees, are radians."""


def run_dynamics(setup_file: Path, conventions: Conventions = "opensim") -> tuple[Dynamics, SmoothMotion, ToolResult]:
    """Do what an InverseDynamicsTool's setup says.

    Args:
        setup_file: The setup, unchanged.
        conventions: OpenSim's own, to the digit, or gonio's (see above).

    Returns:
        The generalized forces, the motion that they were computed for, and the file that was written.

    Raises:
        InputError: a file is wrong or lacks something: a column, a body, times that forces and motion share. The message
            names the file and the element.
    """
    setup = read_dynamics_setup(setup_file)
    model, remarks = read_osim(setup.model_file), _not_honoured(setup, setup_file)
    if conventions == "opensim":
        model, more = _without_couplers(model)
        remarks += more
    times_s, q, more = _read_coordinates(setup.coordinates_file, model)
    motion = _differentiate(setup, setup_file, times_s, q, conventions)
    wrenches = read_wrenches(setup.loads_file, model, motion) if setup.loads_file is not None else ()
    dynamics = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration, wrenches)
    try:
        setup.output_file.parent.mkdir(parents=True, exist_ok=True)
        write_mot(setup.output_file, table_of_torques(model, motion.times_s, dynamics.forces))
    except OSError as error:
        raise InputError(
            f"{setup.output_file.name} can't be written into {setup.output_file.parent.name}: {error.strerror}.",
            hint=f"Change <results_directory> of {setup_file.name}.",
        ) from error
    return dynamics, motion, ToolResult((setup.output_file,), remarks + more)


def table_of_torques(
    model: BodyModel, times_s: Float[np.ndarray, " frame"], torques: Float[np.ndarray, "frame coordinate"]
) -> Table:
    """Make the table as OpenSim writes it: ``_moment`` for turns, ``_force`` for slides."""
    endings = ["moment" if turns else "force" for turns in model.coordinates.rotational]
    return Table(
        name="Inverse Dynamics Generalized Forces",
        labels=tuple(f"{name}_{ending}" for name, ending in zip(model.coordinates.names, endings, strict=True)),
        times_s=times_s,
        values=torques,
        in_degrees=False,
    )


def read_wrenches(loads_file: Path, model: BodyModel, motion: SmoothMotion) -> tuple[Wrench, ...]:
    """Read the external loads and interpolate them to the motion's times.

    Raises:
        InputError: a file is wrong, a body or a column that a force names is not there, or the forces don't cover the motion.
    """
    loads = read_external_loads(loads_file)
    forces = [force for force in loads.forces if force.body not in GROUND_NAMES]
    for force in forces:
        with _blaming(f"{loads_file.name}, ExternalForce {force.name}"):
            for body in (force.body, force.force_expressed_in, force.point_expressed_in):
                if body not in GROUND_NAMES:
                    model.bodies.index(body)
    sampled = _sample_columns(loads, loads_file, motion.times_s)

    def columns(identifier: str) -> Float[np.ndarray, "frame 3"] | None:  # of x, y, z; None where there are none
        return np.stack([sampled[f"{identifier}{axis}"] for axis in "xyz"], axis=1) if identifier else None

    elsewhere = {frame for force in forces for frame in (force.force_expressed_in, force.point_expressed_in)}
    needs_poses = bool(elsewhere - GROUND_NAMES) or any(not force.point for force in forces)
    poses = body_poses(model, motion.q) if needs_poses else np.empty((len(motion.q), 0, 4, 4))
    return tuple(
        _wrench(given, model, poses, columns(given.force), columns(given.point), columns(given.torque))
        for given in forces
    )


def _sample_columns(
    loads: ExternalLoads, loads_file: Path, at_s: Float[np.ndarray, " frame"]
) -> dict[str, Float[np.ndarray, " frame"]]:
    """Interpolate the columns that some force names; what else the file holds does not matter."""
    table, found = read_mot(loads.data_file), dict[str, Float[np.ndarray, " sample"]]()
    for force in loads.forces:
        with _blaming(f"{loads_file.name}, ExternalForce {force.name}"):
            for identifier in filter(None, (force.force, force.point, force.torque)):
                found |= {f"{identifier}{axis}": table.of(f"{identifier}{axis}") for axis in "xyz"}
    if not found:
        return {}
    with _blaming(loads.data_file.name):
        sampled = interpolate_forces(table.times_s, np.stack(list(found.values()), axis=1), at_s)
    return dict(zip(found, sampled.T, strict=True))


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


def _read_coordinates(
    file: Path, model: BodyModel
) -> tuple[Float[np.ndarray, " frame"], Float[np.ndarray, "frame coordinate"], tuple[str, ...]]:
    """Read a motion in the model's order, rad and m; a coordinate that the file lacks keeps its default, and that is said."""
    table, coordinates = read_mot(file), model.coordinates
    q = np.tile(coordinates.default, (len(table.times_s), 1))
    given = np.array([name in table.labels for name in coordinates.names])
    for index in np.flatnonzero(given):
        q[:, index] = table.of(coordinates.names[index])
    missing = [coordinates.names[index] for index in np.flatnonzero(~given & (coordinates.coupled_to < 0))]
    if len(missing) == sum(coordinates.coupled_to < 0):
        raise InputError(
            f"{file.name} has no column for any coordinate of the model.", hint="Is it the motion of another model?"
        )
    remarks = tuple(f"{file.name} has no column {name}: it keeps its default." for name in missing)
    angles = given & coordinates.rotational
    largest = np.where(angles, np.abs(np.nan_to_num(q)).max(axis=0), 0.0)
    if table.in_degrees:
        q[:, angles] = np.deg2rad(q[:, angles])
        if 0 < largest.max() < SMALLEST_TURN_DEG:
            remarks += (
                f"{file.name} promises degrees, but no angle exceeds {largest.max():.2g}: "
                "if they are radians, its header must say inDegrees=no.",
            )
    elif largest.max() > LARGEST_TURN_RAD:
        raise InputError(
            f"{file.name} promises radians, but {coordinates.names[largest.argmax()]} reaches {largest.max():.0f}.",
            hint="If these are degrees, its header must say inDegrees=yes.",
            code="degrees-suspected",
        )
    return table.times_s, q, remarks


def _differentiate(
    setup: DynamicsSetup,
    setup_file: Path,
    times_s: Float[np.ndarray, " frame"],
    q: Float[np.ndarray, "frame coordinate"],
    conventions: Conventions,
) -> SmoothMotion:
    start_s, end_s = setup.time_range_s
    if start_s > times_s[-1] or end_s < times_s[0]:
        raise InputError(
            f"{setup.coordinates_file.name} runs from {times_s[0]:g} to {times_s[-1]:g} s: "
            f"nothing of it lies between {start_s:g} and {end_s:g} s.",
            hint=f"Change <time_range> of {setup_file.name}.",
        )
    way = opensim if conventions == "opensim" else zero_lag
    with _blaming(f"{setup.coordinates_file.name}, filtered as {setup_file.name} says"):
        return way.differentiate(times_s, q, setup.cutoff_hz, setup.time_range_s)


def _without_couplers(model: BodyModel) -> tuple[BodyModel, tuple[str, ...]]:
    """Give the model as OpenSim's tool sees it: it computes residual forces, and constraints have no part in these."""
    coordinates, free = model.coordinates, np.full(len(model.coordinates.names), -1)
    coupled = [coordinates.names[index] for index in np.flatnonzero(coordinates.coupled_to >= 0)]
    if not coupled:
        return model, ()
    remark = (
        f"{model.source} couples {_listed(coupled)}: as in OpenSim, the couplers are ignored and each has a force of its own. "
        "With gonio's conventions the coordinates that drive them have it."
    )
    return replace(model, coordinates=replace(coordinates, coupled_to=free, coupling_function=free)), (remark,)


def _not_honoured(setup: DynamicsSetup, setup_file: Path) -> tuple[str, ...]:
    """Say what OpenSim would do that gonio does not."""
    remarks: tuple[str, ...] = ()
    excluded = {name.lower() for name in setup.excluded_forces}
    if "all" not in excluded:
        no_muscles = bool(excluded & {"muscles", "actuators"})
        acting = [
            force.name
            for force in read_osim_forces(setup.model_file)
            if not ("Muscle" in force.kind and no_muscles)
            and not force.kind.endswith("Actuator")  # idle ones push with 0
        ]
        if acting:
            remarks += (
                f"{setup_file.name} leaves forces of the model in, {_listed(acting)}: OpenSim would subtract what they do, "
                "gonio gives the whole torques. With <forces_to_exclude> ALL both are the same.",
            )
    if setup.reported_joints:
        remarks += (f"The reactions at {_listed(setup.reported_joints)} are not computed: gonio gives torques only.",)
    return remarks


def _listed(names: list[str] | tuple[str, ...]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


@contextmanager
def _blaming(place: str) -> Generator[None, None, None]:
    """Let an error say in which file, and where in it, it arose."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error.message}", hint=error.hint, code=error.code, **error.details) from error
