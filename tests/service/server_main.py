"""A service with the small river of ``worker_main.py``; run as a process, it prints its address when it answers."""

import sys
from pathlib import Path
from typing import Any

import av

from gonio.errors import InputError
from gonio.http.server import serve
from gonio.settings import Settings

WORKER = (sys.executable, str(Path(__file__).with_name("worker_main.py")))


def probe(path: Path, role: str) -> dict[str, Any]:
    """Look into a file as the real probe does: a video is decoded, a calibration is parsed."""
    if role == "calibration":
        if not path.read_bytes().startswith(b"<calibration>"):
            raise InputError(f"{path.name} is no calibration.", hint="Export it again.", code="calibration-unreadable")
        return {"cameras": ["a", "b"]}
    try:
        with av.open(str(path)) as video:
            frames = sum(1 for _ in video.decode(video=0))
            return {"frames": frames, "rate_hz": float(video.streams.video[0].average_rate or 0)}
    except (av.FFmpegError, IndexError) as error:
        raise InputError(f"{path.name} is no video.", hint="Convert it to MP4.", code="video-unreadable") from error


def say(url: str) -> None:
    sys.stdout.write(f"{url}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    serve(Settings(), on_ready=say, worker_command=WORKER, probe=probe)
