"""How a job is followed, bounded and shared: events, waiting, limits, turns, and no second computation of the same."""

import json
import os
import signal
import time

import pytest
import sqlalchemy as sa

from gonio.client import Client
from gonio.errors import GonioError
from gonio.http.pace import Pace
from gonio.jobs.access import SCOPES, opened
from gonio.jobs.database import Database, upgrade
from gonio.jobs.queue import QUEUE
from gonio.jobs.repository import Repository
from gonio.jobs.supervisor import Supervisor
from gonio.jobs.tables import JobState
from gonio.jobs.worker import SWEEPS_AFTER_END, Worker, WorkerStuck
from gonio.settings import Settings


@pytest.fixture(scope="module")
def session(lab, capture) -> str:
    return lab.complete_session(capture)


def events_of(lab, job: str, **headers: str) -> list[dict]:
    with lab.http.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = list(response.iter_lines())
    ids = [line.removeprefix("id: ") for line in lines if line.startswith("id: ")]
    data = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]
    return [{"id": event_id, **event} for event_id, event in zip(ids, [{"job": each} for each in data], strict=True)]


def test_events_follow_a_job_to_its_end(lab, session, journal):
    job = lab.client.analyse(session, journal.parameters(seconds=1.2))["id"]
    begin_s = time.monotonic()
    events = events_of(lab, job)
    elapsed_s = time.monotonic() - begin_s
    states = [event["job"]["state"] for event in events]
    assert states[-1] == "succeeded"
    assert set(states) <= {"todo", "doing", "succeeded"}
    assert any(event["job"]["progress"] for event in events)
    assert len(events) <= elapsed_s + 2  # at most one a second, the first at once
    assert events_of(lab, job, **{"Last-Event-ID": events[-1]["id"]}) == []
    assert lab.http.get("/v1/jobs/00000000-0000-4000-8000-000000000000/events").status_code == 404


def test_a_request_waits_for_the_end_or_for_news(lab, session, journal):
    job = lab.client.analyse(session, journal.parameters(seconds=0.8))["id"]
    ended = lab.http.get(f"/v1/jobs/{job}", headers={"Prefer": "respond-async, wait=20"})
    assert ended.json()["state"] == "succeeded"
    assert ended.headers["preference-applied"] == "wait=20"
    tag = ended.headers["etag"]
    same = lab.http.get(f"/v1/jobs/{job}", headers={"Prefer": "wait=20", "If-None-Match": tag})
    assert same.status_code == 304  # at once: nothing will change any more
    long = lab.client.analyse(session, journal.parameters(seconds=20))["id"]
    begin_s = time.monotonic()
    running = lab.http.get(f"/v1/jobs/{long}", headers={"Prefer": "wait=1"})
    assert time.monotonic() - begin_s >= 0.9
    assert running.json()["state"] in ("todo", "doing")
    lab.client.cancel(long)


def test_the_same_analysis_is_not_computed_twice(lab, session, journal):
    url, body = f"/v1/sessions/{session}/analyses", {"parameters": journal.parameters(seconds=0)}
    first = lab.http.post(url, json=body)
    again = lab.http.post(url, json=body)
    assert (first.status_code, again.status_code) == (202, 200)
    assert again.json()["id"] == first.json()["id"]
    lab.client.wait(first.json()["id"], timeout_s=180)
    assert lab.http.post(url, json=body).json()["id"] == first.json()["id"]
    other = lab.http.post(url, json={"parameters": {**body["parameters"], "seconds": 0.01}})
    assert other.status_code == 202
    named = lab.http.post(url, json=body, headers={"Idempotency-Key": str(time.time_ns())})
    assert (named.status_code, named.json()["id"] == first.json()["id"]) == (202, False)
    for job in (other, named):
        lab.client.wait(job.json()["id"], timeout_s=180)


def test_lists_tell_their_next_page_in_a_header(lab):
    for name in ("first", "second"):
        lab.client.create_session(name=name)
    page = lab.http.get("/v1/sessions", params={"limit": 1})
    link = page.headers["link"]
    assert link.endswith('>; rel="next"')
    following = lab.http.get(link[1 : link.index(">")])
    assert following.status_code == 200
    assert following.json()["items"][0]["id"] != page.json()["items"][0]["id"]


