"""The findings about carved parts: a part of the table in :mod:`gonio.pipeline.findings`."""

from gonio.pipeline.finding_kind import Kind

CARVING_KINDS: dict[str, Kind] = {
    "hull-overlap-low": Kind(
        "warning",
        "carving",
        "The solid of {where} covers its mask to {value:.0f} % only: the masks of the pictures, or the motion between them, "
        "don't fit together.",
        "Look at the masks first: a piece that is missing in one of them is carved away in all. Then at the motion of the "
        "part and its parents: marks, noise_px, ambiguous.",
        "%",
    ),
    "picture-misfits": Kind(
        "warning",
        "carving",
        "Part {where} is what does not fit: without this picture, the solid covers the other masks to {value:.0f} % at least.",
        "Mend this mask, or the marks of the part in this picture.",
        "%",
    ),
    "part-not-carved": Kind(
        "info",
        "carving",
        "Part {where} has no masks: it was solved, but not carved.",
        "Give masks of the part in two pictures or more: masks/PART/PICTURE.png.",
    ),
    "part-without-colours": Kind(
        "info",
        "carving",
        "Part {where} is grey: the photographs are not in the folder.",
        "Put them into pictures/, named as in the calibration.",
    ),
}
