"""Uploads by tus 1.0: cut, gone on with, refused, given up; and the server killed in the middle."""

import asyncio
import base64
import hashlib
import random
import socket
import threading
import time
from contextlib import suppress

import httpx
import pytest
from starlette.requests import ClientDisconnect, Request

import gonio.client
import gonio.http.uploads
from gonio.client import Client
from gonio.errors import InputError, ResourceError
from gonio.http.uploads import body_of
from gonio.jobs.liveness import try_hold_folder
from gonio.jobs.partial import PartialUploads, Upload
from gonio.jobs.spool import Spool

TUS = {"Tus-Resumable": "1.0.0"}
PIECE = {**TUS, "Content-Type": "application/offset+octet-stream"}


def metadata(**fields: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in fields.items())


@pytest.fixture(scope="module")
def session(lab) -> str:
    return lab.client.create_session(name="uploads")["id"]


@pytest.fixture
def video(capture) -> bytes:
    return (capture / "cam01.mp4").read_bytes()


def create(lab, session: str, length: int, **fields: str) -> httpx.Response:
    headers = {**TUS, "Upload-Length": str(length), "Upload-Metadata": metadata(**fields)}
    return lab.http.post(f"/v1/sessions/{session}/uploads", headers=headers)


def begin(lab, session: str, content: bytes, name: str) -> str:
    made = create(lab, session, len(content), filename=name)
    assert made.status_code == 201, made.text
    assert made.headers["upload-offset"] == "0"
    assert "GMT" in made.headers["upload-expires"]
    return made.headers["location"]


def patch(lab, url: str, offset: int, content: bytes, **headers: str) -> httpx.Response:
    return lab.http.patch(url, content=content, headers={**PIECE, "Upload-Offset": str(offset), **headers})


def refusal(response: httpx.Response) -> tuple[int, str]:
    assert response.headers["tus-resumable"] == "1.0.0"
    return response.status_code, response.json()["code"]


def test_the_service_says_what_of_tus_it_speaks(lab):
    said = lab.http.options("/v1/uploads").headers
    assert said["tus-version"] == "1.0.0"
    assert said["tus-extension"] == "creation,termination,checksum,expiration"
    assert said["tus-max-size"] == str(lab.settings.max_upload_bytes)


def test_a_file_comes_in_pieces_and_is_accepted_with_the_last(lab, session, video):
    url = begin(lab, session, video, "a1.mp4")
    half = len(video) // 2
    first = patch(lab, url, 0, video[:half])
    assert (first.status_code, first.headers["upload-offset"]) == (204, str(half))
    assert "content-location" not in first.headers
    stands = lab.http.head(url, headers=TUS)
    assert (stands.headers["upload-offset"], stands.headers["upload-length"]) == (str(half), str(len(video)))
    assert stands.headers["cache-control"] == "no-store"
    last = patch(lab, url, half, video[half:])
    assert (last.status_code, last.headers["upload-offset"]) == (204, str(len(video)))
    assert lab.http.get(last.headers["content-location"]).content == video
    again = lab.http.head(url, headers=TUS)  # for a client that missed the answer
    assert again.headers["content-location"] == last.headers["content-location"]
    file = next(file for file in lab.client.files(session) if file["name"] == "a1.mp4")
    assert file["sha256"] == hashlib.sha256(video).hexdigest()
    assert file["facts"]["frames"] == 8


def test_a_wrong_offset_a_wrong_checksum_and_too_many_bytes_keep_nothing(lab, session, video):
    url = begin(lab, session, video, "a2.mp4")
    assert refusal(patch(lab, url, 5, video)) == (409, "upload-offset-wrong")
    digest = base64.b64encode(hashlib.sha256(video[:100]).digest()).decode()
    assert refusal(patch(lab, url, 0, video[:99], **{"Upload-Checksum": f"sha256 {digest}"})) == (
        460,
        "upload-checksum-wrong",
    )
    assert refusal(patch(lab, url, 0, video[:100], **{"Upload-Checksum": "crc32 AAAA"})) == (400, "upload-header-wrong")
    assert refusal(patch(lab, url, 0, video + b"x")) == (413, "upload-too-long")
    assert refusal(lab.http.patch(url, content=b"x", headers={**TUS, "Upload-Offset": "0"})) == (
        415,
        "unsupported-media-type",
    )
    assert lab.http.head(url, headers=TUS).headers["upload-offset"] == "0"
    good = patch(lab, url, 0, video[:100], **{"Upload-Checksum": f"sha256 {digest}"})
    assert (good.status_code, good.headers["upload-offset"]) == (204, "100")
    assert lab.http.delete(url, headers=TUS).status_code == 204
    assert lab.http.head(url, headers=TUS).status_code == 404


