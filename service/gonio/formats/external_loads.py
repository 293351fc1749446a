"""OpenSim's ExternalLoads: which columns of a table of forces push on which body.

The table itself is a ``.mot`` or ``.sto`` file, see :mod:`gonio.formats.mot`; each of force, point and torque is three columns
of it whose names are an identifier and x, y or z.
"""

from dataclasses import dataclass
from pathlib import Path

from gonio.errors import InputError
from gonio.formats.osim_xml import Element, assigned, describe, flag, name_of, open_document, required_file, text


@dataclass(frozen=True)
class ExternalForce:
    """One ExternalForce: columns of the data file whose names are identifier + x, y, z; empty where there are none."""

    name: str
    body: str
    force_expressed_in: str
    point_expressed_in: str
    force: str
    point: str
    torque: str


@dataclass(frozen=True)
class ExternalLoads:
    """An ExternalLoads file: the forces and the file that holds their data."""

    data_file: Path
    forces: tuple[ExternalForce, ...]


def read_external_loads(path: Path) -> ExternalLoads:
    """Read which columns of which file push on which body; forces that are switched off are left out.

    Raises:
        InputError: the file can't be read or is no such file, or a force has no body or no columns.
    """
    loads, _ = open_document(path, "ExternalLoads")
    forces: list[ExternalForce] = []
    for element in loads.iter("ExternalForce"):
        if flag(element, "isDisabled", default=False) or not flag(element, "appliesForce", default=True):
            continue
        identifiers = [assigned(element, f"{kind}_identifier") for kind in ("force", "point", "torque")]
        if not assigned(element, "applied_to_body") or not any((identifiers[0], identifiers[2])):
            raise InputError(
                f"{describe(element)} has no body, or neither force nor torque.",
                hint="Give applied_to_body, force_identifier and point_identifier.",
            )
        forces.append(
            ExternalForce(
                name_of(element),
                *(
                    _body_of(element, f"{what}_body")
                    for what in ("applied_to", "force_expressed_in", "point_expressed_in")
                ),
                *identifiers,
            )
        )
    return ExternalLoads(data_file=required_file(loads, "datafile", path), forces=tuple(forces))


def _body_of(element: Element, tag: str) -> str:
    """Read a body's name, or the last part of its path (``/bodyset/calcn_r``); the ground where there is none."""
    return text(element, tag, "ground").rsplit("/", 1)[-1]
