"""Is this calibration good enough? One table of criteria, each with its limits and the reason for them.

Nothing here looks at how well a solution fits the pictures that it was made from: that number is low for bad calibrations
too. The limits were set on three real sessions and their spoiled versions (docs/reference/calibration-verdict.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gonio.kernel.calibration.board_terms import DELAY, FOCAL
from gonio.kernel.calibration.evidence import Evidence
from gonio.records import Judgement, Level, Verdict

REFERENCE_WIDTH_PX = 1280
"""Limits in pixels are for pictures up to this width, and grow with it beyond."""

MARGINS = {
    "left third": np.s_[:, :2],
    "right third": np.s_[:, 4:],
    "upper quarter": np.s_[:1, :],
    "lower quarter": np.s_[3:, :],
}
"""The parts of a picture's grid of 6 × 4 cells that a board is most often not taken to."""


@dataclass(frozen=True)
class Criterion:
    """What is measured, up to where it is accepted, up to where accepted with a warning, and why there.

    ``at_least`` turns the comparison round: more is better.
    """

    accept: float
    warn: float
    unit: str
    reason: str
    at_least: bool = False


CRITERIA: dict[str, Criterion] = {
    "held_out_px": Criterion(
        0.5, 0.7, "px",
        "median reprojection error of corners that the solution had not seen; good sessions reach 0.35 to 0.65",
    ),
    "noise_px": Criterion(
        0.8, 1.1, "px",
        "the noise of a corner, per axis, from unseen pictures, whatever the number of cameras; detectors reach 0.1 to 0.6",
    ),
    "camera_bias_px": Criterion(
        0.25, 0.35, "px",
        "mean offset of one camera against the others in unseen pictures: it shifts every point that it sees",
    ),
    "length_bias_pct": Criterion(
        0.2, 0.3, "%", "mean error of the squares' sides in unseen pictures, along the sides; a good session stays below 0.2"
    ),
    "anisotropy_pct": Criterion(
        0.3, 0.5, "%", "squares longer one way than the other: the printer or the paper stretched the board"
    ),
    "halves_baseline_pct": Criterion(
        0.5, 1.0, "%", "the distances between cameras, solved from each half alone: the error that the board can't show"
    ),
    "halves_missing": Criterion(0.0, 0.0, "", "without two halves that can be solved alone nothing can be verified"),
    "views": Criterion(12, 6, "pictures", "pictures of the board in one camera; four leave nothing to check", at_least=True),
    "common_views": Criterion(
        8, 3, "pictures", "pictures that a pair of cameras shares; one or two fit a wrong pose perfectly", at_least=True
    ),
    "tilted_views": Criterion(
        6, 4, "pictures", "pictures with the board tilted by 20° or more: without them depth and focal length are one",
        at_least=True,
    ),
    "focal_sd_pct": Criterion(0.5, 1.0, "%", "standard deviation of the focal length: it scales every depth"),
    "focal_shift": Criterion(
        2.0, 3.0, "sd", "focal length from this session alone against the one that was given: another lens, zoom or camera"
    ),
    "delay_ms": Criterion(
        5.0,
        np.inf,
        "ms",
        "5 ms are 7 mm at walking speed. Up to a whole frame (the second limit) a delay is measured and taken out; beyond "
        "that no picture is near the instant, and what is measured is no longer exact",
    ),
    "bump": Criterion(4.0, 6.0, "sd", "early against late pose of one camera; undisturbed cameras reach 2, rarely 7"),
    "coverage": Criterion(
        1, 0, "corners", "corners in a margin of the picture; where none was seen, the lens is extrapolated", at_least=True
    ),
    "second_length_pct": Criterion(
        0.5, 1.0, "%", "a wrong square size changes no error at all: only a second known length can tell"
    ),
    "unconnected": Criterion(0.0, 0.0, "", "a camera that shares no picture of the board with the others has no place"),
}  # fmt: skip

BUMP_MIN_RAD = np.deg2rad(0.5)
BUMP_CERTAIN_Z = 10.0
"""Small angles may be an unexplained half degree of an undisturbed camera: below that only a clear case is rejected."""


def judge(evidence: Evidence) -> Verdict:
    """Hold the evidence against the table."""
    judgements = (
        *(judge_value("unconnected", 1.0, name) for name in evidence.unconnected),
        *_judge_held_out(evidence),
        *_judge_views(evidence),
        *_judge_optics(evidence),
        *_judge_timing(evidence),
        *_judge_bumps(evidence),
        *_judge_coverage(evidence),
        *(
            judge_value("second_length_pct", 100 * abs(length.found_m / length.true_m - 1), length.name)
            for length in evidence.known_lengths
        ),
    )
    return Verdict(level=worst([judgement.level for judgement in judgements]), judgements=judgements)


