"""Keypoints that were found elsewhere: OpenPose's JSON files, one a frame, which Pose2Sim writes and reads too.

The files of one camera come as a ZIP archive or as a folder. Their names end in a frame number
(``cam01_000000000042_keypoints.json``), and each holds the people of that frame::

    {"people": [{"pose_keypoints_2d": [u, v, confidence, u, v, confidence, …]}, …]}

A keypoint that was not found is 0, 0, 0. Pixels are taken to be counted from the centre of the top-left pixel, as OpenCV
does. The files do not name their keypoints: :data:`LAYOUTS` has the orders that are known.
"""

import json
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records import record

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


_COCO_17 = BODY_25B[:17]

LAYOUTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "body25b": gonio_names(BODY_25B),
        "coco17": gonio_names(_COCO_17),
        "halpe26": gonio_names(
            (*_COCO_17, "Head", "Neck", "Hip", "LBigToe", "RBigToe", "LSmallToe", "RSmallToe", "LHeel", "RHeel")
        ),
        "blazepose33": (
            *(
                "nose",
                "left_eye_inner",
                "left_eye",
                "left_eye_outer",
                "right_eye_inner",
                "right_eye",
                "right_eye_outer",
            ),
            *("left_ear", "right_ear", "mouth_left", "mouth_right"),
            *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
            *("left_pinky", "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb"),
            *("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
            *("left_heel", "right_heel", "left_foot_index", "right_foot_index"),
        ),
    }
)
"""The keypoints of each known layout, in the order of its files, in gonio's names."""

AMBIGUOUS_LAYOUTS = ("body25b",)
"""Layouts that their number of keypoints doesn't tell: OpenPose's BODY_25 has 25 too, in another order."""

MOST_FRAMES = 1_000_000
MOST_FRAME_BYTES = 2_000_000
"""What a file of one frame may unpack to: a hundred people with faces and hands take less."""

_FRAME_NUMBER = re.compile(r"(\d+)(?:_keypoints)?\.json$", re.IGNORECASE)


@record
class PoseFile:
    """The keypoints of everybody in one camera's frames, pixels; empty places and keypoints not found are NaN.

    Who is in which place may change from frame to frame and means nothing.
    """

    uv_px: Float[np.ndarray, "frame place keypoint 2"]
    confidence: Float[np.ndarray, "frame place keypoint"]


def holds_poses(folder: Path) -> bool:
    """Say whether a folder looks like one camera's files: two or more whose names end in a frame number and .json."""
    return sum(bool(_FRAME_NUMBER.search(file.name)) for file in folder.iterdir()) > 1


def count_frames(path: Path) -> int:
    """Give how many frames an archive or a folder covers, without reading them.

    Raises:
        InputError: As :func:`read_poses`.
    """
    numbers = [number for number, _ in _members(path)]
    return max(numbers) - min(numbers) + 1


def keypoint_count(path: Path) -> int:
    """Give how many keypoints the people in an archive or a folder have; 0 if nobody is in any frame.

    Raises:
        InputError: As :func:`read_poses`.
    """
    return next((len(person) for _, people in _frames(path) for person in people), 0)


def read_poses(path: Path, layout: str) -> PoseFile:
    """Read one camera's keypoints from a ZIP archive or a folder of OpenPose's JSON files.

    Frames are counted from the smallest number in the files' names; a frame without a file holds nobody.

    Raises:
        InputError: ``poses-unreadable``: no archive, no files in it, or a file that is no keypoint file; the message names
            it. ``poses-layout-wrong``: the number of keypoints is not the layout's.
    """
    wanted = len(LAYOUTS[layout])
    frames = dict(_frames(path))
    first, count = min(frames), max(frames) - min(frames) + 1
    places = max(1, max(len(people) for people in frames.values()))
    values = np.full((count, places, wanted, 3), np.nan)
    for number, people in frames.items():
        for place, person in enumerate(people):
            if len(person) != wanted:
                raise InputError(
                    f"{path.name} has {len(person)} keypoints in frame {number}; the layout {layout} has {wanted}.",
                    hint=f"Name the layout as `keypoints.layout`: {describe_layouts()}.",
                    code="poses-layout-wrong",
                )
            values[number - first, place] = person
    confidence = values[..., 2]
    lost = ~(confidence > 0) | ~np.isfinite(values).all(axis=-1)
    values[lost] = np.nan
    return PoseFile(uv_px=values[..., :2], confidence=np.where(lost, 0.0, np.clip(confidence, 0.0, 1.0)))


