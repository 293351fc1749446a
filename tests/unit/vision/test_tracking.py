"""The tracker with stand-ins for the networks: people are squares whose place and size the test decides."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.vision.blazepose import DetectedPerson, LandmarkModel, PersonDetector, PersonLandmarks, Region
from gonio.vision.frame import BT601, Colour, Frame
from gonio.vision.tracking import PersonTracker, is_same_person

FRAME = Frame(
    index=0,
    time_s=0.0,
    planes=(np.zeros((2, 2), np.uint8),) * 3,
    rotation_deg=0,
    colour=Colour.of(*BT601, full_range=True),
)
"""Nobody looks at it."""


def region_at(x: float, side_px: float = 400.0) -> Region:
    return Region(centre_px=np.array([x, 500.0]), side_px=float(side_px), rotation_rad=0.0)


class LandmarksFake(LandmarkModel):
    """Finds the person nearest to the region; each is a Region, as the network would ask for it next."""

    def __init__(self, *people: Region, presence: float = 0.99) -> None:
        self.people, self.presence = list(people), presence
        self.regions: list[Region] = []

    def locate(self, frame: Frame, region: Region) -> PersonLandmarks:
        self.regions.append(region)
        person = min(self.people, key=lambda p: abs(p.centre_px[0] - region.centre_px[0]))
        spread = np.linspace(-0.3, 0.3, 33)[:, np.newaxis] * person.side_px
        return PersonLandmarks(
            uv_px=person.centre_px + spread,
            visibility=np.ones(33),
            presence=self.presence,
            region=region,
            next_region=person,
        )


class DetectorFake(PersonDetector):
    def __init__(self, *regions: Region) -> None:
        self.people = [DetectedPerson(score=0.9 - 0.1 * i, region=region) for i, region in enumerate(regions)]

    def detect(self, frame: Frame) -> list[DetectedPerson]:
        return self.people


def test_candidates_are_located_twice_and_each_person_once() -> None:
    landmarks = LandmarksFake(region_at(100), region_at(900))
    tracker = PersonTracker(DetectorFake(region_at(880), region_at(130), region_at(930)), landmarks)
    people = tracker.candidates(FRAME)
    assert [person.uv_px[16, 0] for person in people] == [900, 100]  # the surest first; 880 and 930 are one person
    assert [region.centre_px[0] for region in landmarks.regions] == [880, 900, 130, 100, 930, 900]
    assert tracker.region is None


def test_a_detection_without_a_person_is_no_candidate() -> None:
    landmarks = LandmarksFake(region_at(100), presence=0.2)
    assert PersonTracker(DetectorFake(region_at(100)), landmarks).candidates(FRAME) == []
    assert len(landmarks.regions) == 1  # no second look


def test_each_crop_follows_from_the_landmarks_before() -> None:
    landmarks = LandmarksFake(region_at(100))
    tracker = PersonTracker(DetectorFake(region_at(90)), landmarks)
    tracker.start(tracker.candidates(FRAME)[0])
    for x in (105, 110, 115):
        landmarks.people = [region_at(x)]
        person = tracker.follow(FRAME)
        assert person is not None
        assert person.uv_px[16, 0] == x
    assert [region.centre_px[0] for region in landmarks.regions[2:]] == [100, 105, 110]


def test_a_prediction_is_used_but_its_size_is_limited() -> None:
    landmarks = LandmarksFake(region_at(100, 400))
    tracker = PersonTracker(DetectorFake(), landmarks)
    tracker.start(region_at(100, 400))
    for predicted, expected in ((800, 420), (100, 360), (410, 410)):
        tracker.start(region_at(100, 400))
        person = tracker.follow(FRAME, region_at(140, predicted))
        assert person is not None
        assert person.region.centre_px[0] == 140
        assert person.region.side_px == pytest.approx(expected)


def test_a_crop_can_not_run_away() -> None:
    """A network that asks for twice the size in each frame gets 5 % a frame."""
    landmarks = LandmarksFake(region_at(100, 800))
    tracker = PersonTracker(DetectorFake(), landmarks)
    tracker.start(region_at(100, 400))
    for _ in range(3):
        tracker.follow(FRAME)
    assert [region.side_px for region in landmarks.regions] == pytest.approx([400, 420, 441])


def test_two_misses_in_a_row_are_a_loss() -> None:
    landmarks = LandmarksFake(region_at(100))
    tracker = PersonTracker(DetectorFake(), landmarks)
    tracker.start(region_at(100))
    for presence, is_found, is_lost in (
        (0.4, False, False),
        (0.9, True, False),
        (0.4, False, False),
        (0.3, False, True),
    ):
        landmarks.presence = presence
        assert (tracker.follow(FRAME) is not None) == is_found
        assert (tracker.region is None) == is_lost
    looks = len(landmarks.regions)
    assert tracker.follow(FRAME) is None
    assert tracker.follow(FRAME, region_at(100)) is None  # a lost tracker has to be started
    assert len(landmarks.regions) == looks

    landmarks.presence = 0.9
    tracker.start(region_at(120))
    assert tracker.follow(FRAME) is not None


def test_a_presence_that_is_no_number_is_a_miss() -> None:
    landmarks = LandmarksFake(region_at(100), presence=float("nan"))
    tracker = PersonTracker(DetectorFake(), landmarks)
    tracker.start(region_at(100))
    assert tracker.follow(FRAME) is None


def test_the_same_person() -> None:
    person = LandmarksFake(region_at(100)).locate(FRAME, region_at(100))
    near = replace(person, uv_px=person.uv_px + np.array([31, 0]))  # 8 % of 400 px are 32 px
    far = replace(person, uv_px=person.uv_px + np.array([33, 0]))
    assert is_same_person(person, near)
    assert not is_same_person(person, far)
