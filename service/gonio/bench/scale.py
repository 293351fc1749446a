"""Scaling: agreement with OpenSim 4.6's ScaleTool on its own Gait2354 example, where it lies in ``../shared/data``."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gonio.bench import Bench
from gonio.bench.peers import peer_python, run_in_peer
from gonio.bench.recordings import GAIT2354, need
from gonio.errors import GonioError
from gonio.formats.osim import read_osim
from gonio.formats.osim_xml import open_document, text, vector
from gonio.pipeline.opensim_tools import run_scale
from gonio.records import BodyModel

SETUP = "subject01_Setup_Scale.xml"
FACTORS = "subject01_scaleSet_applied.xml"
SCALED = "subject01_scaledOnly.osim"


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("scale")
    try:
        _compare_with_opensim(bench, build_dir)
    except GonioError as error:
        bench.leave_out("max_*_diff", error)
    return bench.to_json()


def _compare_with_opensim(bench: Bench, build_dir: Path) -> None:
    """Run both on copies of the example, and compare the factors and the scaled models' masses and inertias."""
    need(GAIT2354)
    python = peer_python(build_dir, "opensim", "opensim==4.6")
    ours, theirs = (_copy_example(build_dir.resolve() / "bench" / f"scale_{name}") for name in ("gonio", "opensim"))
    run_scale(ours / SETUP)
    run_in_peer(python, "opensim_scale", theirs / SETUP)
    own, other = _read_factors(ours / FACTORS), _read_factors(theirs / FACTORS)
    shared = [body for body in own if body in other]
    # OpenSim writes six digits: 5e-6 of 1.1.
    bench.add("max_scale_factor_diff", max(np.abs(own[b] - other[b]).max() for b in shared), "1", at_most=1e-4)
    bench.add("max_mass_diff_kg", _largest(ours, theirs, lambda m: m.bodies.mass_kg), "kg", at_most=1e-6)
    bench.add(
        "max_inertia_diff_kgm2", _largest(ours, theirs, lambda m: m.bodies.inertia_body_kgm2), "kg m2", at_most=1e-6
    )


def _copy_example(folder: Path) -> Path:
    """Copy the example's files: the tools write beside the setup."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in GAIT2354.glob("*.*"):
        shutil.copyfile(path, folder / path.name)
    return folder


def _read_factors(path: Path) -> dict[str, np.ndarray]:
    """Read the factors that were applied, by body."""
    scales, _ = open_document(path, "ScaleSet")
    return {text(scale, "segment"): vector(scale, "scales", (1.0, 1.0, 1.0)) for scale in scales.iter("Scale")}


def _largest(ours: Path, theirs: Path, quantity: Callable[[BodyModel], np.ndarray]) -> float:
    """Give the largest difference of a quantity between the two scaled models."""
    models: list[BodyModel] = [read_osim(folder / SCALED) for folder in (ours, theirs)]
    return float(np.abs(quantity(models[0]) - quantity(models[1])).max())
