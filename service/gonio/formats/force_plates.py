"""Read what force plates measured, from C3D (plate types 1 to 4) or from OpenSim's tables (``.mot``, ``.sto``)."""

from pathlib import Path

import numpy as np

from gonio.errors import InputError
from gonio.formats.c3d import LEAST_N, read_c3d
from gonio.formats.mot import Table, read_mot
from gonio.records import ForcePlates


def read_force_plates(path: Path, name: str = "") -> ForcePlates:
    """Read the force plates of a trial, by its name's suffix.

    Raises:
        InputError: what :func:`gonio.formats.c3d.read_c3d` or :func:`gonio.formats.mot.read_mot` say, or ``plates-missing``
            where the file tells of no plate.
    """
    name = name or path.name
    plates = read_c3d(path, name).plates if name.lower().endswith(".c3d") else plates_of_table(read_mot(path), name)
    if plates is None:
        raise InputError(
            f"{name} holds no force plates.",
            hint="Export the trial with its analog data; a table needs columns such as ground_force_vx, ground_force_px "
            "and ground_torque_x.",
            code="plates-missing",
        )
    return plates


def plates_of_table(table: Table, name: str) -> ForcePlates | None:
    """Find the forces of an OpenSim table by its columns' names: ``…_vx``, ``…_px`` and, with torque for force, ``…x``.

    None if there is none. OpenSim's tables are in newtons and metres, Y up, and hold the force on the body.
    """
    stems = [label.removesuffix("vx") for label in table.labels if label.endswith("vx") and "force" in label.lower()]
    force, place, moment = [], [], []
    for stem in stems:
        force.append(np.stack([table.of(f"{stem}v{axis}") for axis in "xyz"], axis=-1))
        place.append(np.stack([table.of(f"{stem}p{axis}") for axis in "xyz"], axis=-1))
        twist = stem.replace("force", "torque").replace("Force", "Torque")
        moment.append(table.of(f"{twist}y") if f"{twist}y" in table.labels else np.zeros(len(table.times_s)))
    if not stems:
        return None
    force_n, cop_m = np.stack(force, axis=1), np.stack(place, axis=1)
    return ForcePlates(
        source=name,
        times_s=table.times_s,
        force_lab_n=force_n,
        cop_lab_m=np.where(force_n[..., 1:2] > LEAST_N, cop_m, np.nan),
        free_moment_nm=np.where(force_n[..., 1] > LEAST_N, np.stack(moment, axis=1), 0.0),
        corners_lab_m=np.full((len(stems), 4, 3), np.nan),
    )
