"""A database or a store that goes away in the middle of a job, and comes back."""

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from gonio.bench.service_house import House, wait_for
from gonio.client import Client
from gonio.errors import GonioError

READY_S = 120.0


class Server(Protocol):
    """What can be stopped and started again."""

    def stop(self) -> None:
        """Stop it; what talks to it loses its connection."""
        ...

    def start(self) -> None:
        """Start it again, and wait until it answers."""
        ...


@dataclass
class Outage:
    """What an outage did."""

    answers: Counter[str] = field(default_factory=Counter[str])
    ended_after_s: float = float("nan")
    ended_as: str = "running"

    @property
    def unclear(self) -> int:
        """How many answers didn't say what is the matter."""
        return sum(count for answer, count in self.answers.items() if answer.startswith(("500", "None")))


def outage(house: House, server: Server, capture: Sequence[Path], seconds: float) -> Outage:
    """Stop a server in the middle of a job; ask for a report meanwhile, and see when and how the job ends afterwards.

    The job's two long stages take as long as the outage each, so that it finds them at work.
    """
    seen = Outage()
    with house.client() as client, tempfile.TemporaryDirectory(prefix="gonio-outage-") as scratch:
        journal = Path(scratch) / "journal"
        journal.touch()
        session = client.create_session(name="outage")["id"]
        for path in capture:
            client.upload(session, path)
        earlier = client.analyse(session, {"journal": str(journal), "seconds": 0.0})["id"]
        client.wait(earlier, timeout_s=READY_S)
        journal.write_text("")
        job = client.analyse(session, {"journal": str(journal), "seconds": seconds})["id"]
        wait_for(lambda: "begin keypoints" in journal.read_text(), READY_S)
        server.stop()
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            seen.answers[_answer(client, earlier, Path(scratch) / "report")] += 1
            time.sleep(0.2)
        server.start()
        back_s = time.monotonic()
        try:
            seen.ended_as = client.wait(job, timeout_s=2 * seconds + READY_S, poll_s=0.1)["state"]
        except GonioError as error:
            seen.ended_as = str(error.code)
        seen.ended_after_s = time.monotonic() - back_s
    return seen


def _answer(client: Client, report: str, folder: Path) -> str:
    try:
        client.download(report, folder)
    except GonioError as error:
        return f"{error.details.get('status')} {error.code}"
    return "200"
