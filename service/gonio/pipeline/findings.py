"""Every finding a report can hold, in one table: its code, how much it matters, what it says and what to do about it.

``docs/reference/findings.md`` is made from this table, and a test holds the two together.
"""

from dataclasses import dataclass

from gonio.records import Finding, Severity


@dataclass(frozen=True)
class Kind:
    """A kind of finding; ``message`` may name ``{where}`` and ``{value}``."""

    severity: Severity
    stage: str
    message: str
    hint: str
    unit: str = ""


KINDS: dict[str, Kind] = {
    "camera-without-video": Kind(
        "warning",
        "capture",
        "The calibration knows camera {where}, but the session has no video of it: the result rests on the others.",
        "Upload the video of that camera, or go on if it was not running.",
    ),
    "image-size-differs": Kind(
        "info",
        "capture",
        "The video of camera {where} is {value:g} pixels narrower or lower than its calibration says; it was taken as "
        "cut at the right or lower edge.",
        "Calibrate with the video mode that you record with.",
        "px",
    ),
    "image-size-scaled": Kind(
        "warning",
        "capture",
        "The video of camera {where} has {value:g} times the size of its calibration; the calibration was scaled to it.",
        "Calibrate with the video mode that you record with: some modes crop the sensor, and then scaling is wrong.",
        "1",
    ),
    "lengths-differ": Kind(
        "warning",
        "capture",
        "The videos have different lengths (camera {where} has {value:g} frames more than the shortest): only the part "
        "that all of them cover was used, and it was assumed that they start together.",
        "Start the cameras by a common trigger, or cut the videos to the same first moment.",
        "frames",
    ),
    "rates-differ": Kind(
        "warning",
        "capture",
        "Camera {where} records {value:g} times as many frames as the slowest camera; the frames in between were left out.",
        "Set all cameras to the same rate.",
        "1",
    ),
    "rate-varies": Kind(
        "warning",
        "capture",
        "The frames of camera {where} are up to {value:.0f} ms off a steady rate; they were taken as steady.",
        "Phones vary the rate in dim light: fix the rate and the exposure, and light the room.",
        "ms",
    ),
    "camera-lost-subject": Kind(
        "warning",
        "keypoints",
        "Camera {where} did not see the subject in {value:.0f} % of the frames.",
        "Check that the subject stays inside this camera's picture and is not hidden by others.",
        "%",
    ),
    "bystanders": Kind(
        "info",
        "keypoints",
        "{value:g} people were in view; the subject was taken to be the one whom most cameras see, nearest to the "
        "middle of the capture volume.",
        "Keep bystanders out of the picture: they hide the subject.",
        "people",
    ),
    "keypoints-invalid": Kind(
        "warning",
        "checks",
        "{value:.1f} % of the keypoints of camera {where} were no positions (infinite, or with a confidence that is no "
        "number) and were left out.",
        "Have the keypoints found anew; if it happens again, report it with this recording.",
        "%",
    ),
    "too-few-cameras": Kind(
        "warning",
        "checks",
        "For {value:.1f} s too few cameras saw the subject ({where}): nothing is known of the movement there, and the "
        "curves have a gap.",
        "Check these videos at that time: light, exposure, cables, and whether something stood before the cameras.",
        "s",
    ),
    "camera-moved": Kind(
        "warning",
        "tripods",
        "A camera was moved while it recorded ({where}): everything that it sees jumped by {value:.0f} mm at one moment. The "
        "result rests on the other cameras there.",
        "Calibrate again before the next recording, and fix the tripod: weights on its legs, cables out of the way.",
        "mm",
    ),
    "camera-moved-unclear": Kind(
        "serious",
        "tripods",
        "A camera was moved while it recorded, and the recording does not tell which one ({where}): what one of them sees "
        "jumped by {value:.0f} mm at one moment.",
        "Look at the background of the videos at that moment to see which one was moved, analyse again without that "
        "camera, and calibrate again.",
        "mm",
    ),
    "cameras-not-synchronous": Kind(
        "warning",
        "synchronization",
        "Camera {where} runs {value:+.0f} ms late against the first camera; this was found from the subject's movement and "
        "corrected.",
        "Trigger the cameras together, or film a sharp event that all of them see.",
        "ms",
    ),
    "synchronization-unknown": Kind(
        "info",
        "synchronization",
        "The subject moved too little to tell whether the cameras run together; they were taken as synchronous.",
        "Let the subject walk or swing an arm for some seconds, or trigger the cameras together.",
    ),
    "cameras-refined": Kind(
        "warning",
        "cameras",
        "The calibration no longer fits: the cameras' poses were corrected on the subject's own movement, most of all "
        "camera {where}. In moments that were not used for it, the cameras' disagreement fell by {value:.0f} %.",
        "Calibrate again; check the tripods. Directions against the vertical keep the calibration's uncertainty.",
        "%",
    ),
    "camera-biased": Kind(
        "warning",
        "triangulation",
        "The points of camera {where} lie {value:.0f} mm to one side of where the other cameras see them, in the mean "
        "over the whole trial: its calibration no longer fits.",
        "Calibrate again; check that nobody moved this camera.",
        "mm",
    ),
    "reprojection-large": Kind(
        "warning",
        "triangulation",
        "The cameras disagree by {value:.0f} mm in the median: angles may be off by several degrees.",
        "Calibrate again, and check that the cameras run synchronously.",
        "mm",
    ),
    "observations-rejected": Kind(
        "warning",
        "triangulation",
        "{value:.0f} % of what camera {where} saw contradicted the other cameras and was left out.",
        "Look at this camera's pictures in the report: is it the subject that it follows?",
        "%",
    ),
    "keypoint-missing": Kind(
        "warning",
        "triangulation",
        "The {where} was seen by fewer than two cameras in {value:.0f} % of the frames and is unknown there.",
        "Place the cameras so that at least two see each side of the body at all times.",
        "%",
    ),
    "segment-unsteady": Kind(
        "warning",
        "triangulation",
        "The length of the {where} varies by {value:.1f} % over the trial, though bones don't: its points are uncertain.",
        "Tight clothes that contrast with the background, more light, and a new calibration help most.",
        "%",
    ),
    "clip-short": Kind(
        "info",
        "triangulation",
        "The recording lasts {value:.1f} s: too short for a mean over gait cycles.",
        "Record at least three strides of each leg at a steady pace.",
        "s",
    ),
    "mass-unknown": Kind(
        "info",
        "scaling",
        "The subject's mass was not given: the model keeps the mass of its table ({value:.0f} kg). Angles don't depend on it.",
        "Give the mass with the session.",
        "kg",
    ),
    "sex-unknown": Kind(
        "info",
        "scaling",
        "The subject's sex was not given: the segment masses are those of the table for men. Angles hardly depend on it.",
        "Give the sex with the session.",
    ),
    "segment-not-scaled": Kind(
        "warning",
        "scaling",
        "The {where} could not be measured (its ends were never seen together) and keeps the model's own size.",
        "Record a moment in which it is fully in view of two cameras.",
    ),
    "body-fit-poor": Kind(
        "warning",
        "kinematics",
        "The body model misses the measured points by {value:.0f} mm in the mean: angles are uncertain.",
        "Look at the pictures in the report: does the skeleton lie on the body?",
        "mm",
    ),
    "pixel-fit-distrusted": Kind(
        "warning",
        "kinematics",
        "The body could not be fitted to the pixels of the whole trial, because {where}. The angles come from the smoothed "
        "points, frame by frame, and are less certain.",
        "Look at the pictures in the report: does the skeleton lie on the body? More cameras and a longer clip help.",
    ),
    "kinematics-disagree": Kind(
        "warning",
        "kinematics",
        "Two ways to compute the {where} differ by {value:.1f}° in the shape of its curve, more than their error bars "
        "explain.",
        "Read this angle with care; a limb that few cameras see is the usual cause.",
        "deg",
    ),
    "frames-unsolved": Kind(
        "warning",
        "kinematics",
        "In {value:.0f} % of the frames too few points were known to place the body; the curves have gaps there.",
        "Keep the whole body in view of at least two cameras.",
        "%",
    ),
    "frames-not-converged": Kind(
        "serious",
        "kinematics",
        "In {value:.0f} % of the frames the body fit did not converge; those angles are not to be trusted.",
        "Look at the pictures in the report: does the skeleton lie on the body?",
        "%",
    ),
}


def finding(code: str, *, where: str = "", value: float | None = None, severity: Severity | None = None) -> Finding:
    """Make a finding of a kind in the table; ``severity`` overrides the kind's where the number is worse than usual."""
    kind = KINDS[code]
    return Finding(
        code=code,
        severity=severity or kind.severity,
        stage=kind.stage,
        message=kind.message.format(where=where, value=value if value is not None else float("nan")),
        hint=kind.hint,
        where=where,
        value=None if value is None else float(value),
        unit=kind.unit,
    )
