"""Run the demo: fetch what it needs, start the service, go the whole way over HTTP, stop the service."""

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from gonio.client import Client, Document
from gonio.demo.recording import CREDIT, Recording, ensure_recording
from gonio.demo.weights import ensure_models
from gonio.http.server import serving
from gonio.pipeline.report import key_lines, load_report
from gonio.settings import Settings
from gonio.terminal import progress_bar, stage_lines


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
    cache_dir = Settings().cache_dir
    console.print("Recording: four synchronized videos and their calibration")
    recording = ensure_recording(cache_dir, from_file=wheels[0] if wheels else None)
    console.print(f"  {CREDIT}", style="dim", soft_wrap=True)
    fetched_s = time.monotonic() - begin_s
    settings = Settings(data_dir=output.absolute() / "data", cache_dir=cache_dir, port=0)
    with serving(settings) as url, Client(url) as gonio:
        console.print(f"Service: {url} (it stops when the demo ends; `gonio serve` keeps it)", soft_wrap=True)
        while not gonio.is_ready():
            time.sleep(0.1)
        session = gonio.create_session(name="Demo: balancing on a beam")
        upload(gonio, session["id"], recording, console)
        job = analyse(gonio, session["id"], console)
        paths = {path.name: path for path in gonio.download(job["id"], output / "report")}
    for line in key_lines(load_report(paths["report.json"])):
        console.print(line, soft_wrap=True)
    seconds = {stage["name"]: stage["seconds"] for stage in job["stages"]}
    console.print(stage_lines(seconds), style="dim", soft_wrap=True)
    console.print(f"Report: [bold]{paths['report.html'].absolute()}[/]", soft_wrap=True)
    console.print(f"Took {time.monotonic() - begin_s:.0f} s, {fetched_s:.0f} s of it for fetching.", style="dim")
    return paths["report.html"]


def upload(gonio: Client, session_id: str, recording: Recording, console: Console) -> None:
    """Upload the videos and the calibration, with a bar for each."""
    columns = TextColumn("  {task.description:14}"), BarColumn(), TextColumn("{task.percentage:3.0f} %")
    with Progress(*columns, console=console) as bar:
        for path in (*recording.videos, recording.calibration):
            task = bar.add_task(path.name, total=path.stat().st_size)
            gonio.upload(session_id, path, on_progress=lambda sent, _total, task=task: bar.update(task, completed=sent))


def analyse(gonio: Client, session_id: str, console: Console) -> Document:
    """Start the analysis and wait for its end, with a bar."""
    with progress_bar(console) as advance:

        def show(job: Document) -> None:
            progress = job.get("progress")
            if progress:
                advance(progress["stage"], progress["fraction"], progress["remaining_s"])

        return gonio.wait(gonio.analyse(session_id)["id"], on_progress=show, poll_s=0.2)
