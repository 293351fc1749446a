"""Stage ``keypoints``: everybody's keypoints in every frame of every camera, and who of them is the subject."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import CaptureError, InputError
from gonio.formats.openpose import AMBIGUOUS_LAYOUTS, LAYOUTS, describe_layouts, keypoint_count, read_poses
from gonio.kernel.triangulation.choice import choose_subject, rank_people
from gonio.kernel.triangulation.people import find_people
from gonio.pipeline.album import Album
from gonio.pipeline.findings import finding
from gonio.pipeline.moments import longest_stretch, worst_moment
from gonio.pipeline.params import KeypointParameters, LookRate, Parameters
from gonio.pipeline.run import Outcome, Progress
from gonio.records import Capture, Finding, ImagePoints, Person, Sightings, record
from gonio.vision.blazepose import LandmarkModel, PersonDetector
from gonio.vision.model_cards import load_card
from gonio.vision.people import leaf_through, track_people
from gonio.vision.sessions import available_cores, open_session
from gonio.vision.weights import default_cache_dir, ensure_weights

DETECTOR = "blazepose_detector"
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

    ``networks`` are the cards of the networks that found them, the landmarks' last; none for keypoints that were uploaded.
    ``pictures`` are JPEG files of frame ``picture_frame``, in the order of the cameras; ``picture_scale`` is their size against
    the video's. ``previews`` are small videos with a picture for each look. Both are empty where no videos were uploaded.
    ``people`` is everybody who was found, in the order of being the subject
    (:func:`gonio.kernel.triangulation.choice.rank_people`), ``subject`` the index of the one whose ``points`` these are; nobody
    where keypoints came without a choice.
    """

    points: ImagePoints
    networks: tuple[str, ...]
    pictures: tuple[Path, ...]
    picture_frame: int
    picture_scale: tuple[float, ...]
    previews: tuple[Path, ...] = ()
    people: tuple[Person, ...] = ()
    subject: int = 0

    @property
    def seen(self) -> Bool[np.ndarray, "camera look"]:
        """In which of the frames that were looked at a camera saw the subject."""
        return np.asarray(np.isfinite(self.points.sampled.uv_px[..., 0]).any(axis=-1))

    @property
    def look_times_s(self) -> Float[np.ndarray, " look"]:
        """When the cameras were looked at."""
        looks = self.points.sampled
        return looks.timebase.times_s(looks.uv_px.shape[1])


def find_keypoints(
    capture: Capture, parameters: Parameters, output_dir: Path, progress: Progress
) -> Outcome[Keypoints]:
    """Find everybody's keypoints, or take those that were uploaded, and choose the subject.

    A picture and a preview of each camera's video go to ``output_dir``.

    Raises:
        ResourceError: ``weights-missing``: the network's weights were never fetched, and can't be now.
        CaptureError: ``nobody-found``: no person was ever seen by two cameras; ``person-unknown``: nor the one asked for.
        InputError: A video can't be decoded to its end; the message names it and the frame. Or what the reader of keypoint
            files says.
    """
    asked = parameters.keypoints
    stride = look_stride(capture.timebase.rate_hz, asked.rate)
    with Album(capture, stride, output_dir) as album:
        if capture.views[0].poses is None:
            networks = (DETECTOR, asked.model)
            sightings = look_at_videos(capture, asked.model, stride, album, progress)
            least = MIN_VISIBILITY
        else:
            networks = ()
            sightings = read_sightings(capture, asked)
            least = parameters.reconstruction.min_confidence
            if all(view.path is not None for view in capture.views):
                leaf_through(capture, album.add, progress)
    people = rank_people(capture.rig, find_people(capture.rig, sightings, least))
    if not people:
        raise CaptureError(
            "Nobody was found in these videos: no person was seen by two cameras at once.",
            hint="Check that the videos belong to this calibration and show a whole person, standing upright, "
            "who fills at least a fifth of the picture's height.",
            code="nobody-found",
        )
    subject = choose_subject(people, asked.person)
    keypoints = Keypoints(
        points=subject.points,
        networks=networks,
        pictures=album.pictures,
        picture_frame=album.middle,
        picture_scale=album.scales,
        previews=album.previews,
        people=tuple(people),
        subject=[person is subject for person in people].index(True),
    )
    findings = [
        lost_subject(name, seen, keypoints.look_times_s)
        for name, seen in zip(capture.rig.names, keypoints.seen, strict=True)
        if seen.mean() < 0.9
    ]
    if len(people) > 1:
        findings.append(tell_bystanders(people, keypoints.subject))
    return Outcome(keypoints, tuple(findings))


