"""Keys, scopes and labs: who gets in, who sees what, and what is kept of it."""

import re
import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from gonio.cli import main as gonio_main
from gonio.client import Client
from gonio.errors import InputError
from gonio.http.app import create_app
from gonio.jobs.access import SCOPES, opened
from gonio.settings import Settings

NOBODY = "00000000-0000-4000-8000-000000000000"
UPLOAD = {  # what an upload's routes want beside the key
    "Tus-Resumable": "1.0.0",
    "Upload-Length": "9",
    "Upload-Offset": "0",
    "Upload-Metadata": "filename YS5tcDQ=",
    "Content-Type": "application/offset+octet-stream",
}
PUBLIC = {"/healthz", "/readyz"}
SIGNING = {"/sign-in", "/sign-out", "/metrics"}  # which have tests of their own


def make_key(settings, lab: str, *scopes, lifetime=None) -> str:
    with opened(settings) as access:
        return access.create_key(lab, f"{lab}'s", scopes or SCOPES, lifetime).secret


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def answer(response) -> tuple[int, str]:
    code = "" if response.request.method == "HEAD" else response.json().get("code", "")
    return response.status_code, code


@pytest.fixture(scope="module")
def labs(keyed_lab, capture, tmp_path_factory):
    """A service with the labs north, which has a session with files, a job and a report, and south, which has nothing."""
    lab = keyed_lab
    north, south = make_key(lab.settings, "north"), make_key(lab.settings, "south")
    journal = tmp_path_factory.mktemp("journal") / "journal"
    journal.touch()
    with Client(lab.url, key=north) as client:
        session = client.create_session(name="Anna")["id"]
        for path in sorted(capture.iterdir()):
            client.upload(session, path)
        job = client.analyse(session, {"journal": str(journal)})["id"]
        client.wait(job, timeout_s=180)
        ids = {
            "session_id": session,
            "file_id": client.files(session)[0]["id"],
            "job_id": job,
            "report_id": job,
            "calibration_id": job,
            "name": client.report_files(job)[0]["name"],
            "webhook_id": httpx.post(
                f"{lab.url}/v1/webhooks", json={"url": "http://127.0.0.1:9"}, headers=bearer(north)
            ).json()["id"],
            "upload_id": httpx.post(f"{lab.url}/v1/sessions/{session}/uploads", headers={**bearer(north), **UPLOAD})
            .headers["location"]
            .rpartition("/")[2],
        }
        yield lab, north, south, ids


def routes() -> list[tuple[str, str]]:
    documented = create_app(Settings()).openapi()["paths"]
    return [(method.upper(), path) for path, methods in documented.items() for method in methods if path not in SIGNING]


@pytest.mark.parametrize(("method", "path"), routes(), ids=lambda value: str(value).strip("/"))
def test_no_route_shows_or_changes_anything_of_another_lab(labs, method, path):
    lab, north, south, ids = labs
    key_id = httpx.get(f"{lab.url}/v1/keys", headers=bearer(north)).json()["items"][0]["id"]
    url = lab.url + path.format(**ids, key_id=key_id)
    bodies = {"/v1/sessions": {"kind": "human_multicamera"}, "/v1/webhooks": {"url": "http://127.0.0.1:9"}}
    body = bodies.get(path, {"name": "a", "scopes": ["read"]})
    how = {"json": body} if method == "POST" and not path.endswith("/files") and "analyses" not in path else {}
    headers = UPLOAD if "/uploads" in path else {}
    if path in PUBLIC or method == "OPTIONS":
        assert httpx.request(method, url, **how).status_code in (200, 204)
        return

    def code(name: str) -> str:
        return "" if method == "HEAD" else name

    assert answer(httpx.request(method, url, headers=headers, **how)) == (401, code("key-missing"))
    invalid = {**headers, **bearer(north + "x")}
    assert answer(httpx.request(method, url, headers=invalid, **how)) == (401, code("key-invalid"))
    response = httpx.request(method, url, headers={**headers, **bearer(south)}, **how)
    if "{" in path:
        assert answer(response) == (404, code("not-found"))
        return
    # What has no id in its address: a list, which must be empty of the other lab's, or something new of one's own.
    assert response.status_code in (200, 201)
    assert not {value for value in ids.values() if value in response.text}
    assert "Anna" not in response.text
    assert "north" not in response.text


