"""Every finding a report can hold, in one table: its code, how much it matters, what it says and what to do about it.

``docs/reference/findings.md`` is made from this table, and a test holds the two together.
"""

from gonio.pipeline.finding_kind import Kind, Number
from gonio.pipeline.findings_carving import CARVING_KINDS
from gonio.pipeline.findings_forces import FORCE_KINDS
from gonio.pipeline.findings_lab import LAB_KINDS
from gonio.pipeline.findings_monocular import MONOCULAR_KINDS
from gonio.pipeline.findings_sensors import SENSOR_KINDS
from gonio.records import Finding, Severity

KINDS: dict[str, Kind] = {
    "board-rows-unseen": Kind(
        "warning",
        "boards",
        "The board's outermost lines of inner corners ({value:g}), below the rows that were seen, were never confirmed: that "
        "part is covered in all pictures, or the board has fewer rows than its card says. Its corners were left out.",
        "Hold the board at its other side or by a handle behind it, and count its rows again.",
    ),
    "board-layout": Kind(
        "info",
        "boards",
        "The board has the other layout of ChArUco boards than its card says (that of OpenCV before 4.6, or since); it was "
        "found all the same.",
        "Turn legacy_pattern round in the card.",
    ),
    "lens-from-session": Kind(
        "warning",
        "lenses",
        "The lens of camera {where} was calibrated from this recording itself, in which the board is small and far: "
        "its own pictures give the focal length to {value:.1f} %.",
        "Film the board with this camera alone, close, filling the picture, tilted in all directions; give it as its lens.",
        "%",
    ),
    "lens-few-views": Kind(
        "warning",
        "lenses",
        "The lens of camera {where} was calibrated from {value:g picture|pictures} of the board.",
        "Film it for half a minute: 20 to 30 different views make a lens.",
        "pictures",
    ),
    "lab-guessed": Kind(
        "warning",
        "lab",
        "Nothing says where the floor and the walkway are: up is taken from how the cameras stand, which may be off by 5°, "
        "and forward from the first camera.",
        "Lay the board on the floor, its rows along the walkway, and film it with all cameras; or name points on the floor.",
    ),
    "lab-misfit": Kind(
        "warning",
        "lab",
        "What says where the lab is disagrees with itself by {value:.0f} mm.",
        "Check the places of the floor points, or that the board lay flat and still.",
        "mm",
    ),
    "camera-displaced": Kind(
        "serious",
        "comparison",
        "Camera {where} no longer stands where the earlier calibration has it: its picture of the board is off by "
        "{value:.1f} px.",
        "Use this new calibration instead of the earlier one, if it is accepted; fix the tripod.",
        "px",
    ),
    "cameras-steady": Kind(
        "info",
        "comparison",
        "All cameras stand where the earlier calibration has them: their pictures of the board are off by {value:.2f} px "
        "at most.",
        "No tripod was moved: go on with whichever of the two calibrations has the better verdict.",
        "px",
    ),
    "camera-not-checked": Kind(
        "warning",
        "comparison",
        "Camera {where} is part of the earlier calibration, but did not see the board together with the others: whether it "
        "moved is not known.",
        "Film the board with this camera too.",
    ),
    "calibration-rejected": Kind(
        "serious",
        "calibration",
        "The calibration of these cameras was rejected when it was made ({where}).",
        "Calibrate again; until then, trust no angle and no distance.",
    ),
    "calibration-doubtful": Kind(
        "warning",
        "calibration",
        "The calibration of these cameras was accepted with warnings ({where}).",
        "Read the calibration's own page: it says what to film next time.",
    ),
    "scale-unverified": Kind(
        "info",
        "verdict",
        "No second length was given, so nothing checks the size of the board's squares: everything scales with it.",
        "Measure the distance between two lenses or two marks on the floor with a tape, and give it.",
    ),
    "camera-unconnected": Kind(
        "serious",
        "verdict",
        "Camera {where} never saw the board together with the others, so it is not part of the calibration.",
        "Film the board where this camera's picture overlaps with another one's, ten times or more.",
    ),
    "calibration-unverified": Kind(
        "serious",
        "verdict",
        "The recording is too short to be checked: neither half of it can be solved alone.",
        "Film the board for longer, seen by two neighbouring cameras at a time: half a minute for each pair.",
    ),
    "calibration-inexact": Kind(
        "warning",
        "verdict",
        "In pictures that were not used, the cameras miss the board's corners by {value:.2f} px in the median.",
        "Light the room, move the board slowly, use a short exposure, and check that the board is flat. For photographs, hold "
        "it still until all cameras have taken theirs.",
        "px",
    ),
    "calibration-biased": Kind(
        "warning",
        "verdict",
        "In pictures that were not used, camera {where} sees the board's corners {value:.2f} px beside where the others do.",
        "Calibrate this camera's lens again; check its tripod and that it runs synchronously.",
        "px",
    ),
    "squares-wrong": Kind(
        "warning",
        "verdict",
        "The board's squares are measured {value:.2f} % too long or too short in pictures that were not used.",
        "Calibrate the lenses from recordings of their own; measure a square of the board again.",
        "%",
    ),
    "board-stretched": Kind(
        "warning",
        "verdict",
        "The board's squares are {value:.2f} % longer one way than the other: the print is stretched, or the board is bent.",
        "Print the board again without fitting it to the page, check both directions with a ruler, and mount it flat.",
        "%",
    ),
    "baselines-unsure": Kind(
        "warning",
        "verdict",
        "The distances between the cameras differ by {value:.2f} % between the two halves of the recording.",
        "Calibrate the lenses from recordings of their own, and take the board through the whole volume.",
        "%",
    ),
    "board-views-few": Kind(
        "warning",
        "verdict",
        "Too few pictures of camera {where} show the board: {value:g}.",
        "Film the board in front of this camera for ten seconds.",
        "pictures",
    ),
    "cameras-share-few": Kind(
        "warning",
        "verdict",
        "Too few pictures of cameras {where} show the board to both: {value:g}.",
        "Film the board for ten seconds where these two pictures overlap.",
        "pictures",
    ),
    "lens-not-tilted": Kind(
        "warning",
        "verdict",
        "The lens of camera {where} was calibrated from {value:g picture|pictures} with a tilted board: held parallel to "
        "the picture, a board can't tell near from far.",
        "Film the board with this camera again, tilted by 20° to 50° to the left, the right, up and down.",
        "pictures",
    ),
    "focal-length-unsure": Kind(
        "warning",
        "verdict",
        "With all that was given, the focal length of camera {where} is known to {value:.1f} % only: every distance from it "
        "is.",
        "Calibrate its lens from a recording of its own: the board close, filling the picture, tilted in all directions.",
        "%",
    ),
    "lens-changed": Kind(
        "warning",
        "verdict",
        "The focal length that was given for camera {where} is {value:.1f} standard deviations from what this recording says.",
        "Was the zoom, the focus, the video mode or the camera changed? Calibrate its lens again.",
        "sd",
    ),
    "camera-late": Kind(
        "warning",
        "verdict",
        "Camera {where} shows another instant than the first camera, by {value:.0f} ms. Less than a frame is measured and "
        "taken out; more is not to be trusted.",
        "Start the cameras by a common trigger; the calibration says by how much each is late or early.",
        "ms",
    ),
    "camera-bumped": Kind(
        "warning",
        "verdict",
        "Camera {where} moved while the board was filmed: its early and its late pictures contradict each other.",
        "Fix its tripod, keep away from it, and film the board again.",
        "sd",
    ),
    "board-not-reached": Kind(
        "warning",
        "verdict",
        "The board never reached {where}.",
        "Film it there for ten seconds: where no corner was seen, the lens is guessed.",
        "corners",
    ),
    "scale-wrong": Kind(
        "warning",
        "verdict",
        "The length {where} differs from its measured one by {value:.2f} %: the board's squares are not as large as its card "
        "says, or the length is not.",
        "Measure a row of squares and the length again.",
        "%",
    ),
    "camera-without-video": Kind(
        "warning",
        "capture",
        "The calibration knows camera {where}, but the session has no video of it: the result rests on the others.",
        "Upload the video of that camera, or go on if it was not running.",
    ),
    "image-size-differs": Kind(
        "info",
        "capture",
        "The video of camera {where} is {value:g pixel|pixels} narrower or lower than its calibration says; it was taken as "
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
        "The videos have different lengths (camera {where} has {value:g frame|frames} more than the shortest): only the part "
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
        "{value:g other person was|other people were} in view; the subject is {where}. Unless the request "
        "says who, it is the one who is well seen, walks, and is nearest to the middle of the capture volume.",
        "Keep bystanders out of the picture: they hide the subject. If it is the wrong person, ask for another one with "
        "keypoints.person; the report lists them all.",
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
    "gait-no-cycle": Kind(
        "info",
        "gait",
        "The recording holds no full gait cycle ({where}), so there are no averages over the cycle and no parameters of gait.",
        "Film three strides or more in a straight line, each foot striking the ground at least twice in view of all cameras.",
    ),
    "gait-few-cycles": Kind(
        "info",
        "gait",
        "The averages over the gait cycle rest on few cycles ({where}): too few to tell how someone usually walks.",
        "Film more strides, or several passes: five cycles of each side make a steady average.",
        "cycles",
    ),
    "gait-cycle-odd": Kind(
        "info",
        "gait",
        "A cycle is unlike the others and does not count in the averages: {where}.",
        "Look at it in the video: a turn, a stumble or a lost limb; if it is how the person walks, film more strides.",
    ),
    "gait-events-from-movement": Kind(
        "info",
        "gait",
        "When the feet touch and leave the ground was read off their movement: known to ± {value:.0f} ms (one standard "
        "deviation).",
        "Force plates, or pressure soles of 50 samples a second or more, show the contacts themselves.",
        "ms",
    ),
    **SENSOR_KINDS,
    **LAB_KINDS,
    **FORCE_KINDS,
    **MONOCULAR_KINDS,
    **CARVING_KINDS,
}


def finding(
    code: str,
    *,
    where: str = "",
    value: float | None = None,
    severity: Severity | None = None,
    span_s: tuple[float, float] | None = None,
    camera: str = "",
    joint: str = "",
) -> Finding:
    """Make a finding of a kind in the table; ``severity`` overrides the kind's where the number is worse than usual.

    Where nothing says ``where``, it is the camera or the joint.
    """
    kind, where = KINDS[code], where or camera or joint
    return Finding(
        code=code,
        severity=severity or kind.severity,
        stage=kind.stage,
        message=kind.message.format(where=where, value=Number("nan" if value is None else value)),
        hint=kind.hint,
        where=where,
        value=None if value is None else float(value),
        unit=kind.unit,
        span_s=span_s,
        camera=camera,
        joint=joint,
    )
