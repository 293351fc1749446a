"""What a background can fail to tell: each refusal by its code."""

from gonio.errors import CaptureError

REFUSALS = {
    "background-pictures-apart": (
        "too few background points tie its picture to the others",
        "Mark ten points or more that it shares with another picture, all around the object.",
    ),
    "background-two-answers": (
        "its points lie in one plane, or nearly, and two different places of the camera explain them equally well",
        "Take one more picture, from closer or from elsewhere, or mark points that are not in that plane.",
    ),
    "background-camera-static": (
        "the camera only turned or zoomed, or looked straight at a plane, so that no depth can be told",
        "Take the pictures from different places, and those of a flat background at different slants.",
    ),
    "background-not-solved": (
        "no camera explains the background's points",
        "Check that the points of one name are the same thing in each picture, and that nothing of the background moved.",
    ),
    "background-not-observable": (
        "these points do not tell where the camera was",
        "Mark more points all around the object, near and far and at several heights, take pictures from more directions, "
        "or give the focal lengths.",
    ),
    "floor-points-collinear": ("the floor's points lie on one line", "Mark a point of the floor beside that line."),
    "background-measure-unseen": (
        "a point that gives the measure is not seen in two pictures, or was not believed",
        "Mark it in more pictures, and check its marks.",
    ),
}
"""Each refusal's code, its reason, and its remedy."""


def refuse(code: str, where: str = "") -> CaptureError:
    """Make the error by its code."""
    reason, remedy = REFUSALS[code]
    return CaptureError(f"Background{', ' + where if where else ''}: {reason}.", hint=remedy, code=code)