def test_a_subject_has_the_sessions_of_their_own_lab_only(labs):
    lab, north, south, _ = labs
    sessions, codes = f"{lab.url}/v1/sessions", ("P07", "P07", "P08", "P'07%")
    made: dict[str, list[str]] = {}
    for key in (north, south):
        for code in codes:
            body = {"kind": "human_multicamera", "subject": {"code": code}}
            made.setdefault(key + code, []).append(httpx.post(sessions, json=body, headers=bearer(key)).json()["id"])
    for key in (north, south):
        for code in set(codes):
            found = httpx.get(sessions, params={"subject": code}, headers=bearer(key)).json()["items"]
            assert {one["id"] for one in found} == set(made[key + code])
            assert {one["subject"]["code"] for one in found} == {code}
    assert httpx.get(sessions, params={"subject": "P09"}, headers=bearer(north)).json()["items"] == []


def test_a_foreign_calibration_cannot_be_named(labs):
    lab, _, south, _ = labs
    body = {"kind": "human_multicamera", "calibration": NOBODY}
    assert answer(httpx.post(f"{lab.url}/v1/sessions", json=body, headers=bearer(south))) == (404, "not-found")


def test_a_key_may_do_what_its_scopes_say(labs):
    lab, _, _, _ = labs
    body = {"kind": "human_multicamera"}
    reader, writer = make_key(lab.settings, "west", "read"), make_key(lab.settings, "west", "write")
    sessions, keys, audit = (f"{lab.url}/v1/{name}" for name in ("sessions", "keys", "audit"))
    assert httpx.get(sessions, headers=bearer(reader)).status_code == 200
    assert answer(httpx.post(sessions, json=body, headers=bearer(reader))) == (403, "scope-missing")
    assert answer(httpx.get(sessions, headers=bearer(writer))) == (403, "scope-missing")
    assert httpx.post(sessions, json=body, headers=bearer(writer)).status_code == 201
    for url in (keys, audit):
        assert answer(httpx.get(url, headers=bearer(reader))) == (403, "scope-missing")


def test_keys_are_made_rotated_and_revoked_over_http(labs):
    lab, _, _, _ = labs
    chief = make_key(lab.settings, "east")
    keys, sessions = f"{lab.url}/v1/keys", f"{lab.url}/v1/sessions"
    made = httpx.post(keys, json={"name": "script", "scopes": ["write", "read"]}, headers=bearer(chief)).json()
    assert made["scopes"] == ["read", "write"]
    assert httpx.get(sessions, headers=bearer(made["key"])).status_code == 200
    url = f"{keys}/{made['id']}"
    rotated = httpx.post(f"{url}/rotate", params={"grace_hours": 1}, headers=bearer(chief)).json()
    assert (rotated["scopes"], rotated["expires_at"]) == (made["scopes"], None)
    short = httpx.post(
        keys, json={"name": "guest", "scopes": ["read"], "lifetime_days": 1}, headers=bearer(chief)
    ).json()
    again = httpx.post(f"{keys}/{short['id']}/rotate", headers=bearer(chief)).json()
    assert again["expires_at"] is not None  # or whoever has a key for a day would have one for ever
    for key in (made["key"], rotated["key"]):  # both are valid in the time of grace
        assert httpx.get(sessions, headers=bearer(key)).status_code == 200
    assert httpx.delete(url, headers=bearer(chief)).status_code == 204
    assert answer(httpx.get(sessions, headers=bearer(made["key"]))) == (401, "key-invalid")
    assert answer(httpx.post(f"{url}/rotate", headers=bearer(chief))) == (409, "key-expired")
    shown = {key["id"]: key for key in httpx.get(keys, headers=bearer(chief)).json()["items"]}
    assert len(shown) == 5
    assert shown[made["id"]]["last_used_at"] is not None
    assert "key" not in shown[made["id"]]


