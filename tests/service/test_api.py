"""How the API answers: codes, headers, problem documents, its own description."""

import json
import re
import sqlite3
from contextlib import closing
from pathlib import Path
from uuid import uuid4

import pytest

from gonio.http.dashboard import PAGE
from gonio.http.problems import KINDS

PROBLEM = "application/problem+json"
NOBODY = "00000000-0000-4000-8000-000000000000"


def refusal(response) -> tuple[int, str]:
    assert response.headers["content-type"] == PROBLEM
    problem = response.json()
    assert problem["status"] == response.status_code
    assert {"type", "title", "status", "detail", "instance", "code", "hint"} <= set(problem)
    return response.status_code, problem["code"]


def create(lab, **body):
    return lab.http.post("/v1/sessions", json={"kind": "human_multicamera", **body})


def test_a_session_is_created_read_listed_and_deleted(lab):
    subject = {"mass_kg": 61.0, "stature_m": 1.68, "sex": "female"}
    created = create(lab, name="Anna", subject=subject)
    assert created.status_code == 201
    session = lab.http.get(created.headers["location"]).json()
    assert session == created.json()
    assert {key: session["subject"][key] for key in subject} == subject
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z", session["created_at"])
    assert session["id"] in {item["id"] for item in lab.client.sessions()}
    assert lab.http.delete(created.headers["location"]).status_code == 204
    assert refusal(lab.http.get(created.headers["location"])) == (404, "not-found")
    assert refusal(lab.http.delete(created.headers["location"])) == (404, "not-found")


@pytest.mark.parametrize(
    "body",
    [
        {"kind": "horse"},
        {},
        {"kind": "human_multicamera", "subject": {"mass_kg": -1}},
        {"kind": "human_multicamera", "subject": {"mass_kg": "heavy"}},
        {"kind": "human_multicamera", "subject": {"weight": 60}},
        {"kind": "human_multicamera", "name": "a\u0000b"},
        {"kind": "human_multicamera", "name": "x" * 201},
        {"kind": "human_multicamera", "unknown": 1},
        [],
        None,
    ],
    ids=str,
)
def test_a_wrong_session_is_refused_with_every_fault(lab, body):
    response = lab.http.post("/v1/sessions", json=body)
    assert refusal(response) == (422, "invalid-request")
    assert all(error["where"].startswith("body") and error["message"] for error in response.json()["errors"])


@pytest.mark.parametrize(
    ("content", "content_type", "expected"),
    [
        (b"{", "application/json", (400, "malformed-body")),
        (b"\xff\xfe", "application/json", (400, "malformed-body")),
        (b'{"kind": "human_multicamera", "subject": {"mass_kg": NaN}}', "application/json", (422, "invalid-request")),
        (b'{"kind": "human_multicamera", "subject": {"mass_kg": 1e999}}', "application/json", (422, "invalid-request")),
        (b'{"kind": "human_multicamera", "name": "\\ud800"}', "application/json", (422, "invalid-request")),
        (b"[" * 100_000, "application/json", (400, "malformed-body")),
        (b'{"x": ' + b"9" * 5000 + b"}", "application/json", (400, "malformed-body")),
        (b'{"kind": "human_multicamera"}', "text/plain", (422, "invalid-request")),
        (b"x" * 1_000_001, "application/json", (413, "body-too-large")),
    ],
    ids=range(9),
)
def test_a_wrong_body_is_refused(lab, content, content_type, expected):
    response = lab.http.post("/v1/sessions", content=content, headers={"content-type": content_type})
    assert refusal(response) == expected


def test_too_large_a_body_is_refused_also_when_its_length_is_not_announced(lab):
    def chunks():
        yield from (b" " * 100_000 for _ in range(12))

    response = lab.http.post("/v1/sessions", content=chunks(), headers={"content-type": "application/json"})
    assert refusal(response) == (413, "body-too-large")


