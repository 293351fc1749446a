"""Following several people in one camera's pictures."""

import numpy as np

from gonio.kernel.triangulation.one_camera import follow_people
from gonio.records import Sightings, Timebase

FRAMES, KEYPOINTS = 60, 12


def sightings(swap: bool, absent: slice = slice(0, 0)) -> Sightings:
    """Two people walk past each other, 60 px apart in height of place; a tall one of 300 px and a small one of 200 px."""
    rng = np.random.default_rng(0)
    uv_px = np.full((1, FRAMES, 2, KEYPOINTS, 2), np.nan)
    for person, (height, start, step) in enumerate(((300.0, 100.0, 6.0), (200.0, 500.0, -6.0))):
        shape = np.stack([np.zeros(KEYPOINTS), np.linspace(0, height, KEYPOINTS)], axis=1)
        shape[:, 1] += 120.0 * person
        for frame in range(FRAMES):
            place = (person + frame) % 2 if swap else person
            uv_px[0, frame, place] = shape + np.array([start + step * frame, 0.0]) + rng.normal(0, 1, shape.shape)
    uv_px[0, absent] = np.nan
    confidence = np.where(np.isfinite(uv_px[..., 0]), 0.9, 0.0)
    names = tuple(f"k{i}" for i in range(KEYPOINTS))
    return Sightings(
        camera_names=("one",), keypoint_names=names, timebase=Timebase(rate_hz=30.0), uv_px=uv_px, confidence=confidence
    )


def test_people_keep_their_name_whatever_place_they_are_reported_in() -> None:
    people = follow_people(sightings(swap=True), 0.5)
    assert len(people) == 2
    heights = [np.ptp(one.uv_px[0, :, :, 1], axis=1) for one in people]
    assert heights[0].min() > 280  # the tall one first, in every frame
    assert heights[1].max() < 220


def test_a_short_absence_is_bridged_and_stays_empty() -> None:
    people = follow_people(sightings(swap=False, absent=slice(20, 26)), 0.5)
    assert len(people) == 2
    assert (people[0].confidence[0, 20:26] == 0).all()
    assert (people[0].confidence[0, 26:] > 0).all()


def test_nobody_is_found_where_nothing_is_trusted() -> None:
    assert follow_people(sightings(swap=False), 0.95) == ()
