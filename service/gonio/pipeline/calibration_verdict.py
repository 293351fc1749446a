"""Stage ``verdict``: hold a solved rig against the table of criteria, and say in words what is wrong and what to do."""

from collections.abc import Callable, Sequence

import numpy as np

from gonio.errors import InputError
from gonio.formats.floor_points import FloorPoints
from gonio.kernel.calibration.evidence import KnownLength, gather_evidence
from gonio.kernel.calibration.rig import RigSolution
from gonio.kernel.calibration.verdict import judge
from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.triangulation.points import triangulate
from gonio.pipeline.findings import finding
from gonio.pipeline.params import KnownLengthParameter
from gonio.pipeline.run import Outcome
from gonio.records import BoardViews, Finding, Intrinsics, Judgement, Rig, Severity, Verdict

Say = Callable[[Judgement], Finding]

WORDS: dict[str, Say] = {
    "unconnected": lambda j: finding("camera-unconnected", camera=j.where),
    "halves_missing": lambda j: finding("calibration-unverified"),
    "held_out_px": lambda j: finding("calibration-inexact", value=j.value, severity=_severity(j)),
    "noise_px": lambda j: finding("corners-noisy", value=j.value, severity=_severity(j)),
    "camera_bias_px": lambda j: finding("calibration-biased", camera=j.where, value=j.value, severity=_severity(j)),
    "length_bias_pct": lambda j: finding("squares-wrong", value=j.value, severity=_severity(j)),
    "anisotropy_pct": lambda j: finding("board-stretched", value=j.value, severity=_severity(j)),
    "halves_baseline_pct": lambda j: finding("baselines-unsure", value=j.value, severity=_severity(j)),
    "views": lambda j: finding("board-views-few", camera=j.where, value=j.value, severity=_severity(j)),
    "common_views": lambda j: finding("cameras-share-few", where=j.where, value=j.value, severity=_severity(j)),
    "tilted_views": lambda j: finding("lens-not-tilted", camera=j.where, value=j.value, severity=_severity(j)),
    "focal_sd_pct": lambda j: finding("focal-length-unsure", camera=j.where, value=j.value, severity=_severity(j)),
    "focal_shift": lambda j: finding("lens-changed", camera=j.where, value=j.value, severity=_severity(j)),
    "delay_ms": lambda j: finding("camera-late", camera=j.where, value=j.value, severity=_severity(j)),
    "bump": lambda j: finding("camera-bumped", camera=j.where, value=j.value, severity=_severity(j)),
    "coverage": lambda j: finding("board-not-reached", where=j.where, value=j.value, severity=_severity(j)),
    "second_length_pct": lambda j: finding("scale-wrong", where=j.where, value=j.value, severity=_severity(j)),
}
"""What to say of each criterion that is not simply met."""


def judge_rig(
    views: BoardViews,
    intrinsics: Sequence[Intrinsics],
    solution: RigSolution,
    frame_period_s: float,
    known_lengths: Sequence[KnownLength],
) -> Outcome[Verdict]:
    """Gather the evidence, judge it, and put into findings what is not simply accepted."""
    verdict = judge(gather_evidence(views, intrinsics, solution, frame_period_s, known_lengths))
    findings = [WORDS[judgement.name](judgement) for judgement in verdict.judgements if judgement.level != "accept"]
    if not known_lengths:
        findings.append(finding("scale-unverified"))
    return Outcome(verdict, tuple(findings))


def find_lengths(
    wanted: Sequence[KnownLengthParameter], rig: Rig, points: FloorPoints | None
) -> tuple[KnownLength, ...]:
    """Measure the known lengths in the calibrated rig: between optical centres, or between floor points.

    Raises:
        InputError: ``length-unknown``: an end is neither a camera nor a floor point that two cameras see.
    """
    places = {camera.name: camera.centre_lab_m for camera in rig.cameras}
    if points is not None:
        located = locate_points(rig, points)
        places |= {name: xyz for name, xyz in zip(points.names, located, strict=True) if np.isfinite(xyz).all()}
    found: list[KnownLength] = []
    for length in wanted:
        missing = [name for name in (length.first, length.second) if name not in places]
        if missing:
            raise InputError(
                f"The known length ends at {missing[0]}, which is no camera and no floor point that two cameras see.",
                hint=f"Known are: {', '.join(places)}.",
                code="length-unknown",
            )
        distance_m = float(np.linalg.norm(places[length.first] - places[length.second]))
        found.append(KnownLength(name=f"{length.first} to {length.second}", true_m=length.metres, found_m=distance_m))
    return tuple(found)


def locate_points(rig: Rig, points: FloorPoints) -> np.ndarray:
    """Triangulate floor points (their cameras are the rig's, in order); NaN for one that fewer than two cameras see."""
    uv_px = undistort_rig(rig, points.uv_px)
    seen = np.isfinite(uv_px[..., 0]).astype(float)
    return triangulate(projection_matrices(rig), focal_lengths_px(rig), uv_px, seen, method="reprojection").xyz_lab_m


def _severity(judgement: Judgement) -> Severity:
    return "serious" if judgement.level == "reject" else "warning"
