"""The virtual laboratory against recordings of real people: the same numbers, taken in the same way from both.

Recordings, where they lie in ``../shared/data``: the four-camera balancing trial with OpenPose's keypoints (the scatter of
keypoints), and OpenSim's Gait2354 example with two force plates (ground forces, moments). The figures are discussed in
docs/validation/virtual-lab.md.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.recordings import BALANCING, GAIT2354, need
from gonio.errors import GonioError
from gonio.formats.calibration import read_calibration
from gonio.formats.markerset import read_markerset
from gonio.formats.mot import read_mot
from gonio.formats.openpose import BODY_25B, PoseFile, gonio_names, read_poses
from gonio.formats.osim import read_osim
from gonio.kernel.calibration.person import refine_on_person
from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.smoothing.filters import low_pass, median_filter
from gonio.kernel.triangulation.points import triangulate
from gonio.kernel.virtual_lab import PRESETS, Detector, Effects, SelfOcclusion, film, make_rig, truth_at, walk
from gonio.records import ImagePoints, Rig, Timebase
from gonio.resources import models_dir

_SEGMENTS = (("hip", "knee"), ("knee", "ankle"), ("elbow", "wrist"), ("shoulder", "elbow"), ("heel", "big_toe"))
LIMBS = [(f"{side}_{start}", f"{side}_{end}") for side in ("left", "right") for start, end in _SEGMENTS]
SEEDS = 5
SIGHT_M = 0.06  # residuals beyond five standard deviations of a good keypoint: another place, no scatter
WEIGHT = 9.80665

_BOUNDS = {
    # The virtual numbers must stay within a third of the recording's, where it is the recording that set them.
    ("ordinary", "confidence_median"): (0.5, 0.75),
    ("ordinary", "residual_median_mm"): (9.0, 18.0),
    ("ordinary", "bias_median_mm"): (5.5, 10.5),
    ("ordinary", "sigma_at_095_mm"): (7.5, 15.0),
    ("ordinary", "sigma_at_130_mm"): (5.5, 10.5),
}


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("realism")
    try:
        _compare_keypoints(bench)
    except GonioError as error:
        bench.leave_out("keypoints_*", error)
    try:
        _compare_forces(bench)
    except GonioError as error:
        bench.leave_out("walk_*", error)
    return bench.to_json()


def _compare_keypoints(bench: Bench) -> None:
    rig, points = read_balancing()
    real = measure_keypoints(refine_on_person(rig, points, 0.3).rig, points)
    # Cameras like the recording's, upright pictures of 1088 × 1920 from 4 m away, around a man who walks through.
    cameras = make_rig(4, radius_m=4.0, height_m=1.2, image_size_px=(1088, 1920), focal_px=1680.0)
    walker = walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.2, start_m=-1.0)
    card = read_markerset(models_dir() / "markersets" / "body25b.toml")
    ordinary = Effects(detector=Detector(bias_m=0.008), occlusion=SelfOcclusion())
    for kind, effects in (("real", None), ("ordinary", ordinary), ("mismatch", PRESETS["mismatch"])):
        measured = [real]
        if effects is not None:
            trials = [film(walker, cameras, card, effects=effects, rate_hz=60.0, seed=seed) for seed in range(SEEDS)]
            measured = [measure_keypoints(refine_on_person(t.rig, t.points, 0.3).rig, t.points) for t in trials]
        for name in real:
            unit = name.rsplit("_", 1)[-1] if name.endswith(("_mm", "_pct")) else "1"
            low, high = _BOUNDS.get((kind, name), (None, None))
            value = float(np.median([one[name] for one in measured]))
            bench.add(f"keypoints_{kind}_{name}", value, unit, at_least=low, at_most=high)


def read_balancing() -> tuple[Rig, ImagePoints]:
    """Read OpenPose's keypoints of the subject: the largest person of the first frame, then always the nearest.

    Raises:
        ResourceError: the recording is not there.
    """
    need(BALANCING)
    rig = read_calibration(BALANCING / "calibration" / "Calib.qca.txt")
    tracks = [
        _follow(read_poses(folder, "body25b")) for folder in sorted((BALANCING / "body25b_json/balancing").iterdir())
    ]
    found = np.stack(tracks)
    confidence = found[..., 2].copy()
    uv_px = np.where(confidence[..., None] > 0, found[..., :2], np.nan)
    return rig, ImagePoints(
        camera_names=rig.names,
        keypoint_names=gonio_names(BODY_25B),
        timebase=Timebase(rate_hz=60.0),
        uv_px=uv_px,
        confidence=confidence,
    )


def _follow(poses: PoseFile) -> Float[np.ndarray, "frame keypoint 3"]:
    """Follow the tallest person of the first frame; what was not found is 0, 0, 0."""
    track: list[np.ndarray] = []
    everybody = np.concatenate([np.nan_to_num(poses.uv_px), poses.confidence[..., None]], axis=-1)
    for frame in everybody:
        people = [person for person in frame if person.any()]
        if track:
            track.append(min(people, key=lambda person: _distance(person, track[-1])))
        else:
            track.append(max(people, key=lambda person: np.ptp(person[person[:, 2] > 0.3, 1])))
    return np.array(track, dtype=float)


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    both = (one[:, 2] > 0.3) & (other[:, 2] > 0.3)
    return float(np.median(np.linalg.norm(one[both, :2] - other[both, :2], axis=1))) if both.any() else np.inf


def measure_keypoints(rig: Rig, points: ImagePoints) -> dict[str, float]:
    """Measure the scatter of keypoints about the robust, smoothed reconstruction from all cameras; NaN is: no such keypoint."""
    cameras, frames, keypoints, _ = points.uv_px.shape
    confidence = np.where(points.confidence > 0.1, points.confidence, 0.0)
    solved = triangulate(
        projection_matrices(rig),
        focal_lengths_px(rig),
        undistort_rig(rig, points.uv_px).reshape(cameras, -1, 2),
        confidence.reshape(cameras, -1),
    )
    xyz = solved.xyz_lab_m.reshape(frames, keypoints, 3)
    xyz = low_pass(median_filter(xyz, 5), points.timebase.rate_hz, 6.0)
    depth = np.stack([(xyz - camera.centre_lab_m) @ camera.T_lab_cam[:3, 2] for camera in rig.cameras])
    residual = points.uv_px - np.stack([project(camera, xyz) for camera in rig.cameras])
    residual *= (depth / focal_lengths_px(rig)[:, None, None])[..., None]  # metres at the person
    size = np.linalg.norm(residual, axis=-1)
    seen = np.isfinite(size)
    tracked = seen.sum(axis=1) > frames / 2
    bias = np.full((cameras, keypoints, 2), np.nan)
    for camera, keypoint in zip(*np.nonzero(tracked), strict=True):
        bias[camera, keypoint] = np.nanmedian(residual[camera, :, keypoint], axis=0)
    scatter = residual - np.nan_to_num(bias)[:, None]
    away = np.linalg.norm(scatter, axis=-1)
    measured = {
        "confidence_median": float(np.median(points.confidence[seen])),
        "confidence_p10": float(np.quantile(points.confidence[seen], 0.1)),
        "residual_median_mm": 1e3 * float(np.median(size[seen])),
        "far_off_pct": 100.0 * float((size[seen] > SIGHT_M).mean()),
        "bias_median_mm": 1e3 * float(np.nanmedian(np.linalg.norm(bias, axis=-1))),
    }
    for low, high in ((0.2, 0.4), (0.4, 0.55), (0.6, 0.7)):
        chosen = seen & (points.confidence > low) & (points.confidence < high)
        # The median length of a normal vector in the plane is 1.177 standard deviations of an axis.
        sigma_m = float(np.median(away[chosen])) / 1.177 if chosen.any() else np.nan
        measured[f"sigma_at_{low + high:.2f}_mm".replace(".", "")] = 1e3 * sigma_m
    inlier = np.where((away < SIGHT_M)[..., None], scatter, np.nan)
    for lag in (1, 5, 10):
        product = inlier[:, lag:] * inlier[:, :-lag]
        measured[f"correlation_{round(1000 * lag / points.timebase.rate_hz)}ms"] = float(
            np.nanmean(product) / np.nanmean(inlier**2)
        )
    ends = [(points.keypoint_names.index(a), points.keypoint_names.index(b)) for a, b in LIMBS]
    lengths = np.stack([np.linalg.norm(xyz[:, a] - xyz[:, b], axis=-1) for a, b in ends])
    variation = np.nanstd(lengths, axis=1) / np.nanmean(lengths, axis=1)
    measured["limb_variation_median_pct"] = 100.0 * float(np.median(variation))
    return measured


def _compare_forces(bench: Bench) -> None:
    need(GAIT2354)
    real = _measure_plates()
    walker = walk(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.2)
    truth = truth_at(walker, (1.0 + np.arange(500) / 500) * walker.steps.stride_s)
    mass = walker.body.mass_kg
    moments = {joint: truth.moment_of(name) / mass for joint, name in _JOINTS.items()}
    moments["knee"] = -moments["knee"]  # Gait2354 counts flexion of the knee as negative
    made = _peaks(truth.wrench[:, 0, :3] / (mass * WEIGHT), moments)
    for name, value in real.items():
        unit = "BW" if name.endswith("_bw") else "Nm/kg"
        bench.add(f"walk_real_{name}", value, unit)
        bench.add(f"walk_virtual_{name}", made[name], unit)


_JOINTS = {"hip": "hip_flexion_r", "knee": "knee_angle_r", "ankle": "ankle_angle_r"}


def _measure_plates() -> dict[str, float]:
    """Measure the right leg's one complete stance on the plates, and OpenSim's moments of that stride."""
    plates = read_mot(GAIT2354 / "subject01_walk1_grf.mot")
    moments = read_mot(GAIT2354 / "OutputReference" / "inverse_dynamics.sto")
    mass = read_osim(GAIT2354 / "subject01_simbody.osim").mass_kg

    def column(table: Any, name: str) -> np.ndarray:  # noqa: ANN401 - a Table
        return table.values[:, table.labels.index(name)]

    force = np.stack([column(plates, f"ground_force_v{axis}") for axis in "xyz"], axis=-1) / (mass * WEIGHT)
    on = np.concatenate([[False], force[:, 1] > 0.02, [False]])
    begins, ends = np.flatnonzero(np.diff(on.astype(int)) == 1), np.flatnonzero(np.diff(on.astype(int)) == -1)
    whole = [(b, e) for b, e in zip(begins, ends, strict=True) if b > 0 and e < len(force)]
    first, last = max(whole, key=lambda stance: stance[1] - stance[0])
    during = (moments.times_s >= plates.times_s[first]) & (moments.times_s <= plates.times_s[last - 1])
    by_joint = {joint: column(moments, f"{name}_moment")[during] / mass for joint, name in _JOINTS.items()}
    return _peaks(force[first:last], by_joint)


def _peaks(force_bw: Float[np.ndarray, "frame 3"], moment: dict[str, np.ndarray]) -> dict[str, float]:
    """Name the landmarks of a stance: ground forces in body weights; moments in Nm/kg, extensor and plantarflexor positive."""
    on = force_bw[force_bw[:, 1] > 0.02]
    third = len(on) // 3
    stance = {joint: values[: round(len(values) * len(on) / len(force_bw))] for joint, values in moment.items()}
    return {
        "first_peak_bw": float(on[: len(on) // 2, 1].max()),
        "valley_bw": float(on[third : 2 * third, 1].min()),
        "second_peak_bw": float(on[len(on) // 2 :, 1].max()),
        "braking_bw": float(on[:, 0].min()),
        "propulsion_bw": float(on[:, 0].max()),
        "inward_bw": float(-on[third : 2 * third, 2].mean()),
        "ankle_peak": float(-stance["ankle"].min()),
        "knee_first_peak": float(stance["knee"][: len(stance["knee"]) // 2].max()),
        "knee_valley": float(stance["knee"][2 * len(stance["knee"]) // 5 : 4 * len(stance["knee"]) // 5].min()),
        "hip_extension_peak": float(-stance["hip"].min()),
        "hip_flexion_peak": float(stance["hip"].max()),
    }
