"""Starting and stopping."""

import os
import signal
import socket
import sys
import threading

import pytest

from gonio.client import Client
from gonio.errors import GonioError, ResourceError
from gonio.http.server import serve, serving
from gonio.settings import Settings


@pytest.mark.slow
def test_a_service_in_the_background_leaves_nothing_running(tmp_path, capture, journal):
    settings = Settings(data_dir=tmp_path / "data", cache_dir=tmp_path / "cache", port=0, free_disk_floor=0)
    worker = (sys.executable, str(__file__).replace("test_server", "worker_main"))
    threads = set(threading.enumerate())
    with (
        serving(settings, worker_command=worker, probe=lambda path, role: {"bytes": path.stat().st_size}) as url,
        Client(url) as client,
    ):
        session = client.create_session()["id"]
        for path in capture.iterdir():
            client.upload(session, path)
        job = client.analyse(session, journal.parameters())["id"]
        client.wait(job, timeout_s=180)
        pid = journal.worker_pid()
    assert set(threading.enumerate()) <= threads
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with Client(url) as client, pytest.raises(ResourceError) as caught:
        client.job(job)
    assert caught.value.code == "service-unreachable"


@pytest.mark.slow
def test_a_stopped_service_ends_its_worker_and_itself_in_peace(start_lab, capture, journal):
    lab = start_lab(workers=1)
    lab.client.analyse(lab.complete_session(capture), journal.parameters(seconds=30))
    journal.wait_for("begin keypoints")
    lab.process.send_signal(signal.SIGTERM)
    assert lab.process.wait(10) == 0
    with pytest.raises(ProcessLookupError):
        os.kill(journal.worker_pid(), 0)
    assert list(lab.settings.work_dir.iterdir()) == []  # it had the time to tidy up
    assert "Traceback" not in lab.log.read_text()


def test_a_taken_port_is_a_clear_error(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = Settings(data_dir=tmp_path, port=taken.getsockname()[1])
        with pytest.raises(ResourceError) as caught:
            serve(settings)
    assert caught.value.code == "port-taken"
    assert "GONIO_PORT" in caught.value.hint


def test_an_unsupported_database_is_a_clear_error_that_hides_the_password(tmp_path):
    settings = Settings(data_dir=tmp_path, port=0, database_url="mysql://gonio:hunter2@db/gonio")
    with pytest.raises(GonioError) as caught:
        serve(settings)
    assert caught.value.code == "database-unsupported"
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize("url", ["postgresql://gonio:hunter2@127.0.0.1:9/gonio", "sqlite:////nowhere/gonio.db"])
def test_a_database_out_of_reach_is_a_clear_error_that_hides_the_password(tmp_path, url):
    with pytest.raises(ResourceError) as caught:
        serve(Settings(data_dir=tmp_path, port=0, database_url=url))
    assert caught.value.code == "database-unreachable"
    assert "hunter2" not in str(caught.value)
    assert len(caught.value.message) > 40  # it says why