def test_the_key_itself_is_kept_nowhere(labs):
    lab, north, _, _ = labs
    httpx.get(f"{lab.url}/v1/sessions", headers=bearer(north))
    for path in (path for path in lab.settings.data_dir.rglob("*") if path.is_file()):
        assert north.encode() not in path.read_bytes(), path
    assert north not in lab.log.read_text()


def test_an_expired_key_is_refused(labs):
    lab, _, _, _ = labs
    key = make_key(lab.settings, "north", lifetime=timedelta(seconds=-1))
    assert answer(httpx.get(f"{lab.url}/v1/sessions", headers=bearer(key))) == (401, "key-invalid")


@pytest.mark.parametrize(
    "sent", ["Bearer", "Basic !", "Basic eA==", "Token x", "Bearer " + "x" * 9000, "Bearer gonio_ü"]
)
def test_a_strange_authorization_is_refused(labs, sent):
    lab, *_ = labs
    response = httpx.get(f"{lab.url}/v1/sessions", headers={"Authorization": sent.encode()})
    assert answer(response) in {(401, "key-missing"), (401, "key-invalid")}
    assert response.headers["www-authenticate"].startswith(("Bearer", "Basic"))


def test_a_browser_asks_for_the_key_and_may_send_it_as_password(labs):
    lab, north, _, ids = labs
    page = f"{lab.url}/v1/reports/{ids['report_id']}/files/report.html"
    refused = httpx.get(page, headers={"Accept": "text/html"})
    assert refused.headers["www-authenticate"] == 'Basic realm="gonio"'
    assert httpx.get(page, auth=("", north)).status_code == 200
    assert "Anna" in httpx.get(f"{lab.url}/v1/sessions", auth=("somebody", north)).text
    foreign = httpx.post(
        f"{lab.url}/v1/jobs/{ids['job_id']}/cancel", auth=("", north), headers={"Sec-Fetch-Site": "cross-site"}
    )
    assert answer(foreign) == (403, "foreign-page")


def test_who_read_what_of_a_subject_is_kept(labs):
    lab, north, _, ids = labs
    httpx.get(f"{lab.url}/v1/reports/{ids['report_id']}", headers=bearer(north))
    httpx.get(f"{lab.url}/v1/sessions/{ids['session_id']}/files/{ids['file_id']}", headers=bearer(north))
    entries = httpx.get(f"{lab.url}/v1/audit", params={"session": ids["session_id"]}, headers=bearer(north)).json()[
        "items"
    ]
    key = next(
        row["id"]
        for row in httpx.get(f"{lab.url}/v1/keys", headers=bearer(north)).json()["items"]
        if row["last_used_at"]
    )
    assert {entry["what"] for entry in entries} >= {"report", "file calibration.xml"}
    assert {entry["session"] for entry in entries} == {ids["session_id"]}
    assert key in {entry["key"] for entry in entries}


def test_without_keys_only_the_machine_itself_gets_in(start_lab):
    lab = start_lab(workers=0)
    url = f"{lab.url}/v1/sessions"
    assert httpx.get(url).status_code == 200
    for headers in ({"X-Forwarded-For": "10.0.0.7"}, {"Via": "1.1 proxy"}, {"Host": "evil.example"}):
        assert answer(httpx.get(url, headers=headers)) == (401, "key-missing"), headers
    assert answer(httpx.post(url, json={}, headers={"Sec-Fetch-Site": "cross-site"})) == (403, "foreign-page")
    # What a browser says that is too old for Sec-Fetch-Site.
    for origin in ("https://elsewhere.example", "null"):
        assert answer(httpx.post(url, json={}, headers={"Origin": origin})) == (403, "foreign-page")
    assert httpx.post(url, json={}, headers={"Origin": lab.url}).status_code == 422
    key = make_key(lab.settings, "first")
    assert answer(httpx.get(url)) == (401, "key-missing")
    with opened(lab.settings) as access:
        access.revoke_key("first", access.keys("first")[0].id)
    assert answer(httpx.get(url, headers=bearer(key))) == (401, "key-invalid")
    assert answer(httpx.get(url)) == (401, "key-missing")  # the last key's end does not open the door again