@pytest.mark.parametrize(
    "bad", [NOBODY, "x", "%00", "1' OR '1'='1", "..%2f..%2fetc", "é" * 50, "9" * 3000], ids=lambda x: x[:20]
)
@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/v1/sessions/{}"),
        ("DELETE", "/v1/sessions/{}"),
        ("GET", "/v1/sessions/{}/files"),
        ("GET", "/v1/sessions/{}/files/" + NOBODY),
        ("DELETE", "/v1/sessions/" + NOBODY + "/files/{}"),
        ("POST", "/v1/sessions/{}/analyses"),
        ("GET", "/v1/jobs/{}"),
        ("POST", "/v1/jobs/{}/cancel"),
        ("GET", "/v1/reports/{}"),
        ("GET", "/v1/reports/{}/files"),
        ("GET", "/v1/reports/{}/files/report.html"),
        ("GET", "/problems/{}"),
        ("GET", "/nowhere/{}"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_404(lab, method, path, bad):
    assert refusal(lab.http.request(method, path.format(bad))) == (404, "not-found")


def test_an_upload_to_no_session_is_404_before_it_is_read(lab):
    response = lab.http.post(f"/v1/sessions/{NOBODY}/files", files={"file": ("a.mp4", b"x" * 2_000_000)})
    assert refusal(response) == (404, "not-found")


def test_a_wrong_method_is_405_and_says_which_are_right(lab):
    response = lab.http.put("/v1/sessions")
    assert refusal(response) == (405, "method-not-allowed")
    assert "POST" in response.headers["allow"] or "GET" in response.headers["allow"]


def test_lists_come_in_pages_without_gaps(lab):
    made = {create(lab, name=f"page {i}").json()["id"] for i in range(5)}
    seen: list[str] = []
    cursor, pages = None, 0
    while True:
        page = lab.http.get("/v1/sessions", params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
        assert len(page["items"]) <= 2
        seen += [item["id"] for item in page["items"]]
        cursor, pages = page["next_cursor"], pages + 1
        if cursor is None:
            break
    assert len(seen) == len(set(seen))
    assert made <= set(seen)
    assert pages >= 3
    assert refusal(lab.http.get("/v1/sessions", params={"cursor": "nonsense"})) == (422, "bad-cursor")
    assert refusal(lab.http.get("/v1/jobs", params={"limit": 0})) == (422, "invalid-request")


def test_an_analysis_of_an_incomplete_session_is_refused(lab, capture):
    session = create(lab).json()["id"]
    url = f"/v1/sessions/{session}/analyses"
    assert refusal(lab.http.post(url)) == (409, "calibration-missing")
    lab.client.upload(session, capture / "calibration.xml")
    assert refusal(lab.http.post(url)) == (409, "too-few-videos")
    lab.client.upload(session, capture / "cam01.mp4")
    refused = lab.http.post(url)
    assert refusal(refused) == (409, "too-few-videos")
    assert refused.json()["videos"] == 1
    lab.client.upload(session, capture / "cam02.mp4")
    assert lab.http.post(url, json={"parameters": {"subject": {}}}).status_code == 422
    json_header = {"content-type": "application/json"}
    assert lab.http.post(url, content=b'{"parameters": {"x": NaN}}', headers=json_header).status_code == 422
    assert lab.http.post(url, json={"parameters": []}).status_code == 422


def test_an_idempotency_key_gives_one_job(lab, capture, journal):
    session = lab.complete_session(capture)
    url, headers = f"/v1/sessions/{session}/analyses", {"Idempotency-Key": str(uuid4())}
    body = {"parameters": journal.parameters()}
    first = lab.http.post(url, json=body, headers=headers)
    assert first.status_code == 202
    assert first.headers["location"] == f"/v1/jobs/{first.json()['id']}"
    assert int(first.headers["retry-after"]) >= 1
    lab.client.wait(first.json()["id"], timeout_s=180)
    again = lab.http.post(url, json=body, headers=headers)
    assert again.json()["id"] == first.json()["id"]
    assert journal.lines().count("begin capture") == 1
    other = lab.http.post(url, json={"parameters": {}}, headers=headers)
    assert refusal(other) == (422, "idempotency-key-reused")
    elsewhere = lab.http.post(f"/v1/sessions/{lab.complete_session(capture)}/analyses", json=body, headers=headers)
    assert refusal(elsewhere) == (422, "idempotency-key-reused")


def test_a_job_has_an_etag_and_a_session_with_one_cannot_be_deleted(lab, capture, journal):
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(seconds=1.0))["id"]
    running = lab.http.get(f"/v1/jobs/{job}")
    assert int(running.headers["retry-after"]) >= 1
    busy = lab.http.delete(f"/v1/sessions/{session}")
    assert refusal(busy) == (409, "session-busy")
    assert busy.json()["jobs"] == [job]
    file = lab.client.files(session)[0]
    assert refusal(lab.http.delete(file["content"])) == (409, "session-busy")

    lab.client.wait(job, timeout_s=180)
    ended = lab.http.get(f"/v1/jobs/{job}")
    assert "retry-after" not in ended.headers
    assert ended.headers["etag"] != running.headers["etag"]
    same = lab.http.get(f"/v1/jobs/{job}", headers={"if-none-match": ended.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")


def test_a_report_page_is_shown_but_runs_nothing_and_data_files_are_saved(lab, capture, journal):
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(seconds=0.0))["id"]
    lab.client.wait(job, timeout_s=180)
    files = {file["name"]: file for file in lab.client.report_files(job)}
    assert {name: file["kind"] for name, file in files.items()} == {
        "report.json": "document",
        "report.html": "page",
        "knee.mot": "other",
    }
    page = lab.http.get(files["report.html"]["url"])
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert page.headers["content-disposition"].startswith("inline")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src" not in policy
    saved = lab.http.get(files["knee.mot"]["url"])
    assert saved.headers["content-disposition"] == 'attachment; filename="knee.mot"'
    for answer in (page, saved, lab.http.get(f"/v1/reports/{job}")):
        assert answer.headers["x-content-type-options"] == "nosniff"
    assert lab.http.get(f"/v1/reports/{job}").headers["content-type"] == "application/json"
    assert refusal(lab.http.get(f"/v1/reports/{job}/files/other.html")) == (404, "not-found")


def test_an_internal_error_leaks_nothing(lab):
    session = create(lab).json()["id"]
    with closing(sqlite3.connect(lab.settings.data_dir / "gonio.db")) as database, database:
        database.execute("UPDATE sessions SET subject = '[1]' WHERE id = ?", [session])  # a row that nobody foresaw
    response = lab.http.get(f"/v1/sessions/{session}")
    assert refusal(response) == (500, "internal-error")
    assert "mapping" not in response.text
    assert str(lab.settings.data_dir) not in response.text
    assert "Traceback" not in response.text
    log = lab.log.read_text()
    assert response.json()["reference"] in log
    assert "TypeError" in log
    with closing(sqlite3.connect(lab.settings.data_dir / "gonio.db")) as database, database:
        database.execute("DELETE FROM sessions WHERE id = ?", [session])
    assert lab.client.is_ready()


def test_health(lab):
    assert lab.http.get("/healthz").json()["status"] == "alive"
    assert lab.http.get("/readyz").json()["status"] == "ready"


def test_the_dashboard_is_a_page_that_may_load_from_here_only(lab):
    page = lab.http.get("/")
    assert page.status_code == 200
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    if not (PAGE / "index.html").is_file():
        assert "was not built" in page.text
        pytest.skip("the dashboard is not built (make .venv/dashboard)")
    assert not re.findall(r"(?:src|href)=\"(?:https?:)?//", page.text)
    assets = re.findall(r'(?:src|href)="\./(assets/[^"]+)"', page.text)
    assert len(assets) == 2  # a script and a style
    for asset in assets:
        answer = lab.http.get(f"/{asset}")
        assert answer.status_code == 200
        assert "immutable" in answer.headers["cache-control"]
    assert refusal(lab.http.get("/assets/none.js")) == (404, "not-found")


@pytest.mark.slow
def test_pages_for_people_load_nothing_from_elsewhere_and_run_nothing(lab, capture, journal):
    session = create(lab, name="<script>alert(1)</script>").json()["id"]
    for path in capture.iterdir():
        lab.client.upload(session, path)
    job = lab.client.analyse(session, journal.parameters(seconds=0.0))["id"]
    lab.client.wait(job, timeout_s=180)
    for address in ("/docs", "/problems", "/problems/too-few-videos"):
        page = lab.http.get(address)
        assert page.status_code == 200
        assert page.headers["content-type"] == "text/html; charset=utf-8"
        assert "<script" not in page.text
        assert not re.findall(r"(?:src|href)=\"(?:https?:)?//", page.text)
        for link in set(re.findall(r'href="(/[^"#]*)"', page.text)):
            assert lab.http.get(link).status_code == 200, link
    reference = lab.http.get("/docs").text
    assert all(path in reference for path in lab.http.get("/openapi.json").json()["paths"])


def test_the_committed_openapi_document_is_that_of_the_code(lab):
    committed = Path(__file__).parents[2] / "docs" / "reference" / "openapi.json"
    assert json.loads(committed.read_text()) == lab.http.get("/openapi.json").json(), "run `make reference`"


def test_the_openapi_document_is_complete(lab):
    document = lab.http.get("/openapi.json").json()
    assert document["openapi"].startswith("3.1")
    text = json.dumps(document)
    for reference in set(re.findall(r'"\$ref": "#/components/schemas/([^"]+)"', text)):
        assert reference in document["components"]["schemas"], reference
    assert "HTTPValidationError" not in text
    documented: set[str] = set()
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            where = f"{method} {path}"
            assert operation["summary"], where
            assert operation["description"], where
            for status, response in operation["responses"].items():
                assert response["description"], f"{where} {status}"
                if status >= "400":
                    assert list(response["content"]) == [PROBLEM], f"{where} {status}"
                    documented |= set(re.findall(r"`([a-z-]+)`: ", response["description"]))
            assert "500" in operation["responses"], where
            assert "422" in operation["responses"], where
            if "{" in path:
                assert "404" in operation["responses"], where
    # What is left is answered by the framework for any address, is a job's problem, or stands for a class of errors.
    everywhere = {"method-not-allowed", "http-error", "worker-crashed", "artefact-damaged"}
    classes = {"invalid-input", "capture-insufficient", "solver-failed", "resource-missing", "cancelled"}
    assert documented == set(KINDS) - everywhere - classes
