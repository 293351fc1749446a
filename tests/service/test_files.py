"""Uploads: what is accepted, what is refused and how, and that nothing of what is refused is kept."""

import hashlib

import httpx
import numpy as np
import pytest

from gonio.errors import GonioError, InputError
from gonio.formats.pressure_csv import write_pressure
from gonio.records import FootPressure


@pytest.fixture(scope="module")
def session(lab) -> str:
    return lab.client.create_session(name="files")["id"]


@pytest.fixture(autouse=True)
def nothing_is_left(lab):
    yield
    assert lab.spooled() == []


def post(lab, session: str, body: bytes, content_type: str = "multipart/form-data; boundary=B") -> httpx.Response:
    return lab.http.post(f"/v1/sessions/{session}/files", content=body, headers={"content-type": content_type})


def part(disposition: bytes, content: bytes, end: bytes = b"\r\n--B--\r\n") -> bytes:
    return b"--B\r\nContent-Disposition: form-data; " + disposition + b"\r\n\r\n" + content + end


A_FILE = part(b'name="file"; filename="b.mp4"', b"x")


def refusal(response: httpx.Response) -> tuple[int, str]:
    problem = response.json()
    assert response.headers["content-type"] == "application/problem+json"
    assert problem["status"] == response.status_code
    assert problem["hint"]
    return response.status_code, problem["code"]


