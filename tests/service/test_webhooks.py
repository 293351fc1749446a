"""Webhooks: what is told when a job ends, signed, tried again, and to whom it may go."""

import hashlib
import hmac
import json
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from uuid import uuid4

import httpx
import pytest

import gonio.jobs.webhooks
from gonio.errors import InputError
from gonio.jobs.database import Database, upgrade
from gonio.jobs.repository import Repository
from gonio.jobs.tables import ACTIVE, DeliveryRow, JobRow, JobState, SessionRow, now
from gonio.jobs.webhooks import TRIES, Webhooks
from gonio.settings import Settings


class Ear:
    """A program that listens, and answers as it is told."""

    def __init__(self) -> None:
        self.heard: list[tuple[dict[str, str], bytes]] = []
        self.answers: list[int] = []
        ear = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                ear.heard.append(({name.lower(): value for name, value in self.headers.items()}, body))
                self.send_response(ear.answers.pop(0) if ear.answers else 204)
                self.send_header("location", "http://127.0.0.1:9/elsewhere")
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"


@pytest.fixture
def ear() -> Iterator[Ear]:
    ear = Ear()
    thread = threading.Thread(target=ear.server.serve_forever)
    thread.start()
    yield ear
    ear.server.shutdown()
    thread.join()
    ear.server.server_close()


@pytest.fixture
def database(tmp_path) -> Iterator[Database]:
    settings = Settings(data_dir=tmp_path)
    upgrade(settings)
    database = Database(settings.resolved_database_url)
    yield database
    database.close()


def end_a_job(database: Database, lab: str, state: JobState = JobState.SUCCEEDED) -> str:
    session_id, job_id = str(uuid4()), str(uuid4())
    with database.write(lab) as db:
        repository = Repository(db, lab)
        repository.add(SessionRow(id=session_id, kind="human_multicamera", name="Anna", subject={}))
        repository.add(JobRow(id=job_id, session_id=session_id, state=JobState.DOING, parameters={}, files=[]))
    with database.write(lab) as db:
        assert Repository(db, lab).change_job(job_id, ACTIVE, state=state)
        assert not Repository(db, lab).change_job(job_id, ACTIVE, state=JobState.FAILED)  # told once only
    return job_id


def make_due(database: Database) -> None:
    with database.write() as db:
        for row in db.query(DeliveryRow):
            row.due_at = now() if row.due_at else None


def test_the_end_of_a_job_is_told_signed_and_again_until_it_is_heard(database, ear):
    webhooks = Webhooks(database, allow_private=True)
    hook = webhooks.create("north", ear.url)
    ear.answers = [500, 302]
    job = end_a_job(database, "north", JobState.FAILED)
    for _ in range(4):
        webhooks.send_due()
        assert webhooks.send_due() == 0  # not before its pause is over
        make_due(database)
    assert len(ear.heard) == 3  # 500, a redirect that isn't followed, and 204; then no more
    headers, body = ear.heard[-1]
    told = json.loads(body)
    assert told == {"event": "job-ended", "job": job, "session": told["session"], "state": "failed"}
    time_s, digest = (part.split("=", 1)[1] for part in headers["gonio-signature"].split(","))
    assert digest == hmac.new(hook.secret.encode(), f"{time_s}.".encode() + body, hashlib.sha256).hexdigest()
    assert len({headers["gonio-delivery"] for headers, _ in ear.heard}) == 1
    (delivery,) = webhooks.deliveries("north", hook.id, 10)
    assert (delivery.attempts, delivery.answer, delivery.due_at) == (3, "204", None)
    assert delivery.delivered_at is not None


