"""Follow the subject through all cameras at once.

One camera can't tell the subject from a bystander; the cameras together can. At the start, and after a loss, the people
found in each camera are matched by geometry (:mod:`gonio.kernel.triangulation.association`); in between, each camera follows
on its own and the geometry watches that all of them still follow the same person.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
from jaxtyping import Float

from gonio.errors import CaptureError
from gonio.kernel.geometry.cameras import undistort
from gonio.kernel.triangulation.association import SAME_PERSON_M, associate_people, choose_subject, meet
from gonio.records import Capture, ImagePoints, Rig, record
from gonio.vision.blazepose import LandmarkModel, PersonDetector, PersonLandmarks
from gonio.vision.frame import Frame
from gonio.vision.tracking import PersonTracker
from gonio.vision.video import iterate_frames

MIN_VISIBILITY = 0.5
"""Landmarks that the network takes for hidden prove nothing about who it is."""

SOMEBODY_ELSE_M = 2 * SAME_PERSON_M
"""A camera that misses the person by this much follows somebody else: limbs that it confuses for some frames miss less."""

RETRY_FRAMES = 5
"""A camera that has lost the subject looks for it in every fifth frame: finding costs three times as much as following."""


@record
class TrackedSubject:
    """The subject in all cameras, and how many people were in view when it was chosen."""

    points: ImagePoints
    people_in_view: int


def track_subject(
    capture: Capture,
    detector: PersonDetector,
    landmarks: LandmarkModel,
    keypoint_names: tuple[str, ...],
    *,
    stride: int = 1,
    workers: int,
    on_progress: Callable[[float], None],
    on_frames: Callable[[int, Sequence[Frame]], None] = lambda _index, _frames: None,
) -> TrackedSubject:
    """Find the subject's keypoints in every frame of every camera.

    The frames are streamed: memory does not grow with the length of the videos. Cameras are decoded and searched side by
    side on ``workers`` threads.

    Args:
        capture: The videos, matched to calibrated cameras.
        detector: Finds people at the start and after a loss.
        landmarks: Finds the keypoints of one person.
        keypoint_names: The names of the keypoints, in the network's order.
        stride: Look for keypoints in every so-many-th frame only, and in the last one; the frames between are decoded and
            passed over.
        workers: Threads; the networks release the interpreter's lock.
        on_progress: Hears the share that is done after each frame; may raise to stop the work.
        on_frames: Hears each frame's index and pictures, in the order of the cameras.

    Raises:
        CaptureError: ``nobody-found``: no person was ever seen by two cameras.
    """
    count = capture.frame_count
    uv_px = np.full((len(capture.views), count, len(keypoint_names), 2), np.nan)
    visibility = np.zeros(uv_px.shape[:3])
    follower = _Follower(capture.rig, detector, landmarks)
    readers = [islice(iterate_frames(view.path), 0, None, view.frame_step) for view in capture.views]
    with ThreadPoolExecutor(workers) as pool:
        for index in range(count):
            looked_at = index % stride == 0 or index == count - 1
            frames, people = follower.next_frame(pool, readers, look=looked_at)
            for camera, person in enumerate(people):
                if person is not None:
                    uv_px[camera, index] = person.uv_px
                    visibility[camera, index] = person.visibility
            on_frames(index, frames)
            on_progress((index + 1) / count)
    if not follower.people_in_view:
        raise CaptureError(
            "Nobody was found in these videos: no person was seen by two cameras at once.",
            hint="Check that the videos belong to this calibration and show a whole person, standing upright, "
            "who fills at least a fifth of the picture's height.",
            code="nobody-found",
        )
    points = ImagePoints(
        camera_names=capture.rig.names,
        keypoint_names=keypoint_names,
        timebase=capture.timebase,
        uv_px=uv_px,
        confidence=visibility,
        stride=stride,
    )
    return TrackedSubject(points=points, people_in_view=follower.people_in_view)


class _Follower:
    """Keeps one tracker a camera on the same person."""

    def __init__(self, rig: Rig, detector: PersonDetector, landmarks: LandmarkModel) -> None:
        self._rig = rig
        self._trackers = [PersonTracker(detector, landmarks) for _ in rig.cameras]
        self._since_search = [RETRY_FRAMES] * len(rig.cameras)
        self.people_in_view = 0

    def next_frame(
        self, pool: ThreadPoolExecutor, readers: Sequence[Iterator[Frame]], *, look: bool
    ) -> tuple[list[Frame], list[PersonLandmarks | None]]:
        """Read the next frame of every camera and, to ``look``, find the subject in each."""

        def read_and_follow(camera: int) -> tuple[Frame, PersonLandmarks | None]:
            frame = next(readers[camera])
            return frame, self._trackers[camera].follow(frame) if look else None

        followed = list(pool.map(read_and_follow, range(len(readers))))
        frames, people = [frame for frame, _ in followed], [person for _, person in followed]
        if not look:
            return frames, people
        if sum(tracker.region is not None for tracker in self._trackers) < 2:
            people = self._choose(pool, frames)
        else:
            people = self._recover(pool, frames, self._drop_strangers(people))
        return frames, people

    def _choose(self, pool: ThreadPoolExecutor, frames: Sequence[Frame]) -> list[PersonLandmarks | None]:
        """Find everybody in every camera, and start on the subject where the cameras agree on one."""
        found = list(pool.map(lambda i: self._trackers[i].candidates(frames[i]), range(len(frames))))
        undistorted, weights = zip(*(self._stack(camera, people) for camera, people in enumerate(found)), strict=True)
        people = associate_people(self._rig, list(undistorted), list(weights)) if any(found) else []
        subject = choose_subject(self._rig, people)
        if subject is None:
            return [None] * len(frames)
        self.people_in_view = max(self.people_in_view, len(people), *(len(candidates) for candidates in found))
        chosen: list[PersonLandmarks | None] = []
        for camera, index in enumerate(subject.candidate):
            person = found[camera][index] if index >= 0 else None
            if person is not None:
                self._trackers[camera].start(person)
            chosen.append(person)
        return chosen

    def _drop_strangers(self, people: Sequence[PersonLandmarks | None]) -> list[PersonLandmarks | None]:
        """Leave out the camera that follows somebody else, and make it search."""
        if sum(person is not None for person in people) < 3:  # two cameras that disagree accuse each other
            return list(people)
        _, miss_m = self._meet(people)
        kept: list[PersonLandmarks | None] = []
        for tracker, person, miss in zip(self._trackers, people, miss_m, strict=True):
            stranger = person is not None and miss > SOMEBODY_ELSE_M
            if stranger:
                tracker.region = None
            kept.append(None if stranger else person)
        return kept

    def _recover(
        self, pool: ThreadPoolExecutor, frames: Sequence[Frame], people: list[PersonLandmarks | None]
    ) -> list[PersonLandmarks | None]:
        """Let the cameras that have lost the subject search for whom the others see."""
        lost = [camera for camera, tracker in enumerate(self._trackers) if tracker.region is None]
        due: list[int] = []
        for camera in lost:
            self._since_search[camera] += 1
            if self._since_search[camera] >= RETRY_FRAMES:
                self._since_search[camera] = 0
                due.append(camera)
        if not due or sum(person is not None for person in people) < 2:
            return people
        for camera, candidates in zip(
            due, pool.map(lambda i: self._trackers[i].candidates(frames[i]), due), strict=True
        ):
            fitting: list[tuple[float, int]] = []
            for index, candidate in enumerate(candidates):
                trial = [candidate if i == camera else person for i, person in enumerate(people)]
                miss = float(self._meet(trial)[1][camera])
                if miss < SAME_PERSON_M:
                    fitting.append((miss, index))
            if fitting:
                person = candidates[min(fitting)[1]]
                self._trackers[camera].start(person)
                people[camera] = person
        return people

    def _meet(
        self, people: Sequence[PersonLandmarks | None]
    ) -> tuple[Float[np.ndarray, "keypoint 3"], Float[np.ndarray, " camera"]]:
        count = next(len(person.uv_px) for person in people if person is not None)
        uv_px, weight = np.full((len(people), count, 2), np.nan), np.zeros((len(people), count))
        for camera, person in enumerate(people):
            if person is not None:
                (uv_px[camera],), (weight[camera],) = self._stack(camera, [person])
        return meet(self._rig, uv_px, weight)

    def _stack(
        self, camera: int, people: Sequence[PersonLandmarks]
    ) -> tuple[Float[np.ndarray, "candidate keypoint 2"], Float[np.ndarray, "candidate keypoint"]]:
        """Stack candidates as association wants them: undistorted, weighted by what is visible."""
        if not people:
            return np.empty((0, 0, 2)), np.empty((0, 0))
        uv_px = np.stack([undistort(self._rig.cameras[camera], person.uv_px) for person in people])
        visibility = np.stack([person.visibility for person in people])
        return uv_px, np.where(visibility >= MIN_VISIBILITY, visibility, 0.0)
