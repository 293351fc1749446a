"""A sample of `make bench NAME=service`: processes are killed at random moments, on both databases."""

import random

import pytest

from gonio.bench.service import make_capture, make_settings
from gonio.bench.service_house import VICTIMS, kill_at_random, open_house


@pytest.mark.slow
@pytest.mark.xdist_group("servers")
@pytest.mark.parametrize("database", ["sqlite", "postgres"])
def test_killing_at_random_loses_nothing_and_repeats_nothing(request, tmp_path, database):
    url = request.getfixturevalue("postgres").new_database() if database == "postgres" else ""
    objects = (tmp_path / "objects").as_uri() if url else ""
    with open_house(make_settings(tmp_path, url, objects), tmp_path) as house:
        seen = kill_at_random(house, make_capture(tmp_path), len(VICTIMS), random.Random(database))
    assert set(seen.kills) == set(VICTIMS)
    assert (seen.jobs, seen.lost, seen.different) == (len(VICTIMS), 0, 0)
    assert (seen.surplus_reports, seen.repeated_stages) == (0, 0)
