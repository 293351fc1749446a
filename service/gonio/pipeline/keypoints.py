"""Stage ``keypoints``: everybody's keypoints in every frame of every camera, and who of them is the subject."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from gonio.errors import CaptureError
from gonio.kernel.triangulation.choice import choose_subject, rank_people
from gonio.kernel.triangulation.people import find_people
from gonio.pipeline.findings import finding
from gonio.pipeline.params import KeypointParameters, LookRate
from gonio.pipeline.run import Outcome, Progress
from gonio.records import Capture, Finding, ImagePoints, Person, record
from gonio.vision.blazepose import LandmarkModel, PersonDetector
from gonio.vision.frame import Frame
from gonio.vision.model_cards import load_card
from gonio.vision.people import track_people
from gonio.vision.pictures import encode_jpeg
from gonio.vision.sessions import available_cores, open_session
from gonio.vision.weights import default_cache_dir, ensure_weights

DETECTOR = "blazepose_detector"
PICTURE_SIDE_PX = 960
MIN_VISIBILITY = 0.5
"""Landmarks that the network takes for hidden prove nothing about who it is."""

LOOKS_HZ: dict[LookRate, float] = {"exact": 60.0, "default": 30.0, "fast": 20.0}
"""How often a camera is looked at. A detector's errors last for a tenth of a second: more looks mostly repeat them."""


def look_stride(rate_hz: float, rate: LookRate) -> int:
    """Give which frames of a video are looked at: every so-many-th."""
    return max(1, int(rate_hz / LOOKS_HZ[rate] + 1e-3))


@record
class Keypoints:
    """The subject's keypoints, everybody's, and a still frame of each camera to show them on.

    ``networks`` are the cards of the networks that found them, the landmarks' last; none for keypoints of the virtual
    laboratory. ``pictures`` are JPEG files of frame ``picture_frame``, in the order of the cameras; ``picture_scale`` is their
    size against the video's. ``people`` is everybody who was found, in the order of being the subject
    (:func:`gonio.kernel.triangulation.choice.rank_people`), ``subject`` the index of the one whose ``points`` these are; nobody
    where keypoints came without a choice.
    """

    points: ImagePoints
    networks: tuple[str, ...]
    pictures: tuple[Path, ...]
    picture_frame: int
    picture_scale: tuple[float, ...]
    people: tuple[Person, ...] = ()
    subject: int = 0

    @property
    def seen(self) -> Bool[np.ndarray, "camera look"]:
        """In which of the frames that were looked at a camera saw the subject."""
        return np.asarray(np.isfinite(self.points.sampled.uv_px[..., 0]).any(axis=-1))


def find_keypoints(
    capture: Capture, parameters: KeypointParameters, output_dir: Path, progress: Progress
) -> Outcome[Keypoints]:
    """Find everybody's keypoints and the subject; a picture of each camera goes to ``output_dir``.

    Raises:
        ResourceError: ``weights-missing``: the network's weights were never fetched, and can't be now.
        CaptureError: ``nobody-found``: no person was ever seen by two cameras; ``person-unknown``: nor the one asked for.
        InputError: A video can't be decoded to its end; the message names it and the frame.
    """
    card, detector_card = load_card(parameters.model), load_card(DETECTOR)
    assert card.keypoints is not None  # a landmark card has them: its own check
    cache_dir, workers = default_cache_dir(), available_cores()
    detector = PersonDetector(detector_card, open_session(ensure_weights(detector_card, cache_dir)))
    landmarks = LandmarkModel(card, open_session(ensure_weights(card, cache_dir)))
    middle = capture.frame_count // 2
    pictures: list[Path] = []
    scales: list[float] = []

    def keep_pictures(index: int, frames: Sequence[Frame]) -> None:
        if index != middle:
            return
        folder = output_dir / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        for view, frame in zip(capture.views, frames, strict=True):
            rgb = frame.rgb(PICTURE_SIDE_PX)
            path = folder / f"{view.camera_name}.jpg"
            path.write_bytes(encode_jpeg(rgb))
            pictures.append(path)
            scales.append(rgb.shape[1] / view.image_size_px[0])

    sightings = track_people(
        capture,
        detector,
        landmarks,
        card.keypoints.names,
        stride=look_stride(capture.timebase.rate_hz, parameters.rate),
        workers=workers,
        on_progress=progress,
        on_frames=keep_pictures,
    )
    people = rank_people(capture.rig, find_people(capture.rig, sightings, MIN_VISIBILITY))
    if not people:
        raise CaptureError(
            "Nobody was found in these videos: no person was seen by two cameras at once.",
            hint="Check that the videos belong to this calibration and show a whole person, standing upright, "
            "who fills at least a fifth of the picture's height.",
            code="nobody-found",
        )
    subject = choose_subject(people, parameters.person)
    keypoints = Keypoints(
        points=subject.points,
        networks=(DETECTOR, parameters.model),
        pictures=tuple(pictures),
        picture_frame=middle,
        picture_scale=tuple(scales),
        people=tuple(people),
        subject=[person is subject for person in people].index(True),
    )
    findings = [
        finding("camera-lost-subject", where=name, value=100 * (1 - float(seen.mean())))
        for name, seen in zip(capture.rig.names, keypoints.seen, strict=True)
        if seen.mean() < 0.9
    ]
    if len(people) > 1:
        findings.append(tell_bystanders(people, keypoints.subject))
    return Outcome(keypoints, tuple(findings))


def tell_bystanders(people: Sequence[Person], subject: int) -> Finding:
    """Tell how many others there were, how near the nearest of them came, and by which rule the subject was chosen."""
    own = people[subject].centre_lab_m[:, [0, 2]]
    apart_m = [
        np.linalg.norm(own - other.centre_lab_m[:, [0, 2]], axis=1) for i, other in enumerate(people) if i != subject
    ]
    together = [apart[np.isfinite(apart)] for apart in apart_m]
    nearest_m = min((float(apart.min()) for apart in together if apart.size), default=np.inf)
    where = f"person {subject + 1} of {len(people)}; the nearest other came to {nearest_m:.1f} m"
    if not np.isfinite(nearest_m):
        where = f"person {subject + 1} of {len(people)}; the others were never there at the same time"
    return finding("bystanders", where=where, value=len(people) - 1)
