"""A service with the small river of ``worker_main.py``; run as a process, it prints its address when it answers."""

import sys
from pathlib import Path

from gonio.http.server import serve
from gonio.jobs.logs import set_up_logging
from gonio.settings import Settings

WORKER = (sys.executable, str(Path(__file__).with_name("worker_main.py")))


def say(url: str) -> None:
    sys.stdout.write(f"{url}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    set_up_logging(Settings())
    serve(Settings(), on_ready=say, worker_command=WORKER)
