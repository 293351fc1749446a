"""What a page needs to show the trial in 3D and over the videos: ``viewer.json`` and its numbers, ``viewer.f32``.

The report itself is for reading. This is the movement, frame by frame, in a form that a browser takes as it is: a small JSON
document that names arrays, and their little-endian 32-bit floats one after the other, C order, NaN where nothing is known
(docs/reference/viewer.md).
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gonio.kernel.body.forward import marker_positions
from gonio.pipeline.describe import Analysis
from gonio.records import MISSING, GroundForces

_SIDES = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("right", "left")
    for start, end in (
        ("hip", "knee"),
        ("knee", "ankle"),
        ("ankle", "heel"),
        ("ankle", "big_toe"),
        ("heel", "big_toe"),
        ("big_toe", "small_toe"),
        ("ankle", "foot_index"),
        ("heel", "foot_index"),
        ("shoulder", "elbow"),
        ("elbow", "wrist"),
        ("wrist", "index"),
        ("shoulder", "hip"),
    )
]
SKELETON: tuple[tuple[str, str], ...] = (
    *_SIDES,
    ("right_shoulder", "left_shoulder"),
    ("right_hip", "left_hip"),
    ("nose", "right_ear"),
    ("nose", "left_ear"),
    ("neck", "head"),
)
"""The lines between keypoints that people see as a body, over all layouts."""


def skeleton_of(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Give the lines whose both ends are among these keypoints."""
    known = set(names)
    return tuple(line for line in SKELETON if known.issuperset(line))


def write_viewer(analysis: Analysis, output_dir: Path) -> tuple[Path, ...]:
    """Write ``viewer.json`` and ``viewer.f32``; give them with the videos' previews."""
    arrays = viewer_arrays(analysis)
    document, numbers = output_dir / "viewer.json", output_dir / "viewer.f32"
    offset, described = 0, {}
    with numbers.open("wb") as file:
        for name, values in arrays.items():
            described[name] = {"offset": offset, "shape": list(values.shape)}
            offset += file.write(np.ascontiguousarray(values, dtype="<f4").tobytes()) // 4
    points, model = analysis.points, analysis.motion.model
    names, markers = points.keypoint_names, model.markers.names
    content = {
        "version": 1,
        "rate_hz": points.timebase.rate_hz,
        "start_s": points.timebase.start_s,
        "frames": len(points.xyz_lab_m),
        "keypoints": list(names),
        "lines": [[names.index(a), names.index(b)] for a, b in skeleton_of(names)],
        "markers": list(markers),
        "marker_lines": [[markers.index(a), markers.index(b)] for a, b in skeleton_of(markers)],
        "cameras": [describe_view(analysis, camera) for camera in range(len(analysis.raw.rig.cameras))],
        "weight_n": round(model.weight_n, 2),
        "arrays": described,
    }
    document.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    return (document, numbers, *analysis.keypoints.previews)


def viewer_arrays(analysis: Analysis) -> dict[str, np.ndarray]:
    """Give the arrays by name.

    ``points`` (frame, keypoint, 3): the smooth keypoints in the lab, m. ``point_sd`` (frame, keypoint): the largest standard
    deviation of each, m. ``markers`` (frame, marker, 3): the same places on the fitted body, m. ``observed`` (camera, frame,
    keypoint, 2): what each camera saw in its own frames, px of the video. With forces, ``force`` (frame, foot, 3), N, and
    ``cop`` (frame, foot, 3), m; right, then left.
    """
    points, motion = analysis.points, analysis.motion
    found = points.origin != MISSING
    covariance = np.where(found[..., None, None], points.covariance_m2, np.nan)
    known = np.isfinite(covariance).all(axis=(-2, -1))
    sd = np.full(known.shape, np.nan)
    sd[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known])[:, -1], 0.0))
    arrays = {
        "points": points.xyz_lab_m,
        "point_sd": sd,
        "markers": marker_positions(motion.model, motion.motion.values),
        "observed": analysis.keypoints.points.uv_px,
    }
    return arrays | (force_arrays(analysis.forces) if analysis.forces is not None else {})


def force_arrays(forces: GroundForces) -> dict[str, np.ndarray]:
    """Give the ground forces and where they act."""
    return {"force": forces.wrench[:, :, :3], "cop": forces.cop_lab_m}


def describe_view(analysis: Analysis, index: int) -> dict[str, Any]:
    """Describe a camera, OpenCV's way, in the report's lab, and the preview of its video."""
    camera, previews = analysis.raw.rig.cameras[index], analysis.keypoints.previews
    return {
        "name": camera.name,
        "width_px": camera.image_size_px[0],
        "height_px": camera.image_size_px[1],
        "intrinsic_px": camera.intrinsic_px.tolist(),
        "distortion": camera.distortion.tolist(),
        "T_cam_lab": camera.T_cam_lab.tolist(),
        # In the preview, the trial's moment t is at t + delay_s.
        "delay_s": round(float(analysis.synchronization.delay_s[index]), 6),
        "preview": previews[index].name if previews else None,
    }
