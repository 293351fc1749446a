"""A hundred hostile inputs: each is refused with a documented problem, and memory and disk stay bounded."""

import json
import re
import socket
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from gonio.formats.pressure_card import DEFAULT_COLUMNS
from gonio.http.problems import KINDS

MOST_MEMORY = 600_000_000
"""What the API may grow by over all of this: the libraries that look into files (300 MB), and one picture."""

NOBODY = "00000000-0000-4000-8000-000000000000"


@pytest.fixture(scope="module")
def lab(lab_without_worker):
    return lab_without_worker


@pytest.fixture(scope="module")
def sessions(lab) -> dict[str, str]:
    return {kind: lab.client.create_session(kind=kind)["id"] for kind in ("human_multicamera", "calibration")}


@pytest.fixture(scope="module", autouse=True)
def memory_and_disk_are_bounded(lab, sessions) -> Iterator[None]:
    before = peak_memory(lab)
    yield
    assert peak_memory(lab) - before < MOST_MEMORY
    assert lab.spooled() == []
    assert lab.objects() == []
    assert lab.client.is_ready()
    assert "Traceback" not in lab.log.read_text()


def peak_memory(lab) -> int:
    status = Path(f"/proc/{lab.process.pid}/status").read_text()
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) * 1000


def png(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def bomb(width: int, height: int) -> bytes:
    packer = zlib.compressobj(9)
    row = bytes(width + 1)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    return png(width, height, data)


def laughs(depth: int) -> str:
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, depth))
    return f'<!DOCTYPE x [<!ENTITY a0 "ha">{entities}]><calibration><cameras>&a{depth - 1};</cameras></calibration>'


def lying(video: bytes, offset_of: bytes, shift: int, value: int) -> bytes:
    place = video.index(offset_of) + shift
    return video[:place] + struct.pack(">I", value) + video[place + 4 :]


def yaml_bomb() -> str:
    lines = ["%YAML:1.0", 'a0: &a0 ["x","x"]'] + [f"a{i}: &a{i} [{f'*a{i - 1},' * 9}]" for i in range(1, 12)]
    return "\n".join(lines)


CALIBRATIONS: dict[str, bytes] = {
    "laughs.xml": laughs(12).encode(),
    "outside.xml": b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><calibration><cameras>&a;</cameras></calibration>',
    "remote.xml": b'<!DOCTYPE x SYSTEM "http://127.0.0.1:9/x.dtd"><calibration/>',
    "deep.xml": b"<a>" * 100_000,
    "empty.xml": b"",
    "zeros.xml": bytes(100_000),
    "huge.xml": b"<calibration><cameras><camera serial='" + b"x" * 2_000_000 + b"'/></cameras></calibration>",
    "nan.xml": b"<calibration><cameras><camera serial='a'><transform x='nan'/></camera></cameras></calibration>",
    "bomb.yml": yaml_bomb().encode(),
    "code.yml": b"%YAML:1.0\nx: !!python/object/apply:os.system ['touch /tmp/owned']",
    "deep.yml": b"%YAML:1.0\nx: " + b"[" * 20_000,
    "deep.json": b"[" * 200_000,
    "numbers.json": b'{"schema": "gonio-calibration", "rig": ' + b"9" * 100_000 + b"}",
    "exponent.json": b'{"cameras": [{"matrix": [[1e99999, 0, 0]]}]}',
    "surrogate.json": b'{"cameras": "\\ud800"}',
    "nan.json": b'{"cameras": NaN}',
    "text.json": b"\xff\xfe\x00",
    "deep.toml": b"x = " + b"[" * 20_000,
    "keys.toml": b"\n".join(b"k%d = 1" % i for i in range(100_000)),
    "numbers.toml": b"x = " + b"9" * 10_000,
    "matrix.toml": b'[cam_0]\nname = "a"\nsize = [1e400, -5]\nmatrix = [[1]]\nrotation = [0]\ntranslation = [0]',
    "zip.txt": b"PK\x03\x04" + bytes(1000),
    "gzip.calib": b"\x1f\x8b\x08" + bytes(1000),
}

TABLE = ",".join(DEFAULT_COLUMNS).encode() + b"\n"
CELLS = b",5" * (len(DEFAULT_COLUMNS) - 1) + b"\n"

