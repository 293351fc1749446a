"""Run the demo: fetch what it needs, start the service, go the whole way over HTTP, stop the service."""

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from gonio.demo.over_http import analyse_over_http, demo_service
from gonio.demo.recording import CREDIT, ensure_recording
from gonio.demo.weights import ensure_models
from gonio.settings import Settings


def run_demo(output: Path, from_files: Sequence[Path], console: Console) -> Path:
    """Go the whole way and give the report's page.

    Args:
        output: Where the service keeps its data (``data/``) and the report goes (``report/``).
        from_files: Files to use instead of fetching them; each is recognised by its name.
        console: Where to say what happens.
    """
    begin_s = time.monotonic()
    wheels = [path for path in from_files if path.name.startswith("pose2sim")]
    ensure_models(None, [path for path in from_files if path not in wheels], console)
    console.print("Recording: four synchronized videos and their calibration")
    recording = ensure_recording(Settings().cache_dir, from_file=wheels[0] if wheels else None)
    console.print(f"  {CREDIT}", style="dim", soft_wrap=True)
    fetched_s = time.monotonic() - begin_s
    with demo_service(output, console) as gonio:
        session = gonio.create_session(name="Demo: balancing on a beam")["id"]
        files = (*recording.videos, recording.calibration)
        paths = analyse_over_http(gonio, session, files, output / "report", console)
    console.print(f"Report: [bold]{paths['report.html'].absolute()}[/]", soft_wrap=True)
    console.print(f"Took {time.monotonic() - begin_s:.0f} s, {fetched_s:.0f} s of it for fetching.", style="dim")
    return paths["report.html"]
