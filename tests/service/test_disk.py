"""A disk that is full, or that can only be read: clear answers, and recovery without help."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest


def mount(*arguments: str | Path) -> None:
    mounted = subprocess.run(["mount", *arguments], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("a disk of one's own can be mounted by root only")


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A disk of 12 MB where the service keeps its data."""
    folder = tmp_path / "data"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", "size=12m", "tmpfs", folder)
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Let nobody write into a folder, as the kernel does when a disk fails."""
    mount("--bind", folder, folder)
    try:
        mount("-o", "remount,bind,ro", folder)
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def refusal(response: httpx.Response) -> tuple[int, str]:
    assert response.headers["content-type"] == "application/problem+json"
    return response.status_code, response.json()["code"]


def fill(disk: Path) -> Path:
    path = disk / "filler"
    with path.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12):
            while True:
                try:
                    if file.write(bytes(size)) < size:
                        break
                except OSError:
                    break
    return path


@pytest.mark.slow
def test_a_full_disk_is_told_and_passes(start_lab, small_disk, capture, journal):
    lab = start_lab(workers=1, max_upload_bytes=8_000_000)
    session = lab.complete_session(capture)
    body = {"kind": "human_multicamera"}

    filler = fill(small_disk)
    video = {"file": ("big.mp4", b"x" * 3_000_000)}
    assert refusal(lab.http.post(f"/v1/sessions/{session}/files", files=video)) == (507, "disk-full")
    answers = {lab.http.post("/v1/sessions", json=body).status_code for _ in range(20)}
    assert answers <= {201, 507}  # a page that the database had left may take the first
    assert 507 in answers
    assert lab.http.get("/healthz").status_code == 200
    filler.unlink()
    assert lab.http.post("/v1/sessions", json=body).status_code == 201
    assert lab.spooled() == []
    job = lab.client.analyse(session, journal.parameters(seconds=0))["id"]
    assert lab.client.wait(job, timeout_s=180)["state"] == "succeeded"


@pytest.mark.slow
def test_a_job_waits_for_a_full_disk_and_ends_when_there_is_room(start_lab, small_disk, capture, journal):
    lab = start_lab(workers=1)
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(seconds=2))["id"]
    journal.wait_for("begin keypoints")
    filler = fill(small_disk)
    deadline_s = time.monotonic() + 60
    while "can't use the database" not in lab.log.read_text():
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
    filler.unlink()
    assert lab.client.wait(job, timeout_s=180)["state"] == "succeeded"
    assert f"takes up job {job} again" in lab.log.read_text()


@pytest.mark.slow
def test_a_read_only_disk_is_told_and_passes(start_lab, capture):
    lab = start_lab(workers=0, max_upload_bytes=8_000_000)
    session = lab.client.create_session()["id"]
    data = lab.settings.data_dir
    content = (capture / "cam01.mp4").read_bytes()
    url = f"/v1/sessions/{session}"
    begin = {"Tus-Resumable": "1.0.0", "Upload-Length": "100", "Upload-Metadata": "filename YS5tcDQ="}
    before = lab.objects()
    for folder in ("spool", "uploads", "objects"):
        with read_only(data / folder):
            if folder == "uploads":
                refused = lab.http.post(f"{url}/uploads", headers=begin)
            else:
                refused = lab.http.post(f"{url}/files", files={"file": ("cam01.mp4", content)})
            assert refusal(refused) == (503, "store-unreachable")
            assert refused.headers["retry-after"]
            assert lab.http.get("/healthz").status_code == 200
    assert lab.client.files(session) == []
    assert (lab.objects(), lab.spooled(), list((data / "uploads").iterdir())) == (before, [], [])
    lab.client.upload(session, capture / "cam01.mp4")
    assert lab.http.post(f"{url}/uploads", headers=begin).status_code == 201
