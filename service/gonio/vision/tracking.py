"""Follow one person through the frames of one camera.

The detector is asked at the start and after a loss only; in between, each crop follows from the landmarks before it, or
from a prediction that the caller makes from all cameras together. Which of the people in view is the subject can't be
decided in one camera, so that is the caller's choice among :meth:`PersonTracker.candidates`.
"""

from collections.abc import Sequence

import numpy as np

from gonio.vision.blazepose import LandmarkModel, PersonDetector, PersonLandmarks, Region
from gonio.vision.frame import Frame

MIN_PRESENCE = 0.5
MISSES_UNTIL_LOST = 2
SIDE_CHANGE = (0.9, 1.05)
"""How much a crop may shrink or grow from one to the next; too large misleads the network more than too small."""
SAME_PERSON_DISTANCE = 0.08
"""Two skeletons are one person if their landmarks are closer than this part of the crop's side, in the median."""

SAME_PLACE = 0.1
"""The detector found again whom we know if the hips are closer than this part of the crop's side: some 0.2 m."""


class PersonTracker:
    """Follows one person in one camera, once :meth:`start` has said whom.

    Give it the frames in order, all of them or every n-th. ``region`` is where it looks next; None before the start and
    after a loss.
    """

    def __init__(self, detector: PersonDetector, landmarks: LandmarkModel) -> None:
        self._detector = detector
        self._landmarks = landmarks
        self._misses = 0
        self.region: Region | None = None

    def candidates(self, frame: Frame, known: Sequence[Region] = ()) -> list[PersonLandmarks]:
        """Find the people in a frame, the detector's surest first; not those in the regions that are ``known``.

        Each is located twice: the detector's region is rough, and a second pass in the region that the first landmarks
        ask for moves points by 2 to 9 px.
        """
        people: list[PersonLandmarks] = []
        for found in self._detector.detect(frame):
            if any(_is_there(found.region, region) for region in known):
                continue
            person = self._landmarks.locate(frame, found.region)
            if is_present(person):
                person = self._landmarks.locate(frame, person.next_region)
            if is_present(person) and not any(is_same_person(person, other) for other in people):
                people.append(person)
        return people

    def start(self, where: PersonLandmarks | Region) -> None:
        """Start, or start again, with a candidate or at a region (as one predicted from the other cameras)."""
        self.region = where if isinstance(where, Region) else where.next_region
        self._misses = 0

    def follow(self, frame: Frame, predicted: Region | None = None) -> PersonLandmarks | None:
        """Find the followed person in the next frame.

        Args:
            frame: The frame.
            predicted: Where to look, if the caller knows better than the last landmarks. Its size is kept to 0.9 to
                1.05 times that of the tracker's region.

        Returns:
            The landmarks; None if there was no person in the region, or if the tracker is lost: after two misses in a
            row ``region`` is None until :meth:`start`.
        """
        if self.region is None:
            return None
        person = self._landmarks.locate(frame, _limit_side(predicted or self.region, self.region.side_px))
        if not is_present(person):
            self._misses += 1
            if self._misses == MISSES_UNTIL_LOST:
                self.region = None
            return None
        self._misses = 0
        self.region = _limit_side(person.next_region, person.region.side_px)
        return person


def is_present(person: PersonLandmarks) -> bool:
    """Say whether there is a person at all in the crop (a presence that is no number says no)."""
    return person.presence >= MIN_PRESENCE


def is_same_person(one: PersonLandmarks, other: PersonLandmarks) -> bool:
    """Say whether two skeletons in one picture are the same person's."""
    distance_px = np.median(np.linalg.norm(one.uv_px - other.uv_px, axis=-1))
    return bool(distance_px < SAME_PERSON_DISTANCE * min(one.region.side_px, other.region.side_px))


def _is_there(found: Region, known: Region) -> bool:
    return float(np.linalg.norm(found.centre_px - known.centre_px)) < SAME_PLACE * known.side_px


def _limit_side(region: Region, last_side_px: float) -> Region:
    smallest, largest = (limit * last_side_px for limit in SIDE_CHANGE)
    side_px = min(max(region.side_px, smallest), largest)
    return Region(centre_px=region.centre_px, side_px=side_px, rotation_rad=region.rotation_rad)
