"""What a report says of several people, and how a request chooses among them."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.pipeline.describe import describe_person
from gonio.pipeline.keypoints import Keypoints, tell_bystanders
from gonio.pipeline.params import parse_parameters
from gonio.records import ImagePoints, Person, Timebase

FRAMES = 11


def walker(z_m: float, first: int = 0) -> Person:
    """Somebody who walks 2 m along X at some z, seen by both cameras from a frame on."""
    place = np.where(np.arange(FRAMES) >= first, 0, -1) * np.ones((2, 1), dtype=int)
    points = ImagePoints(
        camera_names=("a", "b"),
        keypoint_names=("nose",),
        timebase=Timebase(rate_hz=10.0),
        uv_px=np.zeros((2, FRAMES, 1, 2)),
        confidence=np.ones((2, FRAMES, 1)),
    )
    centre = np.column_stack([np.linspace(-1, 1, FRAMES), np.ones(FRAMES), np.full(FRAMES, z_m)])
    centre[:first] = np.nan
    return Person(place=place, points=points, centre_lab_m=centre)


@pytest.fixture
def keypoints() -> Keypoints:
    people = (walker(0.0), walker(1.5, first=5))
    return Keypoints(
        points=people[0].points, networks=(), pictures=(), picture_frame=0, picture_scale=(), people=people, subject=0
    )


def test_the_report_tells_who_was_there_when_and_how_near(keypoints):
    subject, other = (describe_person(keypoints, number) for number in (0, 1))
    assert (subject.number, subject.subject, subject.nearest_to_subject_m) == (1, True, None)
    assert (subject.from_s, subject.to_s, subject.seen_fraction, subject.path_m) == (0.0, 1.0, 1.0, 2.0)
    assert (other.number, other.subject, other.nearest_to_subject_m) == (2, False, 1.5)
    assert (other.from_s, other.seen_fraction) == (0.5, round(6 / 11, 4))
    assert (other.mean_x_m, other.mean_z_m, other.path_m) == (0.5, 1.5, 1.0)


def test_bystanders_are_told_with_the_nearest(keypoints):
    told = tell_bystanders(keypoints.people, 0)
    assert (told.code, told.value) == ("bystanders", 1)
    assert told.where == "person 1 of 2; the nearest other came to 1.5 m"
    assert told.message.startswith("1 other person was in view;")
    early, late = walker(0.0), walker(1.0, first=6)
    early = replace(early, centre_lab_m=np.where(np.arange(FRAMES)[:, None] < 6, early.centre_lab_m, np.nan))
    assert "never there at the same time" in tell_bystanders((late, early), 0).where


@pytest.mark.parametrize(("asked", "kept"), [("auto", "auto"), (2, 2), ([0.5, -1.0], (0.5, -1.0))])
def test_a_request_may_say_who(asked, kept):
    assert parse_parameters({"keypoints": {"person": asked}}).keypoints.person == kept


@pytest.mark.parametrize("asked", ["tall", 0, [1.0], [1.0, float("nan")]])
def test_a_request_that_says_nothing_sensible_is_refused(asked):
    with pytest.raises(InputError) as caught:
        parse_parameters({"keypoints": {"person": asked}})
    assert caught.value.code == "parameter-invalid"
