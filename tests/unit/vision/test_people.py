"""Follow everybody through all cameras: real geometry and trackers, people who are known, networks that see them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gonio.kernel.geometry.cameras import project
from gonio.kernel.triangulation.people import find_people
from gonio.records import Camera, Capture, Person, Rig, Timebase, View
from gonio.vision import people as people_module
from gonio.vision.blazepose import DetectedPerson, PersonLandmarks, Region
from gonio.vision.people import MOST_PEOPLE, RETRY_LOOKS, track_people

FRAMES = 40
BODY = np.random.default_rng(1).uniform([-0.25, 0.0, -0.25], [0.25, 1.7, 0.25], (17, 3))
NAMES = tuple(f"k{i}" for i in range(17))
SUBJECT = np.linspace([-0.4, 0, 0.1], [0.4, 0, -0.1], FRAMES)
BYSTANDER = np.tile([1.5, 0.0, 0.9], (FRAMES, 1))


@dataclass(frozen=True)
class Scene:
    """A frame that knows what is to be seen in it: the people's points, and who can't be seen."""

    camera: Camera
    index: int
    people: list[np.ndarray]
    hidden: set[int] = field(default_factory=set)

    def seen(self) -> dict[int, np.ndarray]:
        return {
            i: project(self.camera, BODY + p[self.index]) for i, p in enumerate(self.people) if i not in self.hidden
        }


def region_of(uv: np.ndarray) -> Region:
    return Region(centre_px=uv.mean(axis=0), side_px=float(np.ptp(uv, axis=0).max() * 1.3), rotation_rad=0.0)


class Detector:
    def detect(self, frame: Scene) -> list[DetectedPerson]:
        return [DetectedPerson(score=0.9, region=region_of(uv)) for uv in frame.seen().values()]


class Landmarks:
    """Sees whoever stands nearest to the region's centre, if that is in the region."""

    def locate(self, frame: Scene, region: Region) -> PersonLandmarks:
        seen = list(frame.seen().values()) or [np.full((17, 2), -1e4)]
        apart = [np.linalg.norm(uv.mean(axis=0) - region.centre_px) for uv in seen]
        uv = seen[int(np.argmin(apart))]
        here = min(apart) < region.side_px / 2
        return PersonLandmarks(
            uv_px=uv,
            visibility=np.full(17, 0.9),
            presence=0.99 if here else 0.1,
            region=region,
            next_region=region_of(uv) if here else region,
        )


Hide = Callable[[int, int], set[int]]


def track(
    rig: Rig, people: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, hide: Hide = lambda _c, _i: set()
) -> list[Person]:
    def frames(path: Path) -> Iterator[Scene]:
        camera = rig.names.index(path.name)
        for index in range(FRAMES):
            yield Scene(rig.cameras[camera], index, people, hide(camera, index))

    monkeypatch.setattr(people_module, "iterate_frames", frames)
    views = tuple(
        View(
            camera_name=name,
            file_name=name,
            path=Path(name),
            image_size_px=(1280, 720),
            rate_hz=60.0,
            frame_count=FRAMES,
        )
        for name in rig.names
    )
    capture = Capture(rig=rig, views=views, timebase=Timebase(rate_hz=60.0), frame_count=FRAMES)
    heard: list[float] = []
    sightings = track_people(
        capture,
        Detector(),
        Landmarks(),
        NAMES,
        workers=2,
        on_progress=heard.append,  # type: ignore[arg-type]
    )
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
    assert sightings.uv_px.shape[2] == MOST_PEOPLE
    return sorted(find_people(rig, sightings, 0.5), key=lambda p: abs(p.centre_lab_m[p.met, 0].mean()))


def truth(rig: Rig) -> np.ndarray:
    return np.stack([[project(c, BODY + SUBJECT[i]) for i in range(FRAMES)] for c in rig.cameras])


def test_everybody_is_followed(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    subject, bystander = track(rig, [BYSTANDER, SUBJECT], monkeypatch)
    np.testing.assert_allclose(subject.points.uv_px, truth(rig))
    np.testing.assert_allclose(bystander.centre_lab_m, np.median(BODY + BYSTANDER[:, None], axis=1), atol=0.02)


def test_a_camera_that_lost_somebody_is_nan_and_finds_them_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    (person,) = track(rig, [SUBJECT], monkeypatch, lambda c, i: {0} if c == 2 and 10 <= i < 20 else set())
    uv = person.points.uv_px
    assert np.isnan(uv[2, 10:20]).all()
    assert (person.points.confidence[2, 10:20] == 0).all()
    assert np.isfinite(uv[2, 20 + RETRY_LOOKS :]).all()
    np.testing.assert_allclose(uv[[0, 1, 3]], truth(rig)[[0, 1, 3]])  # the others never noticed


def test_a_camera_that_jumps_to_the_bystander_is_called_back(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    passing = np.linspace([-0.4, 0, 0.1], [1.5, 0, 0.9], FRAMES)  # starts in the subject's place and walks away

    def hide(camera: int, index: int) -> set[int]:
        return {0} if camera == 1 and 14 <= index < 17 else set()

    people = track(rig, [SUBJECT, passing + np.array([0.05, 0, 0.05])], monkeypatch, hide)
    strangers = np.abs(people[0].points.uv_px[1] - truth(rig)[1]) > 1.0
    wrong = strangers.any(axis=(1, 2))
    assert wrong.sum() <= 12  # while the two still stand within a hand's breadth nothing can tell them apart
    assert not wrong[30:].any()


def test_nobody_in_view_is_nobody(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    assert track(rig, [], monkeypatch) == []


def test_someone_whom_only_one_camera_sees_is_nobody(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    assert track(rig, [SUBJECT], monkeypatch, lambda c, _i: {0} if c else set()) == []


def test_somebody_who_comes_later_is_found_then(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    (person,) = track(rig, [SUBJECT], monkeypatch, lambda _c, i: {0} if i < 15 else set())
    assert np.isnan(person.points.uv_px[:, :15]).all()
    np.testing.assert_allclose(person.points.uv_px[:, 15:], truth(rig)[:, 15:])