@pytest.mark.parametrize("values", [{"host": "0.0.0.0"}, {"database_url": "sqlite:///{}/elsewhere.db"}], ids=str)
def test_a_service_that_is_not_for_itself_alone_wants_keys(start_lab, tmp_path, values):
    """As does one with the setting keys=required: that is the service of the tests above."""
    lab = start_lab(workers=0, **{name: value.format(tmp_path) for name, value in values.items()})
    port = httpx.URL(lab.url).port
    assert answer(httpx.get(f"http://127.0.0.1:{port}/v1/sessions")) == (401, "key-missing")


def test_the_command_line_makes_lists_rotates_and_revokes(tmp_path, monkeypatch, capsys):
    """The first key is made by a process; the other commands run in this one, which has loaded what they need."""
    monkeypatch.setenv("GONIO_DATA_DIR", str(tmp_path))

    def gonio(*words: str) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", ["gonio", "keys", *words])
        with pytest.raises(SystemExit) as ended:
            gonio_main()
        out, err = capsys.readouterr()
        assert ended.value.code == (1 if err else 0)
        return out.strip(), err

    command = [str(Path(sys.executable).with_name("gonio")), *"keys create north --name door --scope read".split()]
    first = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert re.fullmatch(r"gonio_[\w-]{43}", first)
    listed, _ = gonio("list", "north")
    assert "read  door  (never used" in listed
    second, _ = gonio("rotate", "north", listed.split()[0], "--grace-hours", "0")
    settings = Settings(data_dir=tmp_path)
    with opened(settings) as access:
        assert access.caller(first) is None
        caller = access.caller(second)
        assert caller is not None
        assert (caller.lab, caller.scopes) == ("north", ("read",))
    assert "scope-unknown" in gonio("create", "north", "--scope", "root")[1]
    assert "lab-name-wrong" in gonio("create", "../north")[1]
    assert "not-found" in gonio("revoke", "south", listed.split()[0])[1]
    assert "not-found" in gonio("revoke", "north", str(uuid4()))[1]


def test_a_lab_name_is_checked(tmp_path):
    with opened(Settings(data_dir=tmp_path)) as access, pytest.raises(InputError, match="can't be the name"):
        access.create_key("North Lab", "x", ["read"])


def test_a_browser_signs_in_with_a_cookie_that_no_script_can_read(labs):
    lab, north, _, ids = labs
    with httpx.Client(base_url=lab.url) as browser:
        assert browser.get("/").status_code == 200  # the page itself holds nobody's data
        assert answer(browser.get("/v1/caller")) == (401, "key-missing")
        assert answer(browser.post("/sign-in", json={"key": "gonio_wrong"})) == (401, "key-invalid")
        foreign = {"sec-fetch-site": "cross-site"}
        assert answer(browser.post("/sign-in", json={"key": north}, headers=foreign)) == (403, "foreign-page")
        cookie = browser.post("/sign-in", json={"key": north}).headers["set-cookie"]
        assert {"HttpOnly", "SameSite=strict"} <= set(cookie.split("; "))
        assert browser.get("/v1/caller").json() == {"lab": "north", "scopes": list(SCOPES), "signed_in": True}
        assert browser.get(f"/v1/reports/{ids['report_id']}/files/{ids['name']}").status_code == 200
        body = {"kind": "human_multicamera"}
        assert answer(browser.post("/v1/sessions", json=body, headers=foreign)) == (403, "foreign-page")
        assert browser.post("/sign-out").status_code == 204
        assert answer(browser.get("/v1/caller")) == (401, "key-missing")
