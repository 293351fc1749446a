"""A sample of `make bench NAME=service`: processes are killed at random moments, on both databases and both stores, and the
database goes away in the middle of a job."""

import random

import pytest

from gonio.bench.service import make_capture, make_settings
from gonio.bench.service_house import VICTIMS, kill_at_random, open_house
from gonio.bench.service_outage import outage
from gonio.jobs.store import Store


@pytest.mark.slow
@pytest.mark.parametrize("database", ["sqlite", "postgres"])
def test_killing_at_random_loses_nothing_and_repeats_nothing(request, tmp_path, monkeypatch, database):
    url = objects = ""
    if database == "postgres":
        url, bucket = request.getfixturevalue("postgres").new_database(), request.getfixturevalue("bucket")
        objects = f"{bucket.url}/{tmp_path.name}"
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
    settings = make_settings(tmp_path, url, objects)
    with open_house(settings, tmp_path) as house:
        seen = kill_at_random(house, make_capture(tmp_path), len(VICTIMS), random.Random(database))
        assert set(seen.kills) == set(VICTIMS)
        assert (seen.jobs, seen.lost, seen.different) == (len(VICTIMS), 0, 0)
        assert (seen.surplus_reports, seen.repeated_stages) == (0, 0)
        if database == "postgres":
            # Over a socket, which is gone with its server: to DBOS an error that it doesn't know for an outage.
            met = outage(house, request.getfixturevalue("postgres"), make_capture(tmp_path), 2.0)
            assert met.ended_as == "succeeded"
            assert met.answers["503 database-unreachable"] > 0
            assert set(met.answers) <= {"503 database-unreachable", "200"}
        store = Store.open(settings.resolved_objects_url)
        with house.client() as client:
            for session in client.sessions():
                prefix = f"labs/default/sessions/{session['id']}"
                assert store.is_there(prefix)
                client.delete_session(session["id"])
                assert not store.is_there(prefix)
