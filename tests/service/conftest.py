import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import av
import httpx
import numpy as np
import pytest

from gonio.bench import servers
from gonio.client import Client
from gonio.jobs.access import SCOPES, opened
from gonio.settings import Settings

HERE = Path(__file__).parent
SERVER, WORKER = HERE / "server_main.py", HERE / "worker_main.py"


CAMERA = """<camera serial="{name}"><fov_video bottom="47" left="0" right="63" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="1000" y="-4000" z="1500"/>
<intrinsic centerPointU="2048" centerPointV="1536" focalLengthU="107520" focalLengthV="107584"
 radialDistortion1="-0.046" radialDistortion2="0.14"/></camera>"""


@contextmanager
def running(script: Path, settings: Settings, log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a script of this folder as a process; it is always stopped."""
    environment = {**os.environ, **settings.environment()}
    with log.open("a") as errors:
        process = subprocess.Popen(
            [sys.executable, str(script)], env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
        )
    with process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()


class Lab:
    """A running service, its client, and its folders."""

    def __init__(self, url: str, settings: Settings, process: subprocess.Popen[str], log: Path) -> None:
        self.url = url
        self.settings = settings
        self.process = process
        self.log = log
        key = "" if settings.is_embedded and settings.keys == "auto" else self.make_key()
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self.client = Client(url, key=key)
        self.http = httpx.Client(base_url=url, trust_env=False, timeout=30, headers=headers)

    def make_key(self) -> str:
        with opened(self.settings) as access:
            return access.create_key(self.settings.default_lab, "test", SCOPES).secret

    def complete_session(self, capture: Path, *, subject: dict[str, float] | None = None) -> str:
        session = self.client.create_session(name="walk", subject=subject)["id"]
        for path in sorted(capture.iterdir()):
            self.client.upload(session, path)
        return session

    def spooled(self) -> list[Path]:
        return list((self.settings.data_dir / "spool").iterdir())

    def objects(self) -> list[Path]:
        return [path for path in (self.settings.data_dir / "objects").rglob("*") if path.is_file()]


@contextmanager
def running_lab(settings: Settings, folder: Path) -> Iterator[Lab]:
    log = folder / "service.log"
    with running(SERVER, settings, log) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url, log.read_text()
        lab = Lab(url, settings, process, log)
        with lab.client, lab.http:
            yield lab


def make_settings(folder: Path, **values: Any) -> Settings:
    defaults = {"port": 0, "free_disk_floor": 0, "max_upload_bytes": 3_000_000, "private_webhooks": True}
    return Settings(**{"data_dir": folder / "data", "cache_dir": folder / "cache", **defaults, **values})


@pytest.fixture(scope="session")
def lab(tmp_path_factory) -> Iterator[Lab]:
    """A service with one worker, for all tests that don't break anything: to start one takes seconds.

    It holds what other tests have left, so a test looks at its own sessions and jobs, and leaves no job that still runs.
    """
    folder = tmp_path_factory.mktemp("a lab ü ")
    with running_lab(make_settings(folder, workers=1), folder) as lab:
        yield lab


@pytest.fixture(scope="module")
def lab_without_worker(tmp_path_factory) -> Iterator[Lab]:
    """A service for the tests of a module, which holds nothing but what they left; it computes nothing."""
    folder = tmp_path_factory.mktemp("a lab")
    with running_lab(make_settings(folder, workers=0), folder) as lab:
        yield lab


@pytest.fixture(scope="session")
def keyed_lab(tmp_path_factory) -> Iterator[Lab]:
    """A service with one worker that wants a key of everybody."""
    folder = tmp_path_factory.mktemp("keyed")
    with running_lab(make_settings(folder, workers=1, keys="required"), folder) as lab:
        yield lab


@pytest.fixture
def start_lab(tmp_path) -> Iterator[Callable[..., Lab]]:
    """Start services of one's own; called again with the same folder, the service is restarted."""
    with ExitStack() as stack:

        def start(**values: Any) -> Lab:
            return stack.enter_context(running_lab(make_settings(tmp_path, **values), tmp_path))

        yield start


@pytest.fixture
def start_worker(tmp_path) -> Iterator[Callable[[Settings], subprocess.Popen[str]]]:
    with ExitStack() as stack:
        yield lambda settings: stack.enter_context(running(WORKER, settings, tmp_path / "worker.log"))


@pytest.fixture(scope="session")
def postgres() -> Iterator[servers.Postgres]:
    """A PostgreSQL server; each test makes a database of its own."""
    with servers.postgres() as server:
        yield server


@pytest.fixture(scope="session")
def bucket() -> Iterator[servers.Bucket]:
    """An S3 server; each test takes a prefix of its own."""
    with servers.bucket() as server:
        yield server


@pytest.fixture(scope="session")
def capture(tmp_path_factory) -> Path:
    """A folder with two small videos and a calibration."""
    folder = tmp_path_factory.mktemp("capture")
    for name, shade in (("cam01.mp4", 40), ("cam02.mp4", 80)):
        make_video(folder / name, shade)
    cameras = "".join(CAMERA.format(name=name) for name in ("cam01", "cam02"))
    (folder / "calibration.xml").write_text(f"<calibration><cameras>{cameras}</cameras></calibration>")
    return folder


def make_video(path: Path, shade: int, frames: int = 8) -> None:
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(frames):
            image = np.full((48, 64, 3), shade, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())


@pytest.fixture
def journal(tmp_path) -> "Journal":
    return Journal(tmp_path / "journal")


class Journal:
    """What the stages of the test river wrote down."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.touch()

    def lines(self) -> list[str]:
        return [line.rsplit(" ", 1)[0] for line in self.path.read_text().splitlines()]

    def worker_pid(self) -> int:
        return int(self.path.read_text().splitlines()[-1].rsplit(" ", 1)[1])

    def wait_for(self, line: str, timeout_s: float = 15) -> None:
        deadline_s = time.monotonic() + timeout_s
        while line not in self.lines():
            assert time.monotonic() < deadline_s, f"{line!r} didn't come: {self.lines()}"
            time.sleep(0.02)

    def parameters(self, **values: Any) -> dict[str, Any]:
        return json.loads(json.dumps({"journal": str(self.path), **values}))
