"""Outliers that last: the same spoiled keypoints for gonio, Pose2Sim and aniposelib, against the points that made them.

The truth is Pose2Sim's own filtered trajectory of the balancing trial, projected by the trial's calibration without its lens
distortion, which Pose2Sim does not undo. That truth was low-passed at 6 Hz, which favours whoever does the same, and its limbs
stretch by 3 to 9 %, which no body's do: ``free`` is gonio without holding their lengths.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.points.chain import choose, find_points
from gonio.bench.points.rivals import (
    CARD,
    MIN_CONFIDENCE,
    Rivals,
    open_rivals,
    run_aniposelib,
    run_pose2sim,
    write_trial,
)
from gonio.bench.realism import read_balancing
from gonio.formats.markerset import read_markerset
from gonio.kernel.virtual_lab import PRESETS, Effects
from gonio.kernel.virtual_lab.keypoints import detect, read_anatomy
from gonio.records import ImagePoints, Rig, Timebase

SEEDS = {"burst": 5, "clean": 3}
SIGMA_M = 0.0102
"""The scatter at the usual confidence, with which Pose2Sim's filtered points are 5.5 mm off where there are no outliers."""

RATE_HZ = 60.0

Truth = Float[np.ndarray, "frame keypoint 3"]


def measure_outliers(bench: Bench, build_dir: Path) -> None:
    """Measure the mean and the 95th percentile of the points' errors, mm, medians over the seeds.

    ``burst``: 13 % of the observations lie 40 to 150 px off for 5 to 20 frames, in 40 % of these bursts with full confidence;
    3 % are missing. ``clean``: without the bursts. ``per_frame`` is gonio without fusion over time.

    Raises:
        ResourceError: the recording or a rival is out of reach.
    """
    recorded_rig, recorded = read_balancing()
    rivals = open_rivals(build_dir)
    folder = build_dir / "bench" / "outliers"
    straight = tuple(replace(camera, distortion=np.zeros(5)) for camera in recorded_rig.cameras)
    rig = replace(recorded_rig, cameras=straight)
    names = recorded.keypoint_names
    first = run_pose2sim(rivals, write_trial(folder / "recorded.npz", rig, recorded), folder / "recorded", names)
    truth = first.filtered[:-1]  # its filter loses the last frame
    for kind, seeds in SEEDS.items():
        effects = _effects(kind)
        errors: dict[str, list[Float[np.ndarray, " measure"]]] = {}
        for seed in range(seeds):
            spoiled = _spoil(rig, truth, names, effects, seed)
            for who, xyz in _solve(rig, spoiled, rivals, folder).items():
                errors.setdefault(who, []).append(_errors(xyz, truth))
        for who, values in errors.items():
            mean_mm, p95_mm, missing_pct = np.median(values, axis=0)
            suffix = f"_{who}" if who else ""
            worst = _WORST.get((kind, who), (None, None))
            bench.add(f"{kind}_mean_mm{suffix}", mean_mm, "mm", at_most=worst[0])
            bench.add(f"{kind}_p95_mm{suffix}", p95_mm, "mm", at_most=worst[1])
            bench.add(f"{kind}_missing{suffix}_pct", missing_pct, "%")


_WORST = {("burst", ""): (8.0, 18.0), ("clean", ""): (5.8, None)}


def _effects(kind: str) -> Effects:
    bursts = PRESETS["bursts"]
    assert bursts.detector is not None  # it is what they are about
    bursts = replace(bursts, detector=replace(bursts.detector, sigma_m=SIGMA_M))
    return bursts if kind == "burst" else replace(bursts, bursts=None, dropouts=0.0)


def _spoil(rig: Rig, truth: Truth, names: tuple[str, ...], effects: Effects, seed: int) -> ImagePoints:
    """Make keypoints of the true points."""
    anatomy, unhidden = read_anatomy(read_markerset(CARD)), np.zeros(truth.shape[:2], dtype=bool)
    order = [read_markerset(CARD).keypoint_names.index(name) for name in names]
    in_card_order = np.empty_like(truth)
    in_card_order[:, order] = truth
    seen = [
        detect(camera, number, in_card_order, unhidden, anatomy, effects, rate_hz=RATE_HZ, seed=seed)
        for number, camera in enumerate(rig.cameras)
    ]
    return ImagePoints(
        camera_names=rig.names,
        keypoint_names=names,
        timebase=Timebase(rate_hz=RATE_HZ),
        uv_px=np.stack([one.uv_px for one in seen])[:, :, order],
        confidence=np.stack([one.confidence for one in seen])[:, :, order],
    )


def _solve(rig: Rig, points: ImagePoints, rivals: Rivals, folder: Path) -> dict[str, Truth]:
    """Give everybody's points."""
    names = points.keypoint_names
    trial = write_trial(folder / "trial.npz", rig, points)
    theirs = run_pose2sim(rivals, trial, folder / "pose2sim", names)
    fused = find_points(points, rig, choose(min_confidence=MIN_CONFIDENCE).reconstruction)
    chosen = choose(min_confidence=MIN_CONFIDENCE, smoothing="median", cutoff_hz=6.0).reconstruction
    single = find_points(points, rig, chosen)
    return {
        "": fused.turned_back(fused.smooth).xyz_lab_m,
        "free": fused.turned_back(fused.free).xyz_lab_m,
        "per_frame": single.turned_back(single.smooth).xyz_lab_m,
        "pose2sim": theirs.filtered,
        "aniposelib": run_aniposelib(rivals, trial, folder / "aniposelib.npz", names)[0],
    }


def _errors(xyz: Truth, truth: Truth) -> Float[np.ndarray, " measure"]:
    """Give the mean and the 95th percentile of the errors, mm, and the share of points that are missing, per cent."""
    error = np.linalg.norm(xyz - truth, axis=-1)[:-1]  # Pose2Sim lacks the last frame
    there = np.isfinite(truth[:-1, :, 0])
    known = error[there & np.isfinite(error)]
    return np.array([1e3 * known.mean(), 1e3 * np.quantile(known, 0.95), 100 * np.isnan(error[there]).mean()])