@pytest.mark.parametrize(
    ("length", "fields", "expected"),
    [
        (100, {"filename": "../a.mp4"}, (422, "bad-file-name")),
        (100, {"filename": "a.xyz"}, (422, "role-unknown")),
        (100, {"filename": "a.mp4", "role": "sweep"}, (422, "role-wrong")),
        (100, {"filename": "a.mp4", "role": "nonsense"}, (422, "invalid-request")),
        (4_000_000, {"filename": "a.mp4"}, (413, "file-too-large")),
        (-1, {"filename": "a.mp4"}, (422, "invalid-request")),
        (10**30, {"filename": "a.mp4"}, (422, "invalid-request")),
    ],
)
def test_what_can_be_known_beforehand_is_refused_at_the_beginning(lab, session, length, fields, expected):
    assert refusal(create(lab, session, length, **fields)) == expected


def test_headers_that_are_missing_or_wrong_are_refused(lab, session):
    url = f"/v1/sessions/{session}/uploads"
    wanted = {"Upload-Length": "3", "Upload-Metadata": metadata(filename="a.mp4")}
    assert refusal(lab.http.post(url, headers=wanted)) == (422, "invalid-request")
    assert refusal(lab.http.post(url, headers={**wanted, "Tus-Resumable": "0.2.2"})) == (412, "tus-version-unsupported")
    wrong = {**wanted, **TUS, "Upload-Metadata": "filename !"}
    assert refusal(lab.http.post(url, headers=wrong)) == (400, "upload-header-wrong")
    assert refusal(lab.http.post(url, headers=TUS)) == (422, "invalid-request")


def test_a_whole_file_that_is_not_what_it_says_is_refused_and_removed(lab, session):
    url = begin(lab, session, b"x" * 500, "a3.mp4")
    assert refusal(patch(lab, url, 0, b"x" * 500)) == (422, "not-a-video")
    assert lab.http.head(url, headers=TUS).status_code == 404


def half_a_piece(lab, url: str, content: bytes, sent: int) -> socket.socket:
    """Begin to send a piece, and stop in the middle."""
    address = httpx.URL(lab.url)
    connection = socket.create_connection((address.host, address.port))
    head = [f"PATCH {url} HTTP/1.1", f"Host: {address.host}", f"Content-Length: {len(content)}", "Upload-Offset: 0"]
    head += [f"{name}: {value}" for name, value in PIECE.items()]
    connection.sendall(("\r\n".join(head) + "\r\n\r\n").encode() + content[:sent])
    return connection


def test_two_senders_of_one_upload_one_is_refused_at_once_and_nobody_else_waits(lab, session):
    content = b"x" * 2_500_000
    url = begin(lab, session, content, "a4.mp4")
    with half_a_piece(lab, url, content, 2_000_000):
        deadline_s = time.monotonic() + 30
        while lab.http.head(url, headers=TUS).headers["upload-offset"] == "0":
            assert time.monotonic() < deadline_s
        assert refusal(patch(lab, url, 0, content)) == (423, "upload-locked")
        assert lab.http.delete(url, headers=TUS).status_code == 423
        assert lab.http.get("/healthz").status_code == 200
    while True:  # what came before the cut is kept, to the last byte
        with suppress(KeyError):
            if int(lab.http.head(url, headers=TUS).headers["upload-offset"]) == 2_000_000:
                break
        assert time.monotonic() < deadline_s
    while (ended := lab.http.delete(url, headers=TUS)).status_code == 423:  # the cut request still lets go of it
        assert time.monotonic() < deadline_s
    assert ended.status_code == 204


def test_to_ask_where_an_upload_stands_is_not_to_hold_it(lab, session):
    """Or who asks at the same moment could have its first piece refused."""
    url = begin(lab, session, b"x" * 100, "a5.mp4")
    with try_hold_folder(lab.settings.data_dir / "uploads" / url.rpartition("/")[2]) as free:
        assert free
        assert lab.http.head(url, headers=TUS).headers["upload-offset"] == "0"
        assert refusal(patch(lab, url, 0, b"x")) == (423, "upload-locked")


def test_uploads_end_with_their_session_and_expire(lab, tmp_path):
    session = lab.client.create_session()["id"]
    url = begin(lab, session, b"x" * 100, "a.mp4")
    lab.client.delete_session(session)
    assert lab.http.head(url, headers=TUS).status_code == 404

    uploads = PartialUploads(tmp_path, Spool(tmp_path / "spool", limit=1000, free_disk_floor=0), lifetime_s=0.2)
    upload: Upload = uploads.create("lab", session, "a.mp4", None, None, 100)
    uploads.sweep()
    assert uploads.get("lab", upload.id) == upload
    with pytest.raises(InputError, match="no such upload"):
        uploads.get("other", upload.id)
    time.sleep(0.3)
    with pytest.raises(InputError, match="no such upload"):
        uploads.get("lab", upload.id)
    uploads.sweep()
    assert not (tmp_path / upload.id).exists()


