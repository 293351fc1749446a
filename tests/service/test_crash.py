"""What a poison job and cut forms leave behind; kills at random moments are in ``test_rehearsal.py``."""

import socket
import time

import pytest

from gonio.errors import GonioError


@pytest.mark.slow
def test_a_job_that_kills_its_workers_ends_with_that_problem_and_the_queue_lives_on(start_lab, capture, journal):
    lab = start_lab(workers=1)
    session = lab.complete_session(capture)
    poison = lab.client.analyse(session, journal.parameters(fault={"keypoints": "crash"}))["id"]
    good = lab.client.analyse(session, {"journal": str(journal.path.with_name("good"))})["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.wait(poison, timeout_s=180)
    assert caught.value.code == "worker-crashed"
    assert journal.lines() == ["begin capture", "end capture"] + ["begin keypoints"] * 3
    assert lab.client.wait(good, timeout_s=180)["state"] == "succeeded"


def half_an_upload(lab, session: str, name: str, size: int, sent: int) -> socket.socket:
    """Begin an upload that announces more bytes than are sent."""
    host, port = lab.url.removeprefix("http://").split(":")
    head = f'--B\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'.encode()
    connection = socket.create_connection((host, int(port)))
    connection.sendall(
        f"POST /v1/sessions/{session}/files HTTP/1.1\r\nHost: {host}\r\nContent-Length: {len(head) + size}\r\n"
        "Content-Type: multipart/form-data; boundary=B\r\n\r\n".encode()
        + head
        + b"x" * sent
    )
    return connection


def wait_until(condition, timeout_s: float = 5) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def test_an_upload_that_is_cut_leaves_nothing_and_the_server_lives(lab):
    session, told = lab.client.create_session()["id"], len(lab.log.read_text())
    connection = half_an_upload(lab, session, "cam.mp4", 1_000_000, 300_000)
    wait_until(lambda: any(path.stat().st_size > 200_000 for path in lab.settings.data_dir.rglob("spool/*/cam.mp4")))
    connection.close()
    wait_until(lambda: not lab.spooled())
    assert lab.client.files(session) == []
    assert lab.client.is_ready()
    assert "Traceback" not in lab.log.read_text()[told:]


@pytest.mark.slow
def test_an_upload_whose_server_is_killed_is_swept_away_and_what_was_accepted_is_there(start_lab, capture):
    lab = start_lab(workers=0)
    session = lab.client.create_session()["id"]
    accepted = lab.client.upload(session, capture / "cam01.mp4")
    connection = half_an_upload(lab, session, "cam02.mp4", 1_000_000, 300_000)
    wait_until(lambda: lab.spooled())
    lab.process.kill()
    lab.process.wait()
    connection.close()
    assert len(lab.spooled()) == 1

    lab = start_lab(workers=0)
    assert lab.spooled() == []
    assert lab.client.files(session) == [accepted]
    assert lab.http.get(accepted["content"]).content == (capture / "cam01.mp4").read_bytes()


@pytest.mark.slow
def test_a_running_upload_is_not_swept_by_another_server(start_lab):
    lab = start_lab(workers=0)
    session = lab.client.create_session()["id"]
    connection = half_an_upload(lab, session, "cam.mp4", 1_000_000, 1000)
    wait_until(lambda: lab.spooled())
    start_lab(workers=0)
    assert len(lab.spooled()) == 1
    connection.close()