def test_a_lab_may_queue_so_many_jobs_and_each_is_served_in_its_turn(start_lab, start_worker, capture, journal):
    lab = start_lab(workers=0, keys="required", jobs_per_lab=3)
    jobs: dict[str, list[str]] = {}
    with opened(lab.settings) as access:
        keys = {name: access.create_key(name, name, SCOPES).secret for name in ("north", "south")}
    for name, count in (("north", 3), ("south", 1)):
        with Client(lab.url, key=keys[name]) as client:
            session = client.create_session()["id"]
            for path in sorted(capture.iterdir()):
                client.upload(session, path)
            jobs[name] = [client.analyse(session, journal.parameters(seconds=0.01 * i))["id"] for i in range(count)]
            if name == "north":
                with pytest.raises(GonioError) as caught:
                    client.analyse(session, journal.parameters(seconds=9))
                assert (caught.value.code, caught.value.details["status"]) == ("too-many-jobs", 429)
    start_worker(lab.settings)
    with Client(lab.url, key=keys["north"]) as north, Client(lab.url, key=keys["south"]) as south:
        for job in jobs["north"]:
            north.wait(job, timeout_s=180)
        started = {job: north.job(job)["started_at"] for job in jobs["north"]}
        started |= {job: south.job(job)["started_at"] for job in jobs["south"]}
    order = sorted(started, key=lambda job: started[job])
    assert order.index(jobs["south"][0]) == 1  # after the first of the other lab, not after all three


def test_who_asks_too_often_is_told_to_wait(start_lab):
    lab = start_lab(workers=0, requests_per_minute=5)
    answers = [lab.http.get("/v1/sessions") for _ in range(7)]
    assert [answer.status_code for answer in answers[:5]] == [200] * 5
    assert answers[-1].status_code == 429
    assert answers[-1].json()["code"] == "too-many-requests"
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 12
    assert lab.http.get("/healthz").status_code == 200


def test_the_pace_is_kept_for_each_caller():
    now_s = [0.0]
    pace = Pace(60, clock=lambda: now_s[0])
    assert [pace.wait_s("a") for _ in range(61)] == [0] * 60 + [1]
    assert pace.wait_s("b") == 0
    now_s[0] = 2.0
    assert [pace.wait_s("a") for _ in range(3)] == [0, 0, 1]
    assert Pace(0).wait_s("a") == 0


def test_a_worker_that_lost_a_job_can_neither_publish_nor_fail_it(lab, session, journal):
    job = lab.client.analyse(session, journal.parameters(seconds=20))["id"]
    journal.wait_for("begin keypoints")
    database = Database(lab.settings.resolved_database_url)
    with database.write("default") as db:
        repository = Repository(db, "default")
        stale = repository.job(job).generation
        repository.lose_job(job, takeovers=1, steps=2)
        for state in (JobState.SUCCEEDED, JobState.FAILED):
            assert not repository.change_job(job, [JobState.DOING], of_generation=stale, state=state)
        assert repository.change_job(job, [JobState.DOING], of_generation=stale + 1, state=JobState.DOING)
    database.close()
    lab.client.cancel(job)


@pytest.mark.slow
def test_a_job_of_an_older_version_starts_anew(start_lab, start_worker, capture, journal):
    lab = start_lab(workers=0)
    job = lab.client.analyse(lab.complete_session(capture), journal.parameters(seconds=0))["id"]
    database = Database(lab.settings.resolved_database_url)
    with database.write() as db:
        changed = db.execute(
            sa.text("UPDATE workflow_status SET application_version = 'pipeline-0' WHERE queue_name = :queue"),
            {"queue": QUEUE},
        )
        assert changed.rowcount == 1
    database.close()
    start_worker(lab.settings)
    assert lab.client.wait(job, timeout_s=180)["state"] == "succeeded"


@pytest.mark.parametrize(("silence_s", "reason"), [(0.01, "nothing was heard of job"), (60, "doesn't hear of it")])
def test_a_worker_ends_whose_stage_is_silent_or_goes_on_after_its_job_has_ended(tmp_path, silence_s, reason):
    settings = Settings(data_dir=tmp_path / "data", cache_dir=tmp_path / "cache", stage_silence_s=silence_s)
    upgrade(settings)
    worker = Worker(settings, {})
    worker.watch_desk()
    with worker.desk.working_on("a job that was cancelled"), pytest.raises(WorkerStuck, match=reason):
        for _ in range(SWEEPS_AFTER_END + 1):
            time.sleep(0.02)
            worker.watch_desk()
    worker.close()


def test_a_frozen_worker_is_killed(tmp_path, caplog):
    pids = tmp_path / "pids"
    script = f"echo $$ >> {pids}; echo . >&$GONIO_HEARTBEAT_FD; kill -STOP $$"
    with Supervisor(Settings(workers=1), ["/bin/bash", "-c", script], frozen_s=0.3):
        deadline_s = time.monotonic() + 10
        while not pids.exists() or len(pids.read_text().split()) < 2:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
    first = int(pids.read_text().split()[0])
    with pytest.raises(ProcessLookupError):
        os.kill(first, signal.SIGCONT)
    assert "no sign of life" in caplog.text