def test_only_the_own_lab_is_told_and_a_dead_address_is_given_up(database, ear):
    webhooks = Webhooks(database, allow_private=True)
    north, south = webhooks.create("north", "http://127.0.0.1:9/nobody"), webhooks.create("south", ear.url)
    end_a_job(database, "north")
    for _ in range(TRIES + 2):
        webhooks.send_due()
        make_due(database)
    assert ear.heard == []
    (delivery,) = webhooks.deliveries("north", north.id, 10)
    assert (delivery.attempts, delivery.answer, delivery.due_at) == (TRIES, "ConnectError", None)
    with pytest.raises(InputError, match="no such webhook"):
        webhooks.deliveries("north", south.id, 10)
    webhooks.delete("north", north.id)
    assert webhooks.list("north") == []
    assert [row.id for row in webhooks.list("south")] == [south.id]


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/",
        "https://127.0.0.1/",
        "https://localhost/",
        "https://[::1]/",
        "https://10.0.0.1/",
        "https://169.254.169.254/latest/meta-data",
        "https://user:password@example.org/",
        "file:///etc/passwd",
        "https://",
        "https://no-such-machine.invalid/",
        "https://[::ffff:10.0.0.1]/",
        "https://[::10.0.0.1]/",
        "https://[64:ff9b::10.0.0.1]/",
        "https://[2002:a00:1::]/",
        "https://224.0.0.1/",
    ],
)
def test_a_webhook_leads_nowhere_private(database, url):
    with pytest.raises(InputError) as caught:
        Webhooks(database, allow_private=False).create("north", url)
    assert caught.value.code == "webhook-address-wrong"


def test_a_message_goes_to_the_machine_that_was_checked(database, monkeypatch):
    """A name whose address changes between the check and the sending leads nowhere private."""
    asked: list[str] = []

    def resolve(host, port, **_):
        asked.append(host)
        address = "93.184.215.14" if host == "hook.example" else host
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port))]

    sent: list[httpx.Request] = []

    async def take(_self, request: httpx.Request) -> httpx.Response:
        sent.append(request)
        return httpx.Response(204)

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    monkeypatch.setattr(httpx.AsyncHTTPTransport, "handle_async_request", take)
    webhooks = Webhooks(database, allow_private=False)
    webhooks.create("north", "https://hook.example:8443/a?b=c")
    end_a_job(database, "north")
    webhooks.send_due()
    (request,) = sent
    assert str(request.url) == "https://93.184.215.14:8443/a?b=c"
    assert request.headers["host"] == "hook.example:8443"
    assert request.extensions["sni_hostname"] == "hook.example"
    assert asked == ["hook.example"] * 2  # when it was made, and before it was told


def test_a_program_that_answers_a_byte_at_a_time_holds_nobody_up(database, ear, monkeypatch):
    monkeypatch.setattr(gonio.jobs.webhooks, "TIMEOUT_S", 1.0)
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def trickle() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 200 OK\r\nX-Slow: ")
                while not over.wait(0.2):
                    connection.sendall(b"x")

        slow = threading.Thread(target=trickle)
        slow.start()
        webhooks = Webhooks(database, allow_private=True)
        hook = webhooks.create("north", f"http://127.0.0.1:{listener.getsockname()[1]}/")
        webhooks.create("south", ear.url)
        end_a_job(database, "north")
        end_a_job(database, "south")
        assert webhooks.send_due() == 2
        over.set()
        slow.join()
    assert len(ear.heard) == 1
    assert webhooks.deliveries("north", hook.id, 1)[0].answer == "TimeoutError"


def test_webhooks_over_http(lab, ear, capture, journal):
    made = lab.http.post("/v1/webhooks", json={"url": ear.url})
    assert made.status_code == 201
    assert made.json()["secret"]
    assert "secret" not in lab.http.get("/v1/webhooks").json()["items"][0]
    job = lab.client.analyse(lab.complete_session(capture), journal.parameters(seconds=0))["id"]
    lab.client.wait(job, timeout_s=90)
    for _ in range(200):
        sent = lab.http.get(f"{made.headers['location']}/deliveries").json()["items"]
        if sent and sent[0]["delivered_at"]:
            break
        threading.Event().wait(0.1)
    assert sent[0]["content"]["job"] == job
    assert json.loads(ear.heard[0][1])["state"] == "succeeded"
    assert lab.http.delete(made.headers["location"]).status_code == 204
    assert lab.http.post("/v1/webhooks", json={"url": "ftp://x"}).json()["code"] == "webhook-address-wrong"
