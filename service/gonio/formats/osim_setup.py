"""The setup files of OpenSim's tools: scaling, inverse kinematics and inverse dynamics.

File names in a setup are relative to the setup's own folder, as OpenSim has it; here they become paths.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - no types

from gonio.errors import InputError
from gonio.formats.osim_xml import (
    Element,
    assigned,
    describe,
    flag,
    name_of,
    number,
    numbers,
    objects,
    open_document,
    optional_file,
    required_file,
    text,
    vector,
    words,
)
from gonio.records import BodyModel, Measurement, Tasks

_ALWAYS = (-np.inf, np.inf)


@dataclass(frozen=True)
class CoordinateTask:
    """One coordinate that inverse kinematics pulls to a value (rad, m): its default where ``value`` is None."""

    name: str
    weight: float
    value: float | None


@dataclass(frozen=True)
class TaskSet:
    """The weights of inverse kinematics as a setup gives them, by name; tasks that are not applied are left out."""

    marker_weights: dict[str, float]
    coordinates: tuple[CoordinateTask, ...]

    def for_model(self, model: BodyModel, seen: tuple[str, ...]) -> Tasks:
        """Lay the weights out in the model's order.

        Args:
            model: The model.
            seen: The markers that the trial holds.

        Raises:
            InputError: a marker of the setup that model or trial lacks, or an unknown coordinate.
        """
        weights = np.zeros(len(model.markers.names))
        for name, weight in self.marker_weights.items():
            if weight > 0 and name not in seen:
                raise InputError(
                    f"The setup weighs the marker {name}, which the trial does not hold.",
                    hint=f"Set <apply> of its task to false. The trial holds: {', '.join(seen)}.",
                )
            weights[model.markers.index(name)] = weight
        pull, targets = np.zeros(len(model.coordinates.names)), model.coordinates.default.copy()
        for task in self.coordinates:
            index = model.coordinates.index(task.name)
            pull[index] = task.weight
            if task.value is not None:
                targets[index] = task.value
        return Tasks(
            marker_weights=weights,
            coordinate_weights=pull,
            coordinate_targets=targets,
            target_sd=np.zeros(len(pull)),  # OpenSim's tasks are wishes of the user, not measurements
        )


@dataclass(frozen=True)
class KinematicsSetup:
    """An InverseKinematicsTool: what to read, what to weigh, what to write."""

    model_file: Path
    marker_file: Path
    tasks: TaskSet
    time_range_s: tuple[float, float]
    output_motion_file: Path | None


@dataclass(frozen=True)
class ScaleSetup:
    """A ScaleTool. ``manual_factors`` override what was measured where ``manual_last``, as the scaling order says."""

    name: str
    model_file: Path
    marker_set_file: Path | None
    mass_kg: float | None
    measurements: tuple[Measurement, ...]
    measured_file: Path | None
    measured_range_s: tuple[float, float]
    manual_factors: dict[str, tuple[float, float, float]]
    manual_last: bool
    preserve_mass_distribution: bool
    scaled_model_file: Path | None
    scale_set_file: Path | None
    placing: "PlacementSetup | None"


@dataclass(frozen=True)
class PlacementSetup:
    """The MarkerPlacer of a ScaleTool: the static pose, and where the model with its placed markers goes."""

    marker_file: Path
    tasks: TaskSet
    time_range_s: tuple[float, float]
    output_model_file: Path | None
    output_motion_file: Path | None


@dataclass(frozen=True)
class DynamicsSetup:
    """An InverseDynamicsTool; ``cutoff_hz`` is None where nothing is filtered.

    ``excluded_forces`` are the names that the setup takes out of the model, ``reported_joints`` those whose reactions it
    wants too.
    """

    model_file: Path
    coordinates_file: Path
    loads_file: Path | None
    time_range_s: tuple[float, float]
    cutoff_hz: float | None
    excluded_forces: tuple[str, ...]
    reported_joints: tuple[str, ...]
    output_file: Path


def read_kinematics_setup(path: Path) -> KinematicsSetup:
    """Read the setup of an inverse kinematics.

    Raises:
        InputError: the file can't be read or is no such setup; the message names the element.
    """
    tool, _ = open_document(path, "InverseKinematicsTool")
    return KinematicsSetup(
        model_file=required_file(tool, "model_file", path),
        marker_file=required_file(tool, "marker_file", path),
        tasks=_read_tasks(tool),
        time_range_s=_time_range(tool),
        output_motion_file=optional_file(tool, "output_motion_file", path),
    )


def read_scale_setup(path: Path) -> ScaleSetup:
    """Read the setup of a scaling.

    Raises:
        InputError: the file can't be read or is no such setup; the message names the element.
    """
    tool, _ = open_document(path, "ScaleTool")
    maker, scaler, placer = (_part(tool, tag) for tag in ("GenericModelMaker", "ModelScaler", "MarkerPlacer"))
    if maker is None:
        raise InputError(f"{path.name} names no generic model.", hint="Give it a GenericModelMaker with a model_file.")
    order = words(scaler, "scaling_order") if scaler is not None else []
    mass_kg = number(tool, "mass", -1.0)
    return ScaleSetup(
        name=name_of(tool),
        model_file=required_file(maker, "model_file", path),
        marker_set_file=optional_file(maker, "marker_set_file", path),
        mass_kg=mass_kg if mass_kg > 0 else None,
        measurements=_read_measurements(scaler) if scaler is not None and "measurements" in order else (),
        measured_file=optional_file(scaler, "marker_file", path) if scaler is not None else None,
        measured_range_s=_time_range(scaler) if scaler is not None else _ALWAYS,
        manual_factors=_read_manual_factors(scaler) if scaler is not None and "manualScale" in order else {},
        manual_last=order[-1:] == ["manualScale"],
        preserve_mass_distribution=scaler is not None and flag(scaler, "preserve_mass_distribution", default=False),
        scaled_model_file=optional_file(scaler, "output_model_file", path) if scaler is not None else None,
        scale_set_file=optional_file(scaler, "output_scale_file", path) if scaler is not None else None,
        placing=None if placer is None else _read_placement(placer, path),
    )


def read_dynamics_setup(path: Path) -> DynamicsSetup:
    """Read the setup of an inverse dynamics.

    Raises:
        InputError: the file can't be read or is no such setup; the message names the element.
    """
    tool, _ = open_document(path, "InverseDynamicsTool")
    cutoff_hz = number(tool, "lowpass_cutoff_frequency_for_coordinates", -1.0)
    return DynamicsSetup(
        model_file=required_file(tool, "model_file", path),
        coordinates_file=required_file(tool, "coordinates_file", path),
        loads_file=optional_file(tool, "external_loads_file", path),
        time_range_s=_time_range(tool),
        cutoff_hz=cutoff_hz if cutoff_hz > 0 else None,
        excluded_forces=tuple(words(tool, "forces_to_exclude")),
        reported_joints=tuple(words(tool, "joints_to_report_body_forces")),
        output_file=_result_file(tool, path),
    )


def _result_file(tool: Element, setup: Path) -> Path:
    """Give where OpenSim writes: into the results' folder, whatever folder the file's name has, as .sto unless it says."""
    name = Path(assigned(tool, "output_gen_force_file")).name or "inverse_dynamics"
    folder = setup.parent / assigned(tool, "results_directory")
    return folder / (name if Path(name).suffix else f"{name}.sto")


def write_scale_set(path: Path, bodies: tuple[str, ...], factors: Float[np.ndarray, "body 3"]) -> None:
    """Write the scale factors that were applied, as OpenSim does."""
    document = etree.Element("OpenSimDocument", Version="20303")
    holder = etree.SubElement(etree.SubElement(document, "ScaleSet", name="ScaleSet"), "objects")
    for body, factor in zip(bodies, factors, strict=True):
        scale = etree.SubElement(holder, "Scale")
        etree.SubElement(scale, "scales").text = " ".join(f"{axis:.10g}" for axis in factor)
        etree.SubElement(scale, "segment").text = body
        etree.SubElement(scale, "apply").text = "true"
    etree.indent(document)
    path.write_bytes(etree.tostring(document, xml_declaration=True, encoding="UTF-8"))


def _part(tool: Element, tag: str) -> Element | None:
    """Find one stage of the scale tool, unless it is switched off."""
    found = tool.find(tag)
    return found if found is not None and flag(found, "apply", default=True) else None


def _read_placement(placer: Element, path: Path) -> PlacementSetup:
    return PlacementSetup(
        marker_file=required_file(placer, "marker_file", path),
        tasks=_read_tasks(placer),
        time_range_s=_time_range(placer),
        output_model_file=optional_file(placer, "output_model_file", path),
        output_motion_file=optional_file(placer, "output_motion_file", path),
    )


def _read_tasks(tool: Element) -> TaskSet:
    markers: dict[str, float] = {}
    coordinates: list[CoordinateTask] = []
    for element in objects(tool, "IKTaskSet"):
        weight = number(element, "weight", 1.0)
        if weight < 0:
            raise InputError(f"{describe(element)} has a negative weight.", hint="Give a weight of 0 or more.")
        if not flag(element, "apply", default=True):
            continue
        if element.tag == "IKMarkerTask":
            markers[name_of(element)] = weight
        elif element.tag == "IKCoordinateTask":
            kind = text(element, "value_type", "from_file")
            if kind not in ("default_value", "manual_value"):
                raise InputError(
                    f"{describe(element)} takes its value {kind}.",
                    hint="gonio honours default_value and manual_value; set one of them, or <apply> to false.",
                )
            value = number(element, "value", 0.0) if kind == "manual_value" else None
            coordinates.append(CoordinateTask(name_of(element), weight, value))
        else:
            raise InputError(f"{describe(element)} is a task that gonio does not know.", hint="Set <apply> to false.")
    return TaskSet(markers, tuple(coordinates))


def _read_measurements(scaler: Element) -> tuple[Measurement, ...]:
    """Read the measurements; one that scales bodies along different axes becomes several of the same pairs."""
    found: list[Measurement] = []
    for element in objects(scaler, "MeasurementSet"):
        if not flag(element, "apply", default=True):
            continue
        pairs = [tuple(words(pair, "markers")) for pair in objects(element, "MarkerPairSet")]
        if not pairs or any(len(pair) != 2 for pair in pairs):
            raise InputError(f"{describe(element)} has no pairs of markers.", hint="Give MarkerPairs of two names.")
        for scale in objects(element, "BodyScaleSet"):
            axes = "".join(words(scale, "axes")).upper()
            found.append(
                Measurement(
                    name=f"{name_of(element)} of {name_of(scale)}",
                    pairs=tuple((pair[0], pair[1]) for pair in pairs),
                    bodies=(name_of(scale),),
                    axes=axes,
                )
            )
    return tuple(found)


def _read_manual_factors(scaler: Element) -> dict[str, tuple[float, float, float]]:
    factors: dict[str, tuple[float, float, float]] = {}
    for element in objects(scaler, "ScaleSet"):
        if flag(element, "apply", default=True):
            x, y, z = vector(element, "scales", (1.0, 1.0, 1.0))
            factors[text(element, "segment")] = (float(x), float(y), float(z))
    return factors


def _time_range(tool: Element) -> tuple[float, float]:
    given = [word.lower() for word in words(tool, "time_range")]
    if not given or any(word.strip("-+") in ("inf", "infinity", "1.#inf") for word in given):
        return _ALWAYS
    times = numbers(tool, "time_range")
    if len(times) != 2 or times[0] > times[1]:
        raise InputError(
            f"<time_range> of {describe(tool)} is {' '.join(given)[:60]!r}.", hint="Give its start and its end, in s."
        )
    return float(times[0]), float(times[1])