def judge_value(
    name: str, value: float, where: str = "", *, scale: float = 1.0, warn: float | None = None
) -> Judgement:
    """Hold one number against its criterion; NaN, which is no number, is rejected. ``warn`` overrides the table's."""
    criterion = CRITERIA[name]
    accept, warn = criterion.accept * scale, criterion.warn * scale if warn is None else warn
    signed, limits = (-value, (-accept, -warn)) if criterion.at_least else (value, (accept, warn))
    level: Level = "accept" if signed <= limits[0] else "warn" if signed <= limits[1] else "reject"
    return Judgement(name=name, level=level, value=float(value), accept=accept, warn=warn, where=where)


def worst(levels: Sequence[Level]) -> Level:
    """Give the worst of some levels."""
    return "reject" if "reject" in levels else "warn" if "warn" in levels else "accept"


def _judge_held_out(evidence: Evidence) -> list[Judgement]:
    if evidence.halves is None:
        return [judge_value("halves_missing", 1.0)]
    errors = evidence.halves.pooled
    scales = np.maximum(np.array(evidence.image_widths_px) / REFERENCE_WIDTH_PX, 1.0)
    bias_px = np.linalg.norm(errors.camera_bias_px, axis=1)
    most = int(np.argmax(np.nan_to_num(bias_px / scales, nan=np.inf)))
    return [
        judge_value("held_out_px", errors.median_px, scale=float(np.median(scales))),
        judge_value("noise_px", errors.noise_px, scale=float(np.median(scales))),
        judge_value("camera_bias_px", float(bias_px[most]), evidence.names[most], scale=float(scales[most])),
        judge_value("length_bias_pct", 100 * abs(errors.bias)),
        judge_value("anisotropy_pct", 100 * abs(errors.anisotropy)),
        judge_value("halves_baseline_pct", 100 * evidence.halves.baseline_rms),
    ]


def _judge_views(evidence: Evidence) -> list[Judgement]:
    counts = evidence.solution.views
    few = int(np.argmin(counts))
    judged = [judge_value("views", counts[few], evidence.names[few])]
    if evidence.solution.pairs:
        pair = min(evidence.solution.pairs, key=lambda p: p.common_views)
        both = f"{evidence.names[pair.first]} and {evidence.names[pair.second]}"
        judged.append(judge_value("common_views", pair.common_views, both))
    return judged


def _judge_optics(evidence: Evidence) -> list[Judgement]:
    judged: list[Judgement] = []
    for camera, (name, optics) in enumerate(zip(evidence.names, evidence.intrinsics, strict=True)):
        if optics.origin != "file":
            judged.append(judge_value("tilted_views", optics.tilted_views, name))
        focal_px = evidence.solution.scene.theta[camera, FOCAL]
        sd = float(evidence.solution.adjusted.sd(camera)[6 + FOCAL] / focal_px)
        judged.append(judge_value("focal_sd_pct", 100 * sd, name))
        if np.isfinite(evidence.focal_shift[camera]):
            judged.append(judge_value("focal_shift", evidence.focal_shift[camera], name))
    return judged


def _judge_timing(evidence: Evidence) -> list[Judgement]:
    if not evidence.solution.delays_solved:
        return []
    delays_ms = 1e3 * np.abs(evidence.solution.scene.theta[:, DELAY])
    frame_ms = 1e3 * evidence.frame_period_s
    return [
        judge_value("delay_ms", delay, name, warn=frame_ms)
        for name, delay in zip(evidence.names, delays_ms, strict=True)
    ]


def _judge_bumps(evidence: Evidence) -> list[Judgement]:
    """Judge the camera that changed most: the sound ones are compared with it, and seem to have moved too."""
    z = np.array([bump.z for bump in evidence.bumps])
    if not np.isfinite(z).any():
        return []
    most = int(np.nanargmax(z))
    judgement = judge_value("bump", float(z[most]), evidence.names[most])
    certain = evidence.bumps[most].angle_rad > BUMP_MIN_RAD or z[most] > BUMP_CERTAIN_Z
    return [judgement if certain or judgement.level == "accept" else replace(judgement, level="warn")]


def _judge_coverage(evidence: Evidence) -> list[Judgement]:
    """Judge the margins of each picture where the lens was calibrated here; what a file says was covered is not known."""
    return [
        judge_value("coverage", 0.0, f"the {margin} of {name}'s picture")
        for name, optics, covered in zip(evidence.names, evidence.intrinsics, evidence.covered, strict=True)
        if optics.origin != "file"
        for margin, cells in MARGINS.items()
        if not covered[cells].any()
    ]
