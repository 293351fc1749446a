"""Choose the subject among several people, by rules that a report can state."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from gonio.errors import CaptureError
from gonio.kernel.geometry.cameras import nearest_point_to_axes
from gonio.records import Person, Rig

WELL_SEEN = 0.5
"""Whoever is seen in half as many pictures as the best seen person may be the subject."""

WALKS_M = 1.5
"""Whoever comes this far is walking; somebody who stands and sways, or works at a desk, does not."""

Wish = Literal["auto"] | int | tuple[float, float]


def rank_people(rig: Rig, people: Sequence[Person]) -> list[Person]:
    """Put people in the order of being the subject, the likeliest first.

    Well seen before hardly seen (:data:`WELL_SEEN`), walking before standing (:data:`WALKS_M`), and then by the mean distance
    from the middle of the capture volume, the point nearest to all optical axes.
    """
    middle = nearest_point_to_axes(rig)
    most = max((person.sightings for person in people), default=0)

    def rank(person: Person) -> tuple[bool, bool, float]:
        way = person.centre_lab_m[person.met][:, [0, 2]]
        walks = bool(np.linalg.norm(np.ptp(way, axis=0)) > WALKS_M)
        away_m = float(np.linalg.norm(way - middle[[0, 2]], axis=1).mean())
        return person.sightings < WELL_SEEN * most, not walks, away_m

    return sorted(people, key=rank)


def choose_subject(ranked: Sequence[Person], wish: Wish) -> Person:
    """Choose by the order, by number in it (from 1), or by whose path comes nearest to a point (x, z) of the lab, metres.

    Raises:
        CaptureError: ``person-unknown``: there are not so many.
    """
    if wish == "auto":
        return ranked[0]
    if isinstance(wish, int):
        if wish > len(ranked):
            raise CaptureError(
                f"Person {wish} was asked for, but {len(ranked)} were found.",
                hint="Leave keypoints.person out, and read in the report who was found.",
                code="person-unknown",
            )
        return ranked[wish - 1]
    return min(ranked, key=lambda person: nearest_m(person, np.array(wish)))


def nearest_m(person: Person, xz_lab_m: Float[np.ndarray, "2"]) -> float:
    """Give how near a person's path comes to a point of the floor."""
    return float(np.linalg.norm(person.centre_lab_m[person.met][:, [0, 2]] - xz_lab_m, axis=1).min())