def write_poses(
    path: Path, uv_px: Float[np.ndarray, "frame keypoint 2"], confidence: Float[np.ndarray, "frame keypoint"]
) -> None:
    """Write one person's keypoints as a ZIP archive of OpenPose's JSON files; NaN becomes 0, 0, 0."""
    values = np.concatenate([uv_px, confidence[..., None]], axis=-1)
    values[~np.isfinite(values).all(axis=-1)] = 0.0
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, frame in enumerate(values.round(3)):
            people = [{"pose_keypoints_2d": frame.ravel().tolist()}] if frame.any() else []
            archive.writestr(f"{path.stem}_{number:012d}_keypoints.json", json.dumps({"people": people}))


def describe_layouts() -> str:
    """List the layouts with their numbers of keypoints, for messages."""
    return ", ".join(f"{name} ({len(names)})" for name, names in LAYOUTS.items())


def _members(path: Path) -> list[tuple[int, str]]:
    """List the frames' files with their numbers, checked but not read."""
    if path.is_dir():
        sizes = {file.name: file.stat().st_size for file in path.iterdir() if file.is_file()}
    else:
        try:
            with zipfile.ZipFile(path) as archive:
                sizes = {info.filename: info.file_size for info in archive.infolist() if not info.is_dir()}
        except (zipfile.BadZipFile, OSError) as error:
            raise _unreadable(path, f"it is no ZIP archive ({error})") from error
    found = [(int(match[1]), name) for name in sizes if (match := _FRAME_NUMBER.search(name))]
    if not found:
        raise _unreadable(path, "it holds no file whose name ends in a frame number and .json")
    numbers = {number for number, _ in found}
    if len(numbers) < len(found):
        raise _unreadable(path, "two of its files have the same frame number: it must hold one camera only")
    if max(numbers) - min(numbers) >= MOST_FRAMES:
        raise _unreadable(path, f"its frame numbers run from {min(numbers)} to {max(numbers)}")
    large = max(sizes[name] for _, name in found)
    if large > MOST_FRAME_BYTES:
        raise _unreadable(path, f"a file of one frame unpacks to {large} bytes; {MOST_FRAME_BYTES} are allowed")
    return sorted(found)


def _frames(path: Path) -> Iterator[tuple[int, list[list[list[float]]]]]:
    """Give each frame's number and people, a person being a list of (u, v, confidence)."""
    members = _members(path)
    if path.is_dir():
        for number, name in members:
            yield number, _people(path, name, (path / name).read_bytes())
        return
    with zipfile.ZipFile(path) as archive:
        for number, name in members:
            try:
                content = archive.read(name)
            except (zipfile.BadZipFile, RuntimeError, NotImplementedError, OSError, ValueError) as error:
                raise _unreadable(path, f"{name} can't be unpacked ({error})") from error
            yield number, _people(path, name, content)


def _people(path: Path, name: str, content: bytes) -> list[list[list[float]]]:
    try:
        document = json.loads(content)
        flat = [[float(value) for value in person["pose_keypoints_2d"]] for person in document["people"]]
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise _unreadable(path, f"{name} is no keypoint file of OpenPose ({type(error).__name__}: {error})") from error
    if any(len(person) % 3 for person in flat):
        raise _unreadable(path, f"{name} has a person whose numbers are no triples of u, v and confidence")
    return [[person[i : i + 3] for i in range(0, len(person), 3)] for person in flat if person]


def _unreadable(path: Path, reason: str) -> InputError:
    return InputError(
        f"The keypoints {path.name} can't be read: {reason}.",
        hint="Give a ZIP archive of one camera's OpenPose files, one a frame, such as cam01_000000000042_keypoints.json.",
        code="poses-unreadable",
    )
