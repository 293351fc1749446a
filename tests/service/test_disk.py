"""A disk that is full: clear answers, and recovery without help."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A disk of 12 MB where the service keeps its data."""
    folder = tmp_path / "data"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("a disk of one's own can be mounted by root only")
    yield folder
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
    assert lab.client.wait(job, timeout_s=30)["state"] == "succeeded"
