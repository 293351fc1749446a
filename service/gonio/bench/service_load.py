"""Uploads that are cut, and many clients at once."""

import hashlib
import random
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np

from gonio.bench.service_house import House
from gonio.client import Client
from gonio.errors import GonioError

CUT_CHANCE = 0.004
"""Of each 64 KB: a file of 12 MB is cut about once."""


@dataclass
class Cuts:
    """What came of cutting uploads."""

    uploads: int = 0
    wrong: int = 0
    """Files whose hash in the service is not their own."""
    given_up: int = 0
    """Uploads that the client ended with an error, because the server was gone for longer than it waits."""
    reasons: Counter[str] = field(default_factory=Counter[str])
    cuts: int = 0
    server_kills: int = 0


def cut_at_random(house: House, video: Path, folder: Path, count: int, dice: random.Random) -> Cuts:
    """Upload large files, four at once, cutting each at random bytes, while the API is killed every few seconds."""
    result = Cuts()
    lock = threading.Lock()
    with house.client() as client:
        session = client.create_session(name="cuts")["id"]

    def upload(index: int) -> None:
        own = random.Random(f"{dice.random()} {index}")  # noqa: S311 - no secret
        path = folder / f"cut-{index}.mp4"
        path.write_bytes(grown(video, own.randrange(9_000_000, 14_000_000), own))

        def cut(_sent: int, _size: int) -> None:
            if own.random() < CUT_CHANCE:
                with lock:
                    result.cuts += 1
                raise httpx.WriteError("cut")

        try:
            with house.client() as client:
                file = client.upload(session, path, on_progress=cut)
            wrong, given_up = file["sha256"] != hashlib.sha256(path.read_bytes()).hexdigest(), False
        except GonioError as error:
            wrong, given_up = False, True
            result.reasons[str(error.code)] += 1
        with lock:
            result.uploads += 1
            result.wrong += wrong
            result.given_up += given_up
        path.unlink()

    with ThreadPoolExecutor(4) as pool:
        running = [pool.submit(upload, index) for index in range(count)]
        while not all(each.done() for each in running):
            time.sleep(dice.uniform(1.0, 3.0))
            if not all(each.done() for each in running):
                house.kill("api", 0)
                house.start_api()
                result.server_kills += 1
        for each in running:
            each.result()
    return result


@dataclass
class Load:
    """What many clients at once meet."""

    poll_s: list[float] = field(default_factory=list)
    quiet_poll_s: list[float] = field(default_factory=list)
    errors: int = 0
    uploaded_bytes: int = 0
    upload_s: float = 0.0
    copy_bytes_per_s: float = 0.0

    @property
    def share_of_copy(self) -> float:
        """The throughput of the uploads over that of a plain copy with a hash, measured just before."""
        return self.uploaded_bytes / self.upload_s / self.copy_bytes_per_s


class _Crowd:
    """Clients that do one thing again and again until the time is over."""

    def __init__(self, house: House, session: str, job: str, path: Path, end_s: float, result: Load) -> None:
        self._house = house
        self._session = session
        self._job = job
        self._path = path
        self._end_s = end_s
        self._result = result
        self._lock = threading.Lock()

    def poll(self) -> None:
        """Ask for the job once a second."""
        with self._house.client() as client:
            while time.monotonic() < self._end_s:
                begin_s = time.monotonic()
                self._counting_errors(lambda: client.job(self._job))
                took_s = time.monotonic() - begin_s
                with self._lock:
                    self._result.poll_s.append(took_s)
                time.sleep(max(1.0 - took_s, 0.0))

    def upload(self) -> None:
        """Send the file under ever new names."""
        with self._house.client() as client:
            while time.monotonic() < self._end_s:
                name = f"load-{time.monotonic_ns()}-{threading.get_ident()}.mp4"
                self._counting_errors(lambda name=name: self._send(client, name))

    def _send(self, client: Client, name: str) -> None:
        file = client.upload(self._session, self._path, name=name)
        with self._lock:
            self._result.uploaded_bytes += file["size"]

    def _counting_errors(self, work: Callable[[], object]) -> None:
        try:
            work()
        except GonioError:
            with self._lock:
                self._result.errors += 1


def load(house: House, capture: list[Path], folder: Path, seconds: float, pollers: int, dice: random.Random) -> Load:
    """Have clients poll a job each second, four uploads run and two jobs compute, for a while.

    Before the uploads begin, the same clients poll for a quarter of that time: what their number alone costs.
    """
    result = Load()
    path, journal = folder / "load.mp4", folder / "journal-load"
    path.write_bytes(grown(capture[-1], 50_000_000, dice))
    journal.touch()
    result.copy_bytes_per_s = path.stat().st_size / _copy_s(path)
    with house.client() as client:
        session = _session_of(client, capture)
        wanted = [{"journal": str(journal), "seconds": 3 * seconds + number} for number in range(2)]
        jobs = [client.analyse(session, parameters)["id"] for parameters in wanted]
        quiet = _Crowd(house, session, jobs[0], path, time.monotonic() + seconds / 4, result)
        _together([threading.Thread(target=quiet.poll) for _ in range(pollers)])
        result.quiet_poll_s, result.poll_s = result.poll_s, []
        begin_s = time.monotonic()
        crowd = _Crowd(house, session, jobs[0], path, begin_s + seconds, result)
        senders = [threading.Thread(target=crowd.upload) for _ in range(4)]
        askers = [threading.Thread(target=crowd.poll) for _ in range(pollers)]
        for thread in senders + askers:
            thread.start()
        for thread in senders:
            thread.join()
        result.upload_s = time.monotonic() - begin_s
        for thread in askers:
            thread.join()
        for job in jobs:
            client.cancel(job)
    path.unlink()
    return result


def _together(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _session_of(client: Client, capture: list[Path]) -> str:
    session = client.create_session(name="load")["id"]
    for path in capture:
        client.upload(session, path)
    return session


def p99_s(times_s: list[float]) -> float:
    """Give the time that only one of a hundred is above."""
    return float(np.percentile(times_s, 99))


def grown(video: Path, size: int, dice: random.Random) -> bytes:
    """Give a video that is as large as wanted: behind its last box stands one that players skip."""
    return video.read_bytes() + (8 + size).to_bytes(4, "big") + b"free" + dice.randbytes(size)


def _copy_s(path: Path) -> float:
    begin_s = time.monotonic()
    copy = path.with_suffix(".copy")
    shutil.copyfile(path, copy)
    with copy.open("rb") as file:
        hashlib.file_digest(file, "sha256")
    copy.unlink()
    return time.monotonic() - begin_s
