"""The findings about forces and torques: a part of the table in :mod:`gonio.pipeline.findings`."""

from gonio.pipeline.finding_kind import Kind

FORCE_KINDS: dict[str, Kind] = {
    "forces-method": Kind(
        "info",
        "forces",
        "The shear under the feet was not measured but found ({where}). With perfect soles and movement, the knee's torque "
        "then has a root mean square error of {value:.2f} Nm/kg, as people on force plates showed; the bands contain it.",
        "Force plates measure the shear.",
        "Nm/kg",
    ),
    "forces-gain": Kind(
        "info",
        "forces",
        "The soles' forces were scaled to the body's weight: {where}.",
        "Gains far from 1 ask for a calibration of the soles, or another mass of the subject.",
        "%",
    ),
    "forces-outside-range": Kind(
        "warning",
        "forces",
        "This walk is none of those that the template of the shear was made from ({where}): the force was taken to pass "
        "through a fixed point above the centre of mass, which is less exact.",
        "Ask for an ordinary walk on level ground, or use force plates.",
    ),
    "forces-indicative": Kind(
        "warning",
        "forces",
        "Torques of a landing are indicative only: the knee's error is about {value:.2f} Nm/kg even with perfect soles.",
        "Use force plates for landings.",
        "Nm/kg",
    ),
    "forces-one-foot": Kind(
        "info",
        "forces",
        "The {where} foot carries nothing in the whole trial: its torques are those of a leg in the air.",
        "If it stood on the ground, check that the sole records, and that its columns are declared in the card.",
    ),
    "forces-missing": Kind(
        "serious",
        "forces",
        "There are no forces and no torques: {where}.",
        "Look at the findings about the pressure stream and the movement.",
    ),
    "torque-mass-missing": Kind(
        "warning",
        "forces",
        "There are no torques, because the subject's mass is not known. Angles don't depend on it.",
        "Give the mass with the session.",
    ),
    "residuals-high": Kind(
        "warning",
        "dynamics",
        "Movement and forces disagree by {value:.0f} % of the body's weight, which would have to push at the pelvis: the "
        "torques are off by more than usual.",
        "Check the subject's mass, the soles' clock, and that nothing else carries the body (hands, a chair).",
        "% of weight",
    ),
}
