"""The findings about pressure soles and force plates: a part of the table in :mod:`gonio.pipeline.findings`."""

from gonio.pipeline.finding_kind import Kind

SENSOR_KINDS: dict[str, Kind] = {
    "pressure-samples-doubled": Kind(
        "info",
        "sensors",
        "{value:g sample|samples} of the pressure stream with the time stamp of the one before: left out.",
        "Export the time stamps with all their digits.",
        "samples",
    ),
    "pressure-below-zero": Kind(
        "info",
        "sensors",
        "{value:.0f} % of the soles' values were below zero, by noise or drift, and became zero.",
        "Set the soles' zero with the feet in the air before each trial.",
        "%",
    ),
    "plates-over-soles": Kind(
        "info",
        "sensors",
        "There are force plates and pressure soles: where a plate measured a foot, it takes precedence.",
        "Nothing to do.",
    ),
    "pressure-synchronized": Kind(
        "info",
        "pressure",
        "The soles' clock runs {value:+.0f} ms ahead of the video's ({where}); this was found from the walk and taken out.",
        "A common trigger makes it exact: then ask for forces.synchronization = hardware.",
        "ms",
    ),
    "pressure-clock-doubtful": Kind(
        "warning",
        "pressure",
        "How far the soles' clock runs ahead of the video's is known to ±{value:.0f} ms only ({where}): forces at contact and "
        "push-off are uncertain.",
        "Trigger soles and cameras together, or record more steps.",
        "ms",
    ),
    "pressure-not-synchronized": Kind(
        "serious",
        "pressure",
        "The pressure stream was not used: {where}.",
        "Is it the stream of this trial and this person? Start both clocks within a quarter of a second (time.zero in the "
        "card), record at least three steps, or trigger both and ask for forces.synchronization = hardware.",
    ),
    "pressure-clock-idle": Kind(
        "info",
        "pressure",
        "The subject stands so still that nothing depends on the soles' clock, and nothing shows it either: it was taken to be "
        "the video's.",
        "Make sure that the stream is of this trial: standing still can't show it.",
    ),
    "pressure-foot-silent": Kind(
        "serious",
        "pressure",
        "The pressure stream was not used: the {where} sole shows no load in the whole trial, and the other one carries too "
        "little for the movement in {value:.0f} % of it.",
        "Check that both soles were on and record, and that the card names the right columns: what the ground does to the body "
        "is known from both feet only.",
        "%",
    ),
    "pressure-feet-swapped": Kind(
        "serious",
        "pressure",
        "The pressure stream was not used: the right sole's loads fit the steps of the left foot, and the left one's those of "
        "the right foot.",
        "Exchange right and left in the pressure card, and check that the stream is of this trial.",
    ),
    "pressure-hardware-late": Kind(
        "warning",
        "pressure",
        "The soles were said to run on the video's clock, but the walk says that they run {value:+.0f} ms ahead.",
        "Check the trigger and its cable; ask for forces.synchronization = estimate to have it taken out.",
        "ms",
    ),
    "pressure-hardware-unconfirmed": Kind(
        "warning",
        "pressure",
        "The soles were said to run on the video's clock; the walk does not confirm it: {where}.",
        "Is it the stream of this trial and this person? Standing still can't confirm a clock: then all is well.",
    ),
    "pressure-gaps": Kind(
        "warning",
        "pressure",
        "In {value:.0f} % of the trial nothing is known of the pressure: samples were lost, or the stream does not cover it.",
        "Check batteries and radio; record soles and cameras for the same time.",
        "%",
    ),
    "pressure-rate-low": Kind(
        "warning",
        "pressure",
        "The soles give {value:.0f} samples a second: contacts are known to {where} only.",
        "Record at 20 Hz or more; 50 Hz is plenty.",
        "Hz",
    ),
    "pressure-saturated": Kind(
        "warning",
        "pressure",
        "The {where} sole could not show its force in {value:.0f} % of its contacts: it is more than what was taken.",
        "Use soles for heavier people, or a wider range.",
        "%",
    ),
    "pressure-not-zero": Kind(
        "warning",
        "pressure",
        "The {where} sole shows {value:.0f} N while the foot is in the air: it has drifted, or the shoe is tied too tightly.",
        "Set the soles' zero with the feet in the air before each trial.",
        "N",
    ),
    "pressure-uncalibrated": Kind(
        "warning",
        "pressure",
        "The soles are not calibrated: their counts were taken as proportional to force, and scaled to the body's weight.",
        "Calibrate the soles, and declare the unit in the card.",
    ),
    "pressure-gain": Kind(
        "warning",
        "pressure",
        "In the mean the soles show {value:.0f} % of the body's weight.",
        "Calibrate the soles; check the subject's mass, that the soles cover the whole foot, and that the stream is this "
        "subject's.",
        "%",
    ),
    "plates-not-used": Kind(
        "warning",
        "pressure",
        "No contact of the force plates belongs to a foot in the video: they were not used.",
        "Check that cameras and plates share one lab frame and one clock, and that the trial steps on the plates.",
    ),
    "plates-shared": Kind(
        "warning",
        "pressure",
        "For {value:.1f} s both feet stood on one plate, which then tells of neither.",
        "Have each plate stepped on by one foot.",
        "s",
    ),
}
