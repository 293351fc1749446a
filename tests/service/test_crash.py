"""Processes are killed in the middle of their work; nothing that was promised is lost, and nothing is done twice."""

import os
import signal
import socket
import time

import pytest

from gonio.errors import GonioError


def count_of(lines: list[str]) -> dict[str, int]:
    return {line: lines.count(line) for line in lines}


@pytest.mark.slow
def test_a_job_survives_the_kill_of_its_worker_and_repeats_no_finished_stage(start_lab, start_worker, capture, journal):
    lab = start_lab(workers=0)
    session = lab.complete_session(capture, subject={"mass_kg": 70.0})
    undisturbed = journal.path.with_name("undisturbed")
    undisturbed.touch()
    first = start_worker(lab.settings)
    other = lab.client.analyse(session, {"journal": str(undisturbed)})["id"]
    lab.client.wait(other, timeout_s=20)

    job = lab.client.analyse(session, journal.parameters(seconds=1.0))["id"]
    journal.wait_for("begin dynamics")
    second = start_worker(lab.settings)
    time.sleep(0.2)
    os.kill(first.pid, signal.SIGKILL)
    lab.client.wait(job, timeout_s=30)
    assert journal.worker_pid() == second.pid
    assert count_of(journal.lines()) == {
        "begin capture": 1,
        "end capture": 1,
        "begin keypoints": 1,
        "end keypoints": 1,
        "begin dynamics": 2,  # the stage that the crash fell into
        "end dynamics": 1,
        "begin report": 1,
        "end report": 1,
    }
    assert lab.client.report(job) == lab.client.report(other)
    assert len(list((lab.settings.cache_dir / "work").iterdir())) == 1  # the dead worker's was removed


@pytest.mark.slow
def test_supervised_workers_and_the_api_are_killed_and_the_job_ends_after_a_restart(start_lab, capture, journal):
    lab = start_lab(workers=1)
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(seconds=1.0))["id"]
    journal.wait_for("begin keypoints")
    os.kill(journal.worker_pid(), signal.SIGKILL)  # the supervisor starts another one
    journal.wait_for("begin dynamics", timeout_s=20)
    worker = journal.worker_pid()
    lab.process.kill()  # and with the supervisor its worker dies: the kernel sees to it
    lab.process.wait()
    deadline_s = time.monotonic() + 2
    while os.path.exists(f"/proc/{worker}"):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)

    lab = start_lab(workers=1)
    ended = lab.client.wait(job, timeout_s=30)
    assert ended["report"] == f"/v1/reports/{job}"
    lines = count_of(journal.lines())
    assert (lines["begin keypoints"], lines["end keypoints"]) == (2, 1)
    assert (lines["begin dynamics"], lines["end dynamics"]) == (2, 1)
    assert lines["begin capture"] == lines["begin report"] == 1


@pytest.mark.slow
def test_a_job_that_kills_its_workers_ends_with_that_problem_and_the_queue_lives_on(start_lab, capture, journal):
    lab = start_lab(workers=1)
    session = lab.complete_session(capture)
    poison = lab.client.analyse(session, journal.parameters(fault={"keypoints": "crash"}))["id"]
    good = lab.client.analyse(session, {"journal": str(journal.path.with_name("good"))})["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.wait(poison, timeout_s=40)
    assert caught.value.code == "worker-crashed"
    assert journal.lines() == ["begin capture", "end capture"] + ["begin keypoints"] * 3
    assert lab.client.wait(good, timeout_s=20)["state"] == "succeeded"


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
    session = lab.client.create_session()["id"]
    connection = half_an_upload(lab, session, "cam.mp4", 1_000_000, 300_000)
    wait_until(lambda: any(path.stat().st_size > 200_000 for path in lab.settings.data_dir.rglob("spool/*/cam.mp4")))
    connection.close()
    wait_until(lambda: not lab.spooled())
    assert lab.client.files(session) == []
    assert lab.client.is_ready()
    assert "Traceback" not in lab.log.read_text()


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