def test_the_same_file_twice_is_one_file_and_other_content_is_refused(lab, session, capture):
    path = capture / "cam01.mp4"
    url = f"/v1/sessions/{session}/files"
    answers = [lab.http.post(url, files={"file": (path.name, path.read_bytes())}) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 200]
    assert answers[0].json() == answers[1].json()
    assert answers[0].headers["location"] == answers[0].json()["content"]
    assert answers[0].json()["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()

    other = lab.http.post(url, files={"file": (path.name, (capture / "cam02.mp4").read_bytes())})
    assert refusal(other) == (409, "file-exists")
    assert "DELETE" in other.json()["hint"]
    assert other.json()["file"] == answers[0].json()["id"]
    other_camera = lab.http.post(url, files={"file": (path.name, path.read_bytes())}, data={"camera": "2"})
    assert refusal(other_camera) == (409, "file-exists")

    lab.client.delete_file(session, answers[0].json()["id"])
    assert lab.http.get(answers[0].json()["content"]).status_code == 404
    again = lab.client.upload(session, capture / "cam02.mp4", name=path.name, camera="2")
    assert (again["name"], again["camera"]) == (path.name, "2")
    lab.client.delete_file(session, again["id"])


def test_content_comes_back_whole_and_in_parts(lab, session, capture):
    content = (capture / "calibration.xml").read_bytes()
    file = lab.client.upload(session, capture / "calibration.xml")
    whole = lab.http.get(file["content"])
    assert whole.content == content
    assert whole.headers["content-disposition"] == 'attachment; filename="calibration.xml"'
    assert whole.headers["x-content-type-options"] == "nosniff"
    assert whole.headers["etag"] == f'"{file["sha256"]}"'
    middle = lab.http.get(file["content"], headers={"range": "bytes=3-9"})
    assert (middle.status_code, middle.content) == (206, content[3:10])
    beyond = lab.http.get(file["content"], headers={"range": "bytes=99999-"})
    assert refusal(beyond) == (416, "range-not-satisfiable")
    assert beyond.headers["content-range"] == f"bytes */{len(content)}"


def test_content_that_somebody_removed_from_the_store_is_named(lab, session, capture):
    before = set(lab.objects())
    file = lab.client.upload(session, capture / "cam01.mp4", name="gone.mp4")
    (stored,) = set(lab.objects()) - before
    stored.unlink()
    gone = lab.http.get(file["content"])
    assert refusal(gone) == (500, "content-missing")
    assert "restore" in gone.json()["hint"]
    lab.client.delete_file(session, file["id"])


@pytest.mark.parametrize(
    "name",
    [
        b"../cam.mp4",
        b"a/b.mp4",
        b"/etc/passwd",
        b"a\\b.mp4",
        b"C:\\cam.mp4",
        b"..",
        b".",
        b"",
        b"   ",
        b"cam\0.mp4",
        b"cam%00.mp4",
        b"%2e%2e%2fcam.mp4",
        b"cam%0d%0a.mp4",
        b"cam\x07.mp4",
        b"cam\x7f.mp4",
        b"cam\xff.mp4",
        "cam\u202e4pm.exe".encode(),
        b"x" * 296 + b".mp4",
        "ä".encode() * 128 + b".mp4",
    ],
    ids=lambda name: repr(name[:20]),
)
def test_a_bad_name_is_refused(lab, session, name):
    response = post(lab, session, part(b'name="file"; filename="' + name + b'"', b"x"))
    assert refusal(response) == (422, "bad-file-name")


@pytest.mark.parametrize("name", ["../cam.mp4", "cam\0.mp4", "x" * 300 + ".mp4"])
def test_a_bad_name_from_the_client_is_refused(lab, session, capture, name):
    with pytest.raises(InputError) as caught:
        lab.client.upload(session, capture / "cam01.mp4", name=name)
    assert (caught.value.code, caught.value.details["status"]) == ("bad-file-name", 422)


@pytest.mark.parametrize(
    "name", ["Käthe läuft 2.mp4", "步行.mp4", ".hidden.mp4", "a'b\"c;d=e&f.mp4", "x" * 251 + ".mp4"]
)
def test_an_unusual_name_is_kept_as_it_is(lab, session, capture, name):
    file = lab.client.upload(session, capture / "cam01.mp4", name=name)
    assert file["name"] == name.replace('"', "%22")  # an HTML form has no other way to send a quotation mark
    back = lab.http.get(file["content"])
    assert back.content == (capture / "cam01.mp4").read_bytes()
    lab.client.delete_file(session, file["id"])


def test_what_is_no_video_or_no_calibration_is_refused_with_its_name(lab, session, tmp_path):
    for name, code in (("cam09.mp4", "not-a-video"), ("rig.toml", "calibration-format-unknown")):
        (tmp_path / name).write_bytes(b"not what it says" * 100)
        with pytest.raises(InputError) as caught:
            lab.client.upload(session, tmp_path / name)
        assert (caught.value.code, caught.value.details["status"]) == (code, 422)
        assert name in caught.value.message
    assert "cam09.mp4" not in {file["name"] for file in lab.client.files(session)}


def test_a_video_that_was_cut_is_refused(lab, session, capture, tmp_path):
    content = (capture / "cam01.mp4").read_bytes()
    (tmp_path / "cam08.mp4").write_bytes(content[:200])
    with pytest.raises(InputError) as caught:
        lab.client.upload(session, tmp_path / "cam08.mp4")
    assert (caught.value.code, caught.value.details["status"]) == ("video-truncated", 422)
    assert "cam08.mp4" in caught.value.message


def test_the_role_comes_from_the_field_or_the_suffix(lab, session, capture, tmp_path):
    (tmp_path / "recording.dat").write_bytes((capture / "cam01.mp4").read_bytes())
    with pytest.raises(InputError) as caught:
        lab.client.upload(session, tmp_path / "recording.dat")
    assert caught.value.code == "role-unknown"
    file = lab.client.upload(session, tmp_path / "recording.dat", role="video")
    assert file["role"] == "video"
    lab.client.delete_file(session, file["id"])


def test_foot_pressure_is_checked_before_it_is_kept(lab, session, tmp_path):
    force = 350 + 300 * np.sin(np.arange(50) / 4)
    stream = FootPressure(
        times_s=np.arange(50) / 20,
        vertical_n=np.stack([force, 700 - force], axis=1),
        cop_foot_m=np.full((50, 2, 2), 0.05),
    )
    write_pressure(tmp_path / "soles.csv", stream)
    file = lab.client.upload(session, tmp_path / "soles.csv")
    assert (file["role"], file["facts"]["rate_hz"]) == ("pressure", 20.0)
    (tmp_path / "pulling.csv").write_text((tmp_path / "soles.csv").read_text().replace(",3", ",-3"))
    with pytest.raises(InputError, match="are negative") as caught:
        lab.client.upload(session, tmp_path / "pulling.csv")
    assert (caught.value.code, caught.value.details["status"]) == ("pressure-negative", 422)
    assert "pulling.csv" in caught.value.message
    assert "pulling.csv" not in {known["name"] for known in lab.client.files(session)}


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (part(b'name="file"; filename="a.mp4"', b"x" * 1000, end=b""), (400, "upload-truncated")),
        (part(b'name="file"; filename="a.mp4"', b"x", end=b"\r\n--B\r\n"), (400, "upload-truncated")),
        (b"", (400, "upload-truncated")),
        (b"garbage", (400, "malformed-body")),
        (part(b'name="role"', b"video"), (422, "file-missing")),
        (part(b'name="file"', b"no file name"), (422, "bad-file-name")),
        (part(b'name="role"', b"x" * 2000), (400, "malformed-body")),
        (part(b'name="file"; filename="a.mp4"', b"x", b"\r\n") + A_FILE, (400, "malformed-body")),
        (part(b'name="role"', b"nonsense", b"\r\n") + A_FILE, (422, "invalid-request")),
        (part(b'name="colour"', b"red", b"\r\n") + A_FILE, (422, "invalid-request")),
        (part(b'name="camera"', b"a\nb", b"\r\n") + A_FILE, (422, "invalid-request")),
    ],
    ids=range(11),
)
def test_a_form_that_is_not_right_is_refused(lab, session, body, expected):
    assert refusal(post(lab, session, body)) == expected


