"""The database goes away for a moment in the middle of a job: clear answers, then recovery without help.

A sample of `make bench NAME=service`, in which they are away for 20 s, and the store too.
"""

import pytest

from gonio.bench.service import make_capture, make_settings
from gonio.bench.service_house import open_house
from gonio.bench.service_outage import outage


@pytest.mark.slow
@pytest.mark.xdist_group("servers")
def test_jobs_outlive_an_outage_of_the_database(tmp_path, postgres):
    """Over a socket, which is gone with its server: to DBOS an error that it doesn't know for an outage."""
    with open_house(make_settings(tmp_path, postgres.new_database()), tmp_path) as house:
        seen = outage(house, postgres, make_capture(tmp_path), 2.0)
    assert seen.ended_as == "succeeded"
    assert seen.answers["503 database-unreachable"] > 0
    assert set(seen.answers) <= {"503 database-unreachable", "200"}
