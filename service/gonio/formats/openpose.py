"""The keypoint names of OpenPose, which is the convention of Pose2Sim too: ``RBigToe`` is gonio's ``right_big_toe``."""

import re
from collections.abc import Iterable

BODY_25B = (
    *("Nose", "LEye", "REye", "LEar", "REar", "LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist"),
    *("LHip", "RHip", "LKnee", "RKnee", "LAnkle", "RAnkle", "Neck", "Head"),
    *("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"),
)
"""The keypoints of the model BODY_25B, in the order of its files."""


def gonio_names(theirs: Iterable[str]) -> tuple[str, ...]:
    """Give keypoints of OpenPose the names that gonio uses everywhere; names that are gonio's already stay as they are."""
    return tuple(_rename(name) for name in theirs)


def _rename(name: str) -> str:
    side = {"L": "left_", "R": "right_"}.get(name[0], "") if re.match("[LR][A-Z]", name) else ""
    return side + re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name[1:] if side else name).lower()
