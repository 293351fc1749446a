"""The findings about a trial's lab and clocks: a part of the table in :mod:`gonio.pipeline.findings`."""

from gonio.pipeline.finding_kind import Kind

LAB_KINDS: dict[str, Kind] = {
    "lab-from-walker": Kind(
        "info",
        "triangulation",
        "The calibration does not tell where the floor is: floor, up and forward were taken from the subject's own {where}. "
        "The vertical is known to {value:.1f}°, worst across the way.",
        "Calibrate with the board on the floor; or let the subject walk across the room in two directions.",
        "°",
    ),
    "lab-contradicted": Kind(
        "warning",
        "triangulation",
        "In the calibration's lab the subject would be {value:.0f}° off upright: its vertical was not believed.",
        "Check which axis of the calibration is up; calibrate with the board on the floor.",
        "°",
    ),
    "lab-from-posture": Kind(
        "warning",
        "triangulation",
        "The subject stood upside down in the calibration's lab, and took too few steps to show the floor: up was taken from "
        "the subject's posture, which may be off by 5°.",
        "Calibrate with the board on the floor.",
    ),
    "lab-walk-missing": Kind(
        "warning",
        "triangulation",
        "The calibration only guessed where floor and vertical are, and the subject took too few steps to tell: both may be "
        "off by 5°.",
        "Calibrate with the board on the floor, or let the subject walk four steps or more.",
    ),
    "delays-from-calibration": Kind(
        "warning",
        "synchronization",
        "Camera {where} runs {value:+.0f} ms late against the first camera: the calibration found it, and the subject's "
        "movement, which is too little to tell by itself, bears it out. It was corrected.",
        "Trigger the cameras together, or let the subject move more.",
        "ms",
    ),
    "delays-not-applied": Kind(
        "warning",
        "synchronization",
        "The request trusts a common trigger, but the calibration found camera {where} {value:+.0f} ms late; nothing was "
        "corrected.",
        "Leave `synchronization` at `estimate`, or check the trigger's cables.",
        "ms",
    ),
}
