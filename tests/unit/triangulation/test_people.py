"""Several people: who is who in all cameras and at all times, against a company whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import CaptureError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.geometry.transforms import rotation_about_y, transform
from gonio.kernel.triangulation.choice import choose_subject, nearest_m, rank_people
from gonio.kernel.triangulation.people import find_people
from gonio.kernel.virtual_lab import PRESETS, make_rig, walk
from gonio.kernel.virtual_lab.company import Company, film_company
from gonio.records import Person, Sightings
from gonio.resources import models_dir

# Three who cross in the middle of the lab, 120 degrees and half a second apart: hidden now and then in each camera.
ANGLES, STARTS_M, SPEEDS_M_S = (0.0, 2.1, 4.2), (-2.0, -2.6, -1.4), (1.2, 1.2, 1.2)
RIG = make_rig()


@pytest.fixture(scope="module")
def walks():
    body = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    return [walk(body, speed, start_m=start) for speed, start in zip(SPEEDS_M_S, STARTS_M, strict=True)]


@pytest.fixture(scope="module")
def card():
    return read_markerset(models_dir() / "markersets" / "halpe26.toml")


def crossing(walks, card, seed: int, effects: str = "occluded") -> Company:
    paths = [transform(rotation_about_y(angle), np.zeros(3)) for angle in ANGLES]
    return film_company(walks, paths, RIG, card, effects=PRESETS[effects], duration_s=3.0, seed=seed)


def identity(company: Company, person: Person) -> np.ndarray:
    """Who each sighting of a found person really is; -1 where there is none."""
    same = (person.place == company.place) & (person.place >= 0)
    return np.where(same.any(axis=0), same.argmax(axis=0), -1)


@pytest.mark.parametrize("seed", range(2))
def test_three_who_cross_are_three_and_keep_their_names(walks, card, seed):
    company = crossing(walks, card, seed)
    people = find_people(RIG, company.sightings, 0.3)
    assert len(people) == 3
    who = []
    for person in people:
        true = identity(company, person)
        names, counts = np.unique(true[true >= 0], return_counts=True)
        who.append(int(names[counts.argmax()]))
        # A camera may take the one for the other for moments in which they cover each other; never for good.
        assert counts.max() / counts.sum() > 0.99
        middle = np.median(company.seen_lab_m[who[-1]], axis=1)
        away_m = np.linalg.norm((person.centre_lab_m - middle)[person.met][:, [0, 2]], axis=1)
        assert np.percentile(away_m, 99) < 0.15  # a trunk's half width: nobody else came nearer than that
    assert sorted(who) == [0, 1, 2]
    taken = np.stack([person.place for person in people])
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert not np.any((taken[a] == taken[b]) & (taken[a] >= 0))  # no sighting serves twice


def test_what_was_found_does_not_depend_on_the_order_in_a_picture(walks, card):
    company = crossing(walks, card, 1)
    s = company.sightings
    turned = replace(s, uv_px=s.uv_px[:, :, ::-1], confidence=s.confidence[:, :, ::-1])
    for one, other in zip(find_people(RIG, s, 0.3), find_people(RIG, turned, 0.3), strict=True):
        np.testing.assert_array_equal(one.points.uv_px, other.points.uv_px)


def alone(sightings: Sightings, keep: np.ndarray) -> Sightings:
    return replace(
        sightings,
        uv_px=np.where(keep[..., None, None], sightings.uv_px, np.nan),
        confidence=np.where(keep[..., None], sightings.confidence, 0.0),
    )


def seen_as(company: Company, person: int) -> np.ndarray:
    places = np.arange(company.sightings.uv_px.shape[2])
    return company.place[person][..., None] == places


def test_one_camera_is_nobody_and_two_cameras_are_somebody(walks, card):
    company = crossing(walks, card, 0, "paper")
    camera = np.arange(4)[:, None, None]
    assert find_people(RIG, alone(company.sightings, seen_as(company, 0) & (camera < 1)), 0.3) == ()
    (person,) = find_people(RIG, alone(company.sightings, seen_as(company, 0) & (camera < 2)), 0.3)
    assert set(np.unique(identity(company, person)).tolist()) <= {-1, 0}


def test_two_persons_whom_different_cameras_miss_make_no_third(walks, card):
    company = crossing(walks, card, 2)
    camera = np.arange(4)[:, None, None]
    keep = (seen_as(company, 0) & (camera != 0)) | (seen_as(company, 1) & (camera != 1))
    people = find_people(RIG, alone(company.sightings, keep), 0.3)
    assert len(people) == 2


def test_who_is_out_of_sight_for_a_second_is_the_same_person(walks, card):
    company = crossing(walks, card, 3, "paper")
    gone = np.zeros(company.sightings.uv_px.shape[1], dtype=bool)
    gone[60:120] = True
    (person,) = find_people(RIG, alone(company.sightings, seen_as(company, 1) & ~gone[:, None]), 0.3)
    assert person.span[0] < 30
    assert person.span[1] > 150
    assert (person.place[:, gone] == -1).all()


def test_the_subject_is_chosen_by_rule_by_number_or_by_place(walks, card):
    company = crossing(walks, card, 0)
    standing = _standing(find_people(RIG, company.sightings, 0.3)[0])
    ranked = rank_people(RIG, [standing, *find_people(RIG, company.sightings, 0.3)])
    assert ranked[-1] is standing  # although in the middle: the others walk
    assert choose_subject(ranked, "auto") is ranked[0]
    assert choose_subject(ranked, 2) is ranked[1]
    end = ranked[2].centre_lab_m[ranked[2].span[1], [0, 2]]
    assert choose_subject(ranked, (float(end[0]), float(end[1]))) is ranked[2]
    assert nearest_m(ranked[2], end) == 0.0
    with pytest.raises(CaptureError) as caught:
        choose_subject(ranked, 5)
    assert caught.value.code == "person-unknown"


def _standing(person: Person) -> Person:
    return replace(person, centre_lab_m=np.where(person.met[:, None], [0.0, 1.0, 0.0], np.nan))