def test_other_bodies_are_refused(lab, session):
    assert refusal(post(lab, session, b"{}", "application/json")) == (415, "unsupported-media-type")
    assert refusal(post(lab, session, b"x", "multipart/form-data")) == (400, "malformed-body")
    assert refusal(lab.http.post(f"/v1/sessions/{session}/files")) == (415, "unsupported-media-type")


def test_too_large_a_file_is_refused_announced_or_not(lab, session):
    content = part(b'name="file"; filename="big.mp4"', b"x" * 4_000_000)
    assert refusal(post(lab, session, content)) == (413, "file-too-large")

    def chunks():
        yield from (content[i : i + 100_000] for i in range(0, len(content), 100_000))

    unannounced = lab.http.post(
        f"/v1/sessions/{session}/files", content=chunks(), headers={"content-type": "multipart/form-data; boundary=B"}
    )
    assert refusal(unannounced) == (413, "file-too-large")


def test_the_client_hears_why_a_huge_file_is_refused(lab, session, tmp_path):
    with (tmp_path / "huge.mp4").open("wb") as file:
        file.truncate(200_000_000)
    with pytest.raises(InputError) as caught:
        lab.client.upload(session, tmp_path / "huge.mp4")
    assert (caught.value.code, caught.value.details["status"]) == ("file-too-large", 413)


def test_a_full_disk_is_a_clear_answer(start_lab, capture):
    lab = start_lab(workers=0, free_disk_floor=10**15)
    session = lab.client.create_session()["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.upload(session, capture / "cam01.mp4")
    assert (caught.value.code, caught.value.details["status"]) == ("disk-full", 507)
    assert not lab.client.is_ready()
    assert refusal(lab.http.get("/readyz")) == (503, "not-ready")
    assert lab.spooled() == []


def test_many_uploads_at_once_are_all_right(lab, capture):
    from concurrent.futures import ThreadPoolExecutor

    session = lab.client.create_session()["id"]
    with ThreadPoolExecutor(8) as pool:
        names = [f"cam{i % 6}.mp4" for i in range(18)]  # each name comes three times
        files = list(pool.map(lambda name: lab.client.upload(session, capture / "cam01.mp4", name=name), names))
    assert len({file["id"] for file in files}) == 6
    assert len(lab.client.files(session)) == 6
    assert len([path for path in lab.objects() if session in str(path)]) == 6
