"""Do the points' 95 % ellipsoids hold the truth, by number of cameras and by joint?"""

from dataclasses import replace

import numpy as np
import pytest

from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.geometry.transforms import apply
from gonio.kernel.virtual_lab import PRESETS, film, make_rig, walk
from gonio.pipeline.params import ReconstructionParameters
from gonio.pipeline.reconstruction import hold_lengths, reconstruct, smooth
from gonio.records import VirtualTrial
from gonio.resources import models_dir

CHI2_3_95 = 7.815
LEG = ("hip", "knee", "ankle", "heel", "big_toe")


@pytest.fixture(scope="module")
def trials() -> list[VirtualTrial]:
    walker = walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.2, start_m=-1.5)
    card = read_markerset(models_dir() / "markersets" / "halpe26.toml")
    return [film(walker, make_rig(), card, effects=PRESETS["occluded"], rate_hz=60.0, seed=seed) for seed in range(3)]


def inside(trial: VirtualTrial, cameras: int) -> np.ndarray:
    """Whether the truth lies in each point's ellipsoid, (frame, keypoint); NaN where there is no point."""
    seen = trial.points
    keypoints = replace(
        seen, camera_names=seen.camera_names[:cameras], uv_px=seen.uv_px[:cameras], confidence=seen.confidence[:cameras]
    )
    rig = replace(trial.rig, cameras=trial.rig.cameras[:cameras])
    chosen = ReconstructionParameters()
    raw = reconstruct(keypoints, rig, chosen).value
    points = hold_lengths(smooth(keypoints, raw, chosen).value, chosen)
    T_turned_lab = raw.rig.cameras[0].T_lab_cam @ np.linalg.inv(rig.cameras[0].T_lab_cam)
    error = points.xyz_lab_m - apply(T_turned_lab, trial.seen_lab_m)
    known = np.isfinite(error).all(axis=-1)
    distance = np.full(known.shape, np.nan)
    distance[known] = np.einsum("ni,nij,nj->n", error[known], np.linalg.inv(points.covariance_m2[known]), error[known])
    return np.where(known, distance < CHI2_3_95, np.nan)


@pytest.mark.parametrize("cameras", [2, 3, 4])
def test_ellipsoids_hold_the_truth(trials: list[VirtualTrial], cameras: int) -> None:
    held = np.concatenate([inside(trial, cameras) for trial in trials])
    assert 0.92 < np.nanmean(held) < 0.985
    names = trials[0].points.keypoint_names
    for joint in LEG:
        # Three short trials hold some twenty independent moments of each joint: the share scatters by 4 %.
        both_sides = held[:, [names.index(f"{side}_{joint}") for side in ("left", "right")]]
        assert np.nanmean(both_sides) > 0.85, joint
