"""Find and follow everybody in all cameras.

Each camera follows its people on its own, a crop a person, and looks now and then for others. Who is who among the cameras,
and who is the subject, is told afterwards by geometry, over the whole trial (:mod:`gonio.kernel.triangulation.people`).
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np

from gonio.records import Capture, Sightings
from gonio.vision.blazepose import LandmarkModel, PersonDetector, PersonLandmarks
from gonio.vision.frame import Frame
from gonio.vision.tracking import PersonTracker, is_same_person
from gonio.vision.video import iterate_frames

MOST_PEOPLE = 4
"""So many people are followed in a camera: each costs a crop a look, and the subject is among the largest few."""

OnFrame = Callable[[int, int, Frame], None]
"""Hears a frame's index on the trial's clock, the camera's index, and the frame."""

SEARCH_LOOKS = 30
"""A camera that follows somebody looks for others in every so-many-th look: the detector costs about one crop."""

RETRY_LOOKS = 5
"""A camera that follows nobody, or that has just lost somebody, looks for people this often."""


def track_people(
    capture: Capture,
    detector: PersonDetector,
    landmarks: LandmarkModel,
    keypoint_names: tuple[str, ...],
    *,
    stride: int = 1,
    workers: int,
    on_progress: Callable[[float], None],
    on_frame: OnFrame = lambda _index, _camera, _frame: None,
) -> Sightings:
    """Find the keypoints of everybody in every frame of every camera.

    The frames are streamed: memory grows with the keypoints only. Cameras are decoded and searched side by side on
    ``workers`` threads.

    Args:
        capture: The videos, matched to calibrated cameras.
        detector: Finds people.
        landmarks: Finds the keypoints of one person.
        keypoint_names: The names of the keypoints, in the network's order.
        stride: Look for keypoints in every so-many-th frame only, and in the last one; the frames between are decoded and
            passed over.
        workers: Threads; the networks release the interpreter's lock.
        on_progress: Hears the share that is done after each frame; may raise to stop the work.
        on_frame: Hears each frame's index, its camera and the frame; in the threads, a camera's frames in order.
    """
    count = capture.frame_count
    uv_px = np.full((len(capture.views), count, MOST_PEOPLE, len(keypoint_names), 2), np.nan)
    confidence = np.zeros(uv_px.shape[:4])
    cameras = [CameraPeople(detector, landmarks) for _ in capture.views]
    readers = _readers(capture)
    with ThreadPoolExecutor(workers) as pool:
        for index in range(count):
            look = index % stride == 0 or index == count - 1

            def read_and_look(camera: int, index: int = index, look: bool = look) -> list[PersonLandmarks]:
                frame = next(readers[camera])
                on_frame(index, camera, frame)
                return cameras[camera].look(frame) if look else []

            for camera, people in enumerate(pool.map(read_and_look, range(len(readers)))):
                for place, person in enumerate(people):
                    uv_px[camera, index, place] = person.uv_px
                    confidence[camera, index, place] = person.visibility
            on_progress((index + 1) / count)
    return Sightings(
        camera_names=capture.rig.names,
        keypoint_names=keypoint_names,
        timebase=capture.timebase,
        uv_px=uv_px,
        confidence=confidence,
        stride=stride,
    )


def leaf_through(capture: Capture, on_frame: OnFrame, on_progress: Callable[[float], None]) -> None:
    """Decode the videos and pass their frames on, looking for nobody: a camera after the other."""
    readers = _readers(capture)
    for camera, reader in enumerate(readers):
        for index, frame in enumerate(islice(reader, capture.frame_count)):
            on_frame(index, camera, frame)
            on_progress((camera + (index + 1) / capture.frame_count) / len(readers))


def _readers(capture: Capture) -> list[Iterator[Frame]]:
    """Open the videos: each camera's frames on the trial's clock."""
    paths = [view.path for view in capture.views if view.path is not None]
    return [
        islice(iterate_frames(path), 0, None, view.frame_step) for path, view in zip(paths, capture.views, strict=True)
    ]


class CameraPeople:
    """Follows everybody in one camera."""

    def __init__(self, detector: PersonDetector, landmarks: LandmarkModel) -> None:
        self._detector, self._landmarks = detector, landmarks
        self._trackers: list[PersonTracker] = []
        self._looks_to_search = 0
        self._retries = 0

    def look(self, frame: Frame) -> list[PersonLandmarks]:
        """Find everybody in the next frame that is looked at; nobody twice."""
        people: list[PersonLandmarks] = []
        kept: list[PersonTracker] = []
        for tracker in self._trackers:
            person = tracker.follow(frame)
            twice = person is not None and any(is_same_person(person, other) for other in people)
            if tracker.region is not None and not twice:
                kept.append(tracker)
                people += [person] if person is not None else []
        if len(kept) < len(self._trackers):
            self._retries = SEARCH_LOOKS // RETRY_LOOKS
            self._looks_to_search = min(self._looks_to_search, RETRY_LOOKS)
        self._trackers = kept
        self._looks_to_search -= 1
        if self._looks_to_search < 0 and len(kept) < MOST_PEOPLE:
            people += self._search(frame, people)
        return people

    def _search(self, frame: Frame, people: Sequence[PersonLandmarks]) -> list[PersonLandmarks]:
        """Start to follow those who are not followed yet."""
        finder = PersonTracker(self._detector, self._landmarks)
        known = [tracker.region for tracker in self._trackers if tracker.region is not None]
        found = [one for one in finder.candidates(frame, known) if not any(is_same_person(one, p) for p in people)]
        found = found[: MOST_PEOPLE - len(self._trackers)]
        for person in found:
            tracker = PersonTracker(self._detector, self._landmarks)
            tracker.start(person)
            self._trackers.append(tracker)
        self._retries = 0 if found else max(self._retries - 1, 0)
        often = not self._trackers or self._retries > 0
        self._looks_to_search = (RETRY_LOOKS if often else SEARCH_LOOKS) - 1
        return found
