# pyright: basic, reportMissingImports=false
"""Runs in Pose2Sim's environment: its steps after the keypoints on one trial, each timed.

Usage: pose2sim_points.py TRIAL.npz FOLDER STEP...

TRIAL.npz holds ``keypoint_names`` (BODY_25B), ``uv_px`` (camera, frame, keypoint, 2; NaN missing), ``confidence``,
``rate_hz``, ``size_px``, ``intrinsic_px``, ``distortion`` and ``T_cam_lab`` (camera, 4, 4), in a lab with Y up. Writes
``points.npz`` (``raw`` and, after filtering, ``filtered``, frame × keypoint × 3, in the same lab, with ``raw_names`` and
``filtered_names``) and ``times.json`` (seconds of each step, the clock's and the processor's, and of the bare triangulation
without its files) into the folder.
"""

import json
import os
import shutil
import sys
import time
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import Pose2Sim
from Pose2Sim import Pose2Sim as Steps
from Pose2Sim import triangulation

mpl.use("Agg")

TO_Z_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Pose2Sim's lab has Z up, and its files give (y, z, x) of it: with this they are in our axes."""


def main(trial: str, out: str, *steps: str) -> None:
    """Run the steps one after the other, and write what came out."""
    data, folder = np.load(trial), Path(out)
    shutil.rmtree(folder, ignore_errors=True)
    config = write_project(data, folder)
    bare = [0.0, 0.0]
    triangulation.triangulation_from_best_cameras = timed(triangulation.triangulation_from_best_cameras, bare)
    times = {}
    for step in steps:
        times[step] = [0.0, 0.0]
        timed(getattr(Steps, step), times[step])(config)
    times["bare_triangulation"] = bare
    files = sorted((folder / "pose-3d").glob("*.trc"))
    found = {}
    for file in files:
        if "LSTM" not in file.name:
            kind = "filtered" if "filt" in file.name else "raw"
            found[f"{kind}_names"], found[kind] = read_trc(file)
    np.savez(folder / "points.npz", **found)
    (folder / "times.json").write_text(json.dumps(times))


def timed(work, total):  # noqa: ANN001, ANN201 - any function, as it came
    """Count the seconds that a function takes."""

    def run(*arguments, **named):  # noqa: ANN002, ANN003, ANN202 - any function
        start, start_cpu = time.perf_counter(), cpu_s()
        found = work(*arguments, **named)
        total[0] += time.perf_counter() - start
        total[1] += cpu_s() - start_cpu
        return found

    return run


def cpu_s() -> float:
    """Give the processor's seconds of this process and of those that it has ended: OpenSim's tools run in some."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def write_project(data, folder: Path) -> dict:  # noqa: ANN001 - an npz file
    """Write the keypoints and the calibration as Pose2Sim has them, and give its own demo's settings for them."""
    (folder / "calibration").mkdir(parents=True)
    lines = []
    for number, T in enumerate(data["T_cam_lab"]):
        rotation = cv2.Rodrigues(T[:3, :3] @ TO_Z_UP.T)[0].ravel()
        lines += [
            f"[cam{number + 1:02d}]",
            f'name = "cam{number + 1:02d}"',
            f"size = {data['size_px'][number].astype(float).tolist()}",
            f"matrix = {data['intrinsic_px'][number].tolist()}",
            f"distortions = {data['distortion'][number][:4].tolist()}",
            f"rotation = {rotation.tolist()}",
            f"translation = {T[:3, 3].tolist()}",
            "fisheye = false",
            "",
        ]
        poses = folder / "pose" / f"cam{number + 1:02d}_json"
        poses.mkdir(parents=True)
        seen = np.nan_to_num(np.concatenate([data["uv_px"][number], data["confidence"][number][..., None]], axis=-1))
        for frame, found in enumerate(seen if seen.ndim == 4 else seen[:, None]):
            rows = found if seen.ndim == 3 else [person for person in found if person[:, 2].any()]
            people = [{"person_id": [-1], "pose_keypoints_2d": person.ravel().tolist()} for person in rows]
            (poses / f"cam{number + 1:02d}.{frame:06d}.json").write_text(json.dumps({"version": 1.3, "people": people}))
    (folder / "calibration" / "Calib.toml").write_text("\n".join(lines))
    text = (Path(str(Pose2Sim.__file__)).parent / "Demo_SinglePerson" / "Config.toml").read_text(encoding="utf-8")
    (folder / "Config.toml").write_text(text, encoding="utf-8")
    config = Steps.read_config_files(str(folder))[1][0]
    config["project"] |= {"project_dir": str(folder), "frame_rate": float(data["rate_hz"]), "frame_range": "all"}
    config["pose"]["pose_model"] = "BODY_25B"
    config["filtering"] |= {"display_figures": False, "save_filt_plots": False}
    return config


def read_trc(path: Path) -> tuple[list[str], np.ndarray]:
    """Give the markers' names and places."""
    lines = path.read_text().splitlines()
    names = [name for name in lines[3].split("\t")[2:] if name]
    rows = [[float(v) if v else np.nan for v in line.split("\t")[2:]] for line in lines[5:] if line.strip()]
    return names, np.array(rows)[:, : 3 * len(names)].reshape(len(rows), -1, 3)


if __name__ == "__main__":
    main(*sys.argv[1:])