PRESSURES: dict[str, bytes] = {
    "empty.csv": b"",
    "nul.csv": TABLE + bytes(1000),
    "wide.csv": TABLE + b"1" + b",1" * 900_000,
    "control.csv": b"\x1b]0;owned\x07" + TABLE,
    "quote.csv": TABLE + b'"' + b"x" * 2_000_000,
    "huge.csv": TABLE + b"1e400" + CELLS + b"2e400" + CELLS,
    "backwards.csv": TABLE + b"2" + CELLS + b"1" + CELLS,
    "formula.csv": TABLE + b"=cmd|'/c calc'!A0" + CELLS,
}

OTHERS: dict[str, bytes] = {
    "laughs.osim": laughs(12).replace("calibration", "OpenSimDocument").encode(),
    "outside.osim": b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><OpenSimDocument>&a;</OpenSimDocument>',
    "deep.osim": b"<OpenSimDocument>" + b"<Model>" * 50_000,
    "empty.c3d": b"",
    "lies.c3d": b"\x02\x50" + b"\xff" * 2000,
    "parameters.c3d": bytes([255, 0x50]) + b"\x7f" * 4000,
    "plates.mot": b"force\nversion=1\nnRows=999999999\nnColumns=999999999\nendheader\ntime a\n0 1\n",
    "text.sto": b"endheader\n" + b"1 " * 500_000,
}


FILES = CALIBRATIONS | PRESSURES | OTHERS


@pytest.mark.parametrize("name", FILES)
def test_a_hostile_file_is_refused(lab, sessions, name):
    url = f"/v1/sessions/{sessions['human_multicamera']}/files"
    answer = lab.http.post(url, files={"file": (name, FILES[name])})
    assert refused(answer), answer.text


VIDEOS = ("playlist", "remote", "frames", "box", "cut", "reference", "html", "zip")


