"""What whoever runs the service sees: numbers, log lines, and the end of what is over."""

import json
import logging
from datetime import timedelta

import httpx
import pytest
import sqlalchemy as sa

from gonio.errors import ResourceError
from gonio.jobs.database import Database
from gonio.jobs.logs import JsonLines, Lines, about
from gonio.jobs.service import Service
from gonio.jobs.store import Store
from gonio.jobs.tables import ErasureRow, SessionRow, now


def numbers(text: str) -> dict[str, float]:
    lines = [line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in lines}


def test_the_numbers_count_jobs_stages_frames_and_requests(lab, capture, journal):
    first = lab.http.get("/metrics")
    assert first.status_code == 200, lab.log.read_text()[-3000:]
    before = numbers(first.text)
    job = lab.client.analyse(lab.complete_session(capture), journal.parameters(seconds=0.1))["id"]
    lab.client.wait(job, timeout_s=180)
    answer = lab.http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain")
    after = numbers(answer.text)

    def more(name: str) -> float:
        return after[name] - before.get(name, 0.0)

    assert more('gonio_jobs{state="succeeded"}') == 1
    assert more('gonio_stage_seconds_count{stage="keypoints"}') == 1
    assert more('gonio_stage_seconds_sum{stage="keypoints"}') >= 0.1
    assert more("gonio_frames_total") == 16
    assert more('gonio_http_requests_total{method="POST",route="/v1/sessions/{session_id}/files",status="201"}') == 3
    assert after["gonio_queue_oldest_seconds"] == 0
    assert job not in answer.text


def test_the_numbers_want_their_own_key_where_keys_are_wanted(start_lab):
    lab = start_lab(workers=0, keys="required", metrics_key="sesame")
    key = lab.make_key()
    for sent, status in ((None, 401), (key, 401), ("sesame", 200), ("", 401)):
        headers = {} if sent is None else {"Authorization": f"Bearer {sent}".strip()}
        assert httpx.get(f"{lab.url}/metrics", headers=headers).status_code == status, sent


def test_log_lines_say_what_they_are_about_and_are_one_json_object_each():
    failure = (ValueError, ValueError("no"), None)
    record = logging.LogRecord("gonio", logging.WARNING, "", 0, "It is %s", ("late",), failure)
    with about(job="j1"), about(request="r1"):
        told = json.loads(JsonLines().format(record))
        line = Lines().format(record)
    assert (told["level"], told["message"], told["job"], told["request"]) == ("warning", "It is late", "j1", "r1")
    assert "ValueError: no" in told["traceback"]
    assert "WARNING gonio: It is late" in line
    assert "job=j1" in line
    assert "job" not in json.loads(JsonLines().format(record))


@pytest.mark.slow
def test_the_log_names_jobs_and_requests_and_nobody(start_lab, capture, journal):
    lab = start_lab(workers=1, log_format="json")
    session = lab.client.create_session(name="Anna Schmidt")["id"]
    for path in sorted(capture.iterdir()):
        lab.client.upload(session, path, name=f"Anna {path.name}")
    job = lab.client.analyse(session, journal.parameters(seconds=0))["id"]
    lab.client.wait(job, timeout_s=180)
    request = lab.http.get(f"/v1/reports/{job}").headers["x-request-id"]
    lab.process.terminate()
    lab.process.wait(10)
    told = [json.loads(line) for line in lab.log.read_text().splitlines()]
    assert any(line.get("job") == job and "All stages are done" in line["message"] for line in told)
    assert next(line["message"] for line in told if line.get("request") == request).startswith(
        "GET /v1/reports/{report_id}: 200"
    )
    assert "Anna" not in lab.log.read_text()
    assert "cam01" not in lab.log.read_text()


def test_sessions_are_deleted_when_their_time_is_over_but_not_those_that_were_worked_on(lab, capture):
    old, worked_on = (lab.client.create_session(name="old")["id"] for _ in range(2))
    database = Database(lab.settings.resolved_database_url)
    with database.write() as db:
        ids = [old, worked_on]
        db.execute(sa.update(SessionRow).where(SessionRow.id.in_(ids)).values(created_at=now() - timedelta(days=31)))
    database.close()
    lab.client.upload(worked_on, capture / "cam01.mp4")
    service = Service(lab.settings, lambda path, role: {})
    assert service.delete_what_is_over(timedelta(days=30)) == 1
    service.close()
    left = {session["id"] for session in lab.client.sessions()}
    assert old not in left
    assert worked_on in left


def test_a_deletion_goes_on_until_nothing_is_left(lab, capture, monkeypatch):
    session = lab.complete_session(capture)
    prefix = f"labs/default/sessions/{session}"
    service = Service(lab.settings, lambda path, role: {})
    store = Store.open(lab.settings.resolved_objects_url)
    with monkeypatch.context() as patched:  # a store out of reach, or a process that is killed in the middle
        patched.setattr(Store, "delete", lambda *_: (_ for _ in ()).throw(ResourceError("down", hint="wait")))
        service.delete_session("default", session)
    assert lab.http.get(f"/v1/sessions/{session}").status_code == 404
    assert store.is_there(prefix)
    service.erase_again()
    assert not store.is_there(prefix)
    store.put_bytes(f"{prefix}/jobs/x", "late.npz", b"of a worker that had not heard")
    told = next(item for item in lab.http.get("/v1/erasures").json()["items"] if item["session"] == session)
    assert told["done_at"] is None  # a minute has to pass
    with service._database.write() as db:
        db.execute(sa.update(ErasureRow).values(created_at=now() - timedelta(hours=1)))
    service.erase_again()
    assert not store.is_there(prefix)
    told = next(item for item in lab.http.get("/v1/erasures").json()["items"] if item["session"] == session)
    assert told["done_at"] is not None
    service.close()