def lost_subject(name: str, seen: Bool[np.ndarray, " look"], times_s: Float[np.ndarray, " look"]) -> Finding:
    """Tell of a camera that did not see the subject for some time."""
    share, span_s = 100 * (1 - float(seen.mean())), longest_stretch(~seen, times_s)
    return finding("camera-lost-subject", camera=name, value=share, span_s=span_s)


def look_at_videos(capture: Capture, model: str, stride: int, album: Album, progress: Progress) -> Sightings:
    """Find everybody in the videos with gonio's own networks."""
    card, detector_card = load_card(model), load_card(DETECTOR)
    assert card.keypoints is not None  # a landmark card has them: its own check
    cache_dir = default_cache_dir()
    return track_people(
        capture,
        PersonDetector(detector_card, open_session(ensure_weights(detector_card, cache_dir))),
        LandmarkModel(card, open_session(ensure_weights(card, cache_dir))),
        card.keypoints.names,
        stride=stride,
        workers=available_cores(),
        on_progress=progress,
        on_frame=album.add,
    )


def read_sightings(capture: Capture, asked: KeypointParameters) -> Sightings:
    """Take everybody's keypoints from uploaded files.

    Raises:
        InputError: ``poses-layout-unknown``: nothing tells which keypoints they are; or what the reader says.
    """
    paths = [view.poses for view in capture.views if view.poses is not None]
    layout = asked.layout or _layout_of(paths)
    poses = [read_poses(path, layout) for path in paths]
    count, places = capture.frame_count, max(pose.uv_px.shape[1] for pose in poses)
    uv_px = np.full((len(poses), count, places, len(LAYOUTS[layout]), 2), np.nan)
    confidence = np.zeros(uv_px.shape[:4])
    for camera, (pose, view) in enumerate(zip(poses, capture.views, strict=True)):
        own = pose.uv_px.shape[1]
        uv_px[camera, :, :own] = pose.uv_px[:: view.frame_step][:count]
        confidence[camera, :, :own] = pose.confidence[:: view.frame_step][:count]
    return Sightings(
        camera_names=capture.rig.names,
        keypoint_names=LAYOUTS[layout],
        timebase=capture.timebase,
        uv_px=uv_px,
        confidence=confidence,
    )


def _layout_of(paths: Sequence[Path]) -> str:
    counts = {keypoint_count(path) for path in paths} - {0}
    fitting = [name for name, names in LAYOUTS.items() if {len(names)} == counts and name not in AMBIGUOUS_LAYOUTS]
    if len(fitting) == 1:
        return fitting[0]
    found = " and ".join(map(str, sorted(counts))) or "no"
    raise InputError(
        f"The keypoint files hold people of {found} keypoints; which ones is not known.",
        hint=f"Start the analysis with the parameter keypoints.layout: {describe_layouts()}.",
        code="poses-layout-unknown",
    )


def tell_bystanders(people: Sequence[Person], subject: int) -> Finding:
    """Tell how many others there were, how near the nearest of them came, and by which rule the subject was chosen."""
    own = people[subject].centre_lab_m[:, [0, 2]]
    apart_m = [
        np.linalg.norm(own - other.centre_lab_m[:, [0, 2]], axis=1) for i, other in enumerate(people) if i != subject
    ]
    nearest = np.fmin.reduce(apart_m)
    nearest_m = float(np.nanmin(nearest)) if np.isfinite(nearest).any() else np.inf
    where = f"person {subject + 1} of {len(people)}; the nearest other came to {nearest_m:.1f} m"
    if not np.isfinite(nearest_m):
        where = f"person {subject + 1} of {len(people)}; the others were never there at the same time"
    times_s = people[subject].points.timebase.times_s(len(nearest))
    return finding("bystanders", where=where, value=len(people) - 1, span_s=worst_moment(-nearest, times_s))