@pytest.mark.parametrize("trick", VIDEOS)
def test_a_video_that_lies_is_refused(lab, sessions, capture, trick):
    video = (capture / "cam01.mp4").read_bytes()
    content = {
        "playlist": b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n",
        "remote": b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n",
        "frames": lying(video, b"stsz", 12, 0x7FFFFFFF),
        "box": struct.pack(">I", 0xFFFFFFFF) + video[4:],
        "cut": video[: len(video) // 2],
        "reference": b"ffconcat version 1.0\nfile /etc/passwd\n",
        "html": b"<html><script>alert(1)</script></html>",
        "zip": b"PK\x03\x04" + bytes(5000),
    }[trick]
    url = f"/v1/sessions/{sessions['human_multicamera']}/files"
    answer = lab.http.post(url, files={"file": (f"{trick}.mp4", content)})
    assert refused(answer), answer.text


def test_a_video_header_is_not_believed(lab, sessions, capture):
    content = lying((capture / "cam01.mp4").read_bytes(), b"mp4v", 28, 0xFFFFFFFF)  # says: 65535 × 65535
    url = f"/v1/sessions/{sessions['human_multicamera']}/files"
    answer = lab.http.post(url, files={"file": ("width.mp4", content)})
    assert (answer.json()["facts"]["width_px"], answer.json()["facts"]["height_px"]) == (64, 48)
    lab.http.delete(answer.json()["content"])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("bomb.png", bomb(40_000, 25_000)),
        ("header.png", png(2_000_000_000, 2_000_000_000, b"")),
        ("zero.png", png(0, 0, b"")),
        ("cut.png", bomb(500, 500)[:60]),
        ("text.jpg", b"not a picture"),
        (
            "bomb.tif",
            b"II*\0\x08\0\0\0\x02\0\0\x01\x04\0\x01\0\0\0\xff\xff\xff\x7f\x01\x01\x04\0\x01\0\0\0\xff\xff\xff\x7f",
        ),
        ("card.toml", b"[board]\nsquares = " + b"9" * 5000),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_hostile_picture_is_refused(lab, sessions, name, content):
    role = "board" if name.endswith("toml") else "sweep"
    answer = lab.http.post(
        f"/v1/sessions/{sessions['calibration']}/files",
        files={"file": (name, content)},
        data={"role": role, "camera": "1"},
    )
    assert refused(answer), answer.text


@pytest.mark.parametrize(
    "body",
    [
        b'{"kind": "human_multicamera", "subject": {"mass_kg": ' + b"9" * 400 + b"}}",
        b'{"kind": "human_multicamera", "subject": {"mass_kg": 1e-400}}',
        b'{"kind": "human_multicamera", "name": {"$ne": null}}',
        b'{"kind": "human_multicamera", "calibration": "\' OR 1=1 --"}',
        b'{"kind": "human_multicamera", "__proto__": {"admin": true}}',
        b'{"kind": "human_multicamera", "name": "' + b"\\u0000" + b'"}',
        b'{"a":' * 50_000,
        b"\xef\xbb\xbf{}",
        b'{"kind": "human_multicamera"} {}',
        b"null",
    ],
    ids=range(10),
)
def test_a_hostile_body_is_refused(lab, body):
    answer = lab.http.post("/v1/sessions", content=body, headers={"content-type": "application/json"})
    assert refused(answer), answer.text


@pytest.mark.parametrize("path", ["sessions", "jobs", "reports", "calibrations", "uploads"])
@pytest.mark.parametrize(
    "bad", ["1%3bDROP%20TABLE%20jobs", "%2e%2e%2f%2e%2e", "$(id)", "{{7*7}}", "%00", "%F0%9F%92%A9", "x" * 8000]
)
def test_a_hostile_id_is_not_found(lab, path, bad):
    answer = lab.http.get(f"/v1/{path}/{bad}")
    assert answer.status_code in (404, 405)  # an upload has no GET
    assert refused(answer)


@pytest.mark.parametrize("cursor", ["'; --", "AAAA", "x" * 300, "MjAyNi0wMS0wMSAn"])
def test_a_hostile_cursor_is_refused(lab, cursor):
    assert refused(lab.http.get("/v1/sessions", params={"cursor": cursor}))


def send_raw(lab, *parts: bytes) -> bytes:
    address = httpx.URL(lab.url)
    with socket.create_connection((address.host, address.port), timeout=10) as connection:
        try:
            for part in parts:
                connection.sendall(part)
        except OSError:  # it hung up in the middle, which is an answer too
            return b""
        connection.settimeout(2)
        try:
            return connection.recv(65536)
        except (ConnectionError, TimeoutError):  # it hung up, or waits for the rest
            return b""


HOST = b"Host: 127.0.0.1\r\n"
POST = b"POST /v1/sessions HTTP/1.1\r\n" + HOST


@pytest.mark.parametrize(
    "request_bytes",
    [
        POST + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET / HTTP/1.1\r\n\r\n",
        POST + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nhello",
        POST + b"Content-Length: -1\r\n\r\n",
        POST + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFFFFFFF\r\n",
        b"GET /v1/sessions HTTP/1.1\r\n" + HOST + b"Authorization : Bearer x\r\n\r\n",
        b"GET /v1/sessions HTTP/1.1\r\n" + HOST + b"Host: evil.example\r\n\r\n",
        b"GET /v1/sessions\r\n HTTP/1.1\r\n" + HOST + b"\r\n",
        b"GET http://evil.example/v1/sessions HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"GET /v1/sessions HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(100),
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    ],
    ids=range(12),
)  # fmt: skip
def test_smuggling_gets_nobody_in(lab, request_bytes):
    answer = send_raw(lab, request_bytes)
    assert not answer.startswith(b"HTTP/1.1 2"), answer
    assert b"Traceback" not in answer


def test_a_key_of_a_gigabyte_is_not_read(lab):
    begin = b"GET /v1/sessions HTTP/1.1\r\n" + HOST + b"Authorization: Bearer "
    answer = send_raw(lab, begin, *(b"x" * 1_000_000 for _ in range(1000)), b"\r\n\r\n")
    assert answer == b"" or answer.startswith(b"HTTP/1.1 4")


@pytest.mark.slow
def test_a_table_of_ten_million_rows_is_refused_in_bounded_memory(start_lab):
    lab = start_lab(workers=0, max_upload_bytes=400_000_000)
    session = lab.client.create_session()["id"]
    before = peak_memory(lab)
    content = TABLE + b"".join(b"%d%s" % (i % 10, CELLS) for i in range(10)) * 1_000_000
    with httpx.Client(base_url=lab.url, trust_env=False, timeout=120) as patient:
        answer = patient.post(f"/v1/sessions/{session}/files", files={"file": ("rows.csv", content)})
    assert refused(answer), answer.text
    assert peak_memory(lab) - before < MOST_MEMORY


def refused(answer: httpx.Response) -> bool:
    """Whether an answer is a documented problem, and no fault of ours."""
    problem = json.loads(answer.content)
    return (
        400 <= answer.status_code < 500
        and answer.headers["content-type"] == "application/problem+json"
        and problem["code"] in KINDS
        and bool(problem["hint"])
        and "Traceback" not in answer.text
    )
