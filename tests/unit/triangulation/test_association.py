import numpy as np

from gonio.kernel.geometry.cameras import project, undistort
from gonio.kernel.triangulation.association import associate_people
from gonio.records import Rig

BODY = np.random.default_rng(5).uniform([-0.25, 0.0, -0.25], [0.25, 1.7, 0.25], (17, 3))
MIDDLE, ASIDE = np.array([0.1, 0.0, 0.0]), np.array([1.4, 0.0, 0.6])


def views(rig: Rig, *people: np.ndarray) -> list[np.ndarray]:
    return [np.stack([undistort(c, project(c, BODY + person)) for person in people]) for c in rig.cameras]


def ones(candidates: list[np.ndarray]) -> list[np.ndarray]:
    return [np.ones(c.shape[:2]) for c in candidates]


def test_two_people_are_two(rig: Rig) -> None:
    candidates = views(rig, ASIDE, MIDDLE)
    candidates[2] = candidates[2][::-1]  # the order in a camera means nothing
    people = associate_people(rig, candidates, ones(candidates))
    assert [p.candidate for p in people].count((1, 1, 0, 1)) == 1
    assert len(people) == 2  # no ghost of one person's left and the other's right


def test_whom_only_one_camera_sees_is_nobody(rig: Rig) -> None:
    candidates = views(rig, MIDDLE)
    lonely = [c if i == 0 else np.empty((0, 17, 2)) for i, c in enumerate(candidates)]
    assert associate_people(rig, lonely, ones(lonely)) == []


def test_whom_four_cameras_see_comes_before_whom_two_see(rig: Rig) -> None:
    candidates = views(rig, MIDDLE)
    both = views(rig, ASIDE)
    seen = [np.concatenate([both[i], c]) if i < 2 else c for i, c in enumerate(candidates)]
    assert [p.candidate for p in associate_people(rig, seen, ones(seen))] == [(1, 1, 0, 0), (0, 0, -1, -1)]


def test_a_camera_that_sees_somebody_else_is_left_out(rig: Rig) -> None:
    candidates = views(rig, MIDDLE)
    candidates[1] = views(rig, ASIDE)[1]
    people = associate_people(rig, candidates, ones(candidates))
    assert people[0].candidate == (0, -1, 0, 0)