def test_a_sender_that_falls_silent_is_taken_for_gone(monkeypatch):
    """Or a connection that nobody closed would hold the upload for hours, and its sender could not go on with it."""
    monkeypatch.setattr(gonio.http.uploads, "SILENCE_S", 0.05)
    messages = [{"type": "http.request", "body": b"abc", "more_body": True}]

    async def receive():
        if not messages:
            await asyncio.Event().wait()
        return messages.pop()

    async def read(received: list[bytes]) -> None:
        async for chunk in body_of(Request({"type": "http", "method": "PATCH", "headers": []}, receive)):
            received.append(chunk)

    received: list[bytes] = []
    with pytest.raises(ClientDisconnect):
        asyncio.run(read(received))
    assert received == [b"abc"]


def test_the_client_goes_on_whatever_the_cut_request_still_does_and_whenever_the_service_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(gonio.client, "RESUMABLE_BYTES", 1)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    (tmp_path / "a.mp4").write_bytes(b"0123456789")
    file = {"content": "/v1/sessions/s/files/f"}
    whole = {"Upload-Offset": "10", "Content-Location": file["content"]}
    wrong_offset = {"code": "upload-offset-wrong", "detail": "", "hint": ""}
    script = [
        ("POST", "", httpx.ConnectError("starting anew")),
        ("POST", "", httpx.Response(201, headers={"Location": "/v1/uploads/u"})),
        ("PATCH", "0", httpx.WriteError("cut")),
        ("HEAD", "", httpx.Response(200, headers={"Upload-Offset": "3"})),  # the cut request still writes
        ("PATCH", "3", httpx.Response(409, json=wrong_offset)),
        ("HEAD", "", httpx.Response(423)),
        ("HEAD", "", httpx.Response(200, headers={"Upload-Offset": "6"})),
        ("PATCH", "6", httpx.Response(204, headers=whole)),
        ("GET", "", httpx.ReadError("killed before it told of the file")),
        ("HEAD", "", httpx.Response(200, headers=whole)),
        ("GET", "", httpx.Response(200, json={"items": [file]})),
    ]
    sent: list[bytes] = []

    def answer(request: httpx.Request) -> httpx.Response:
        method, offset, said = script.pop(0)
        assert (request.method, request.headers.get("Upload-Offset", "")) == (method, offset)
        if method == "PATCH":
            sent.append(request.read())
        if isinstance(said, Exception):
            raise said
        return said

    with Client(transport=httpx.MockTransport(answer)) as client:
        assert client.upload("s", tmp_path / "a.mp4") == file
    assert (script, sent) == ([], [b"0123456789", b"3456789", b"6789"])


def test_the_client_gives_up_at_once_what_no_patience_mends(tmp_path, monkeypatch):
    monkeypatch.setattr(gonio.client, "RESUMABLE_BYTES", 1)
    (tmp_path / "a.mp4").write_bytes(b"0123456789")
    full = httpx.Response(507, json={"code": "quota-exceeded", "detail": "", "hint": ""})
    with (
        Client(transport=httpx.MockTransport(lambda _: full)) as client,
        pytest.raises(ResourceError) as caught,
    ):
        client.upload("s", tmp_path / "a.mp4")
    assert caught.value.code == "quota-exceeded"


def test_what_is_announced_counts_against_the_quota(start_lab, capture):
    """Or a lab could begin any number of uploads, each below its quota, and fill the disk of all."""
    lab = start_lab(workers=0, lab_quota_bytes=1_000_000)
    session = lab.client.create_session()["id"]
    url = begin(lab, session, b"x" * 600_000, "a.mp4")
    assert refusal(create(lab, session, 600_000, filename="b.mp4")) == (507, "quota-exceeded")
    assert lab.http.delete(url, headers=TUS).status_code == 204
    assert create(lab, session, 600_000, filename="b.mp4").status_code == 201
    lab.client.upload(session, capture / "cam01.mp4")  # a form: what is kept counts, and this is little


@pytest.mark.slow
def test_uploads_that_are_cut_at_random_go_on_while_the_server_is_killed(start_lab, tmp_path, capture):
    """A sample of what `gonio bench service` does a hundred times."""
    lab = start_lab(workers=0, max_upload_bytes=100_000_000)
    port = httpx.URL(lab.url).port
    session = lab.client.create_session()["id"]
    dice = random.Random(8)
    content = (capture / "cam01.mp4").read_bytes()
    content += b"\0\0\0\x08free" + dice.randbytes(12_000_000)  # larger than a form's limit in the client
    (tmp_path / "big.mp4").write_bytes(content)

    def cut(sent: int, _size: int) -> None:
        if dice.random() < 0.01:
            raise httpx.WriteError("cut")

    accepted: list[dict] = []

    def send() -> None:
        with Client(f"http://127.0.0.1:{port}") as client:
            accepted.append(client.upload(session, tmp_path / "big.mp4", on_progress=cut))

    sender = threading.Thread(target=send)
    sender.start()
    for _ in range(2):
        time.sleep(0.3)
        lab.process.kill()
        lab.process.wait()
        lab = start_lab(workers=0, port=port, max_upload_bytes=100_000_000)
    sender.join(60)
    assert [file["sha256"] for file in accepted] == [hashlib.sha256(content).hexdigest()]
    assert lab.http.get(accepted[0]["content"]).content == content
