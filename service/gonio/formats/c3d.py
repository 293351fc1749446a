# pyright: standard
"""Read C3D: markers, model outputs, analog signals, events and force plates, in gonio's units and axes.

ezc3d takes the file apart and has no types, which is why this module is checked less strictly. The axes are turned so that
Y is up; the direction of progression is the file's own matter and stays. Everything else is written where it is used.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.c3d_plates import Plate, plate_wrench
from gonio.formats.trc import Trajectories
from gonio.records import ForcePlates, record

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
NEWTON_METRES = {"Nm": 1.0, "N*m": 1.0, "Nmm": 1e-3, "N*mm": 1e-3, "N.mm": 1e-3}
OUTPUT_GROUPS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
Side = Literal["right", "left", ""]
_SIDES: dict[str, Side] = {"right": "right", "left": "left"}
LEAST_N = 10.0
"""Below this vertical force, a plate has no centre of pressure."""


class Event(NamedTuple):
    """Something that was marked in a trial; ``side`` is empty for what concerns both."""

    label: str
    side: Side
    time_s: float


@record
class Outputs:
    """What a model computed and stored as points (Plug-in Gait's angles, moments, powers), in the file's own units."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "frame output 3"]

    def of(self, name: str) -> Float[np.ndarray, "frame 3"]:
        """Give one output by name.

        Raises:
            InputError: there is none of this name.
        """
        if name not in self.names:
            raise InputError(f"The file has no output {name}.", hint=f"It has: {', '.join(self.names)}.")
        return self.values[:, self.names.index(name)]


@record
class Analog:
    """Analog signals in their own units, at their own rate."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    times_s: Float[np.ndarray, " sample"]
    values: Float[np.ndarray, "sample channel"]


@record
class C3d:
    """All that gonio reads of a C3D file. Times are those since the trial began, of which the file may hold a part."""

    source: str
    markers: Trajectories
    outputs: Outputs
    analog: Analog
    events: tuple[Event, ...]
    plates: ForcePlates | None
    mass_kg: float | None


def read_c3d(path: Path, name: str = "") -> C3d:
    """Read a C3D file.

    Raises:
        InputError: ``capture-file-unreadable``: the file can't be read, has no frames, unknown units, or a force plate that is
            none of the types 1 to 4 or lacks its corners, origin, channels or calibration.
    """
    import ezc3d  # takes a tenth of the time in which a worker starts, and few sessions have such a file

    name = name or path.name
    try:
        content = ezc3d.c3d(str(path))
        parameters = _parameters(content)
        _check_length(path, content["data"]["points"].shape[2])
        return _convert(content, parameters, name)
    except InputError as error:
        raise InputError(f"{name}: {error.message}", hint=error.hint, code="capture-file-unreadable") from error
    except Exception as error:  # ezc3d raises whatever its C++ did
        raise InputError(
            f"{name} is no C3D file that can be read: {str(error).strip().splitlines()[:1] or type(error).__name__}.",
            hint="Was it cut short? Export it again.",
            code="capture-file-unreadable",
        ) from error


def _convert(content: Any, parameters: dict[str, dict[str, Any]], name: str) -> C3d:  # noqa: ANN401 - ezc3d has no types
    point, analog = parameters["POINT"], parameters.get("ANALOG", {})
    labels = _labels(point, "LABELS")
    xyz = np.moveaxis(content["data"]["points"][:3], 0, -1).swapaxes(0, 1)[:, : len(labels)]
    if len(xyz) == 0:
        raise InputError("it holds no frames.", hint="Export the trial, not an empty take.")
    outputs = {label for group in OUTPUT_GROUPS for label in _labels(point, group)}
    is_output = np.array([label in outputs for label in labels], dtype=bool)
    up = str(_first(point, "Y_SCREEN", "+Z"))
    R_lab_file = _turn_up(up)
    rate_hz, start = float(content["header"]["points"]["frame_rate"]), content["header"]["points"]["first_frame"]
    scale = _unit(METRES, str(_first(point, "UNITS", "mm")), "POINT:UNITS")
    lab_m = scale * xyz[:, ~is_output] @ R_lab_file.T
    signals = content["data"]["analogs"][0].T
    analog_hz = float(content["header"]["analogs"]["frame_rate"]) or rate_hz
    times_s = start / rate_hz + np.arange(len(signals)) / analog_hz
    markers = Trajectories(
        names=tuple(label for label, computed in zip(labels, is_output, strict=True) if not computed),
        times_s=(start + np.arange(len(xyz))) / rate_hz,
        xyz_m=np.where(np.isfinite(lab_m).all(axis=-1, keepdims=True), lab_m, np.nan),
        rate_hz=rate_hz,
    )
    mass = float(_first(parameters.get("PROCESSING", {}), "Bodymass", np.nan))
    return C3d(
        source=name,
        markers=markers,
        outputs=Outputs(names=tuple(np.array(labels, dtype=str)[is_output].tolist()), values=xyz[:, is_output]),
        analog=Analog(
            names=tuple(_labels(analog, "LABELS"))[: signals.shape[1]],
            units=tuple(_labels(analog, "UNITS"))[: signals.shape[1]],
            times_s=times_s,
            values=signals,
        ),
        events=_events(parameters.get("EVENT", {})),
        plates=_plates(parameters, signals, times_s, R_lab_file, scale, name),
        mass_kg=mass if np.isfinite(mass) and mass > 0 else None,
    )


def _plates(
    parameters: dict[str, dict[str, Any]],
    signals: Float[np.ndarray, "sample channel"],
    times_s: Float[np.ndarray, " sample"],
    R_lab_file: Float[np.ndarray, "3 3"],
    scale: float,
    name: str,
) -> ForcePlates | None:
    """Take the force plates' channels to wrenches in the lab."""
    group = parameters.get("FORCE_PLATFORM", {})
    count = int(_first(group, "USED", 0))
    if count == 0 or len(signals) == 0:
        return None
    needed = ("TYPE", "CORNERS", "ORIGIN", "CHANNEL")
    missing = [entry for entry in needed if np.size(group.get(entry, ())) == 0]
    if missing:
        raise InputError(f"its force plates lack FORCE_PLATFORM:{missing[0]}.", hint="Export it with its force plates.")
    units = _labels(parameters["ANALOG"], "UNITS")
    calibrations = np.asarray(group.get("CAL_MATRIX", ()), dtype=float)
    force, cop, free, corners = [], [], [], []
    for index in range(count):
        channels = np.asarray(group["CHANNEL"], dtype=int)[:, index] - 1
        kind = int(group["TYPE"][index])
        channels = channels[: 8 if kind == 3 else 6]
        if channels.min() < 0 or channels.max() >= signals.shape[1]:
            raise InputError(f"force plate {index + 1} names a channel that is not there.", hint="Export it again.")
        moment_unit = units[channels[-1]] if kind in (1, 2) and len(units) > channels[-1] else ""
        plate = Plate(
            kind=kind,
            corners_m=scale * np.asarray(group["CORNERS"], dtype=float)[:, :, index].T,
            origin_m=scale * np.asarray(group["ORIGIN"], dtype=float)[:, index],
            moment_scale=NEWTON_METRES.get(moment_unit, scale),  # without a unit, moments have the points' lengths
            length_scale=scale,
            calibration=calibrations[:, :, index] if calibrations.size else None,
        )
        plate_force, plate_cop, plate_free = plate_wrench(plate, signals[:, channels], LEAST_N)
        force.append(plate_force @ R_lab_file.T)
        cop.append(plate_cop @ R_lab_file.T)
        free.append(plate_free)
        corners.append(plate.corners_m @ R_lab_file.T)
    return ForcePlates(
        source=name,
        times_s=times_s,
        force_lab_n=np.stack(force, axis=1),
        cop_lab_m=np.stack(cop, axis=1),
        free_moment_nm=np.stack(free, axis=1),
        corners_lab_m=np.stack(corners),
    )


def _events(group: dict[str, Any]) -> tuple[Event, ...]:
    """List the events by time; their times stand as minutes and seconds, or flat as seconds."""
    labels, contexts = _labels(group, "LABELS"), _labels(group, "CONTEXTS")
    times = np.asarray(group.get("TIMES", ()), dtype=float)
    if times.ndim == 2:
        seconds = 60.0 * times[0] + times[1]
    else:
        seconds = times.reshape(-1, 2) @ [60.0, 1.0] if times.size == 2 * len(labels) else times
    found = [
        Event(label, _SIDES.get(context.strip().lower(), ""), float(time_s))
        for label, context, time_s in zip(labels, contexts, seconds, strict=False)
    ]
    return tuple(sorted(found, key=lambda event: event.time_s))


def _turn_up(up: str) -> Float[np.ndarray, "3 3"]:
    """Give R_lab_file for a file whose upward axis is ``+Z``, ``+Y``, …: its first level axis becomes the lab's X."""
    sign, axis = (-1.0 if up.startswith("-") else 1.0), "XYZ".find(up[-1:].upper() or "Z")
    if axis < 0:
        raise InputError(f"its upward axis is {up!r}.", hint="Set POINT:Y_SCREEN to the axis that points upwards.")
    vertical, level = sign * np.eye(3)[axis], np.eye(3)[0 if axis else 1]
    return np.stack([level, vertical, np.cross(level, vertical)])


def _check_length(path: Path, frames: int) -> None:
    """Refuse a file that holds fewer frames than its header promises: ezc3d takes what is there."""
    with path.open("rb") as file:
        first, last = np.frombuffer(file.read(10)[6:], dtype="<u2").tolist()
    if first <= last < 65535 and frames < last - first + 1:  # more frames than that don't fit the header
        raise InputError(
            f"it holds {frames} of the {last - first + 1} frames that its header promises.",
            hint="Was it cut short? Export it again.",
        )


def _parameters(content: Any) -> dict[str, dict[str, Any]]:  # noqa: ANN401 - ezc3d has no types
    """Give the parameters' values by group and name."""
    return {
        group: {key: entry["value"] for key, entry in entries.items() if not key.startswith("__")}
        for group, entries in content["parameters"].items()
        if not group.startswith("__")
    }


def _labels(group: dict[str, Any], key: str) -> list[str]:
    """Give a list of texts, with its continuations (LABELS2, LABELS3, … of files with more than 255 points)."""
    found: list[str] = [str(label).strip() for label in group.get(key, ())]
    more = 2
    while f"{key}{more}" in group:
        found += [str(label).strip() for label in group[f"{key}{more}"]]
        more += 1
    return found


def _first(group: dict[str, Any], key: str, default: Any) -> Any:  # noqa: ANN401 - a parameter is of any type
    values = group.get(key, ())
    return values[0] if len(values) else default


def _unit(table: dict[str, float], unit: str, where: str) -> float:
    if unit.strip() not in table:
        raise InputError(f"{where} is {unit!r}.", hint=f"Known are {', '.join(table)}.")
    return table[unit.strip()]
