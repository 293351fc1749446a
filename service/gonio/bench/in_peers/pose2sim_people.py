# pyright: basic, reportMissingImports=false
"""Runs in Pose2Sim's environment: its association and triangulation of several people.

Usage: pose2sim_people.py TRIAL.npz FOLDER

TRIAL.npz is that of ``pose2sim_points.py``, but ``uv_px`` (camera, frame, place, keypoint, 2) and ``confidence`` have places
for several people. Writes ``people.npz`` into the folder: ``people``, and for each its ``names_N``, ``frames_N`` and ``xyz_N``
(frame × keypoint × 3, our lab).
"""

import sys
from pathlib import Path

import numpy as np
from Pose2Sim import Pose2Sim as Steps

sys.path.insert(0, str(Path(__file__).parent))  # isolated Python leaves it out
from pose2sim_points import read_trc, write_project


def main(trial: str, out: str) -> None:
    """Associate, triangulate, and write what came out."""
    folder = Path(out)
    config = write_project(np.load(trial), folder)
    config["project"] |= {"multi_person": True}
    Steps.personAssociation(config)
    Steps.triangulation(config)
    found = {}
    files = sorted((folder / "pose-3d").glob("*.trc"))
    for number, file in enumerate(files):
        found[f"names_{number}"], found[f"xyz_{number}"] = read_trc(file)
        rows = [line.split("\t")[0] for line in file.read_text().splitlines()[5:] if line.strip()]
        found[f"frames_{number}"] = np.array(rows, dtype=int)
    np.savez(folder / "people.npz", people=len(files), **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
