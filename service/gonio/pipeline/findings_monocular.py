"""The findings about recordings of one camera: a part of the table in :mod:`gonio.pipeline.findings`."""

from gonio.pipeline.finding_kind import Kind

MONOCULAR_KINDS: dict[str, Kind] = {
    "one-camera": Kind(
        "warning",  # what nothing checks is never "good"
        "kinematics",
        "One camera saw this trial, {value:.0f}° away from the side: depth comes from the floor and the subject's stature, "
        "and nothing checks it. The error bands count with that, but not with a hidden leg that the network guessed wrong.",
        "Film straight from the side; two or more calibrated cameras measure what one can only infer.",
        "deg",
    ),
    "view-unreliable": Kind(
        "warning",
        "kinematics",
        "This view can't measure the {where}: it moves towards the camera and away, and its standard deviation is "
        "{value:.0f}°.",
        "Don't use this angle. Film from the side, or with several cameras.",
        "deg",
    ),
    "feet-off-floor": Kind(
        "warning",
        "kinematics",
        "The floor could not be used: {where}. The subject's distance, steps and speed rest on the stature alone.",
        "Check that the calibration's floor (y = 0) is what the subject stands on, and the subject's stature. On a treadmill "
        "no foot stands still: nothing is wrong then.",
        "m",
    ),
    "stature-unknown": Kind(
        "warning",
        "scaling",
        "The subject's stature is not known; that of the model was used ({value:.2f} m). With one camera all lengths, steps "
        "and speeds rest on it.",
        "Give the subject's stature.",
        "m",
    ),
    "monocular-fit-doubtful": Kind(
        "serious",
        "kinematics",
        "The body that was fitted to the camera's keypoints can't be believed: {where}.",
        "Look at the picture in the report: does the skeleton lie on the body? Is the calibration that of this camera, with "
        "the floor at y = 0, and the stature right?",
    ),
    "one-camera-bystanders": Kind(
        "info",
        "keypoints",
        "{value:g other person was|other people were} seen; the subject is {where}.",
        "Is the skeleton in the picture on the right person? If not, ask for keypoints.person = 2.",
        "people",
    ),
}
