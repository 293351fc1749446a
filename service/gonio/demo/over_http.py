"""What the demos share: a service of their own, and the whole way through it over HTTP."""

import time
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from gonio.client import Client, Document
from gonio.http.server import serving
from gonio.jobs.access import opened
from gonio.pipeline.report import key_lines, load_report
from gonio.settings import Settings
from gonio.terminal import progress_bar, stage_lines


@contextmanager
def demo_service(output: Path, console: Console) -> Generator[Client]:
    """Run a service that keeps its data below ``output``, and give a client of it."""
    settings = Settings().model_copy(update={"data_dir": output.absolute() / "data", "port": 0})
    with serving(settings) as url, Client(url, key=_key(settings)) as gonio:
        console.print(f"Service: {url} (it stops when the demo ends; `gonio serve` keeps it)", soft_wrap=True)
        while not gonio.is_ready():
            time.sleep(0.1)
        yield gonio


def _key(settings: Settings) -> str:
    """Make a key for the day, where the service wants one: its database or its store is elsewhere."""
    if settings.is_embedded and settings.keys != "required":
        return ""
    with opened(settings) as access:
        return access.create_key(settings.default_lab, "demo", ("read", "write"), timedelta(days=1)).secret


def analyse_over_http(
    gonio: Client,
    session_id: str,
    files: Iterable[Path],
    output: Path,
    console: Console,
    parameters: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Upload, analyse, wait, download; say the key figures, and give the report's files by name."""
    upload(gonio, session_id, files, console)
    job = analyse(gonio, session_id, console, parameters)
    paths = {path.name: path for path in gonio.download(job["id"], output)}
    for line in key_lines(load_report(paths["report.json"])):
        console.print(line, soft_wrap=True)
    seconds = {stage["name"]: stage["seconds"] for stage in job["stages"]}
    console.print(stage_lines(seconds), style="dim", soft_wrap=True)
    return paths


def upload(gonio: Client, session_id: str, files: Iterable[Path], console: Console) -> None:
    """Upload files, with a bar for each."""
    columns = TextColumn("  {task.description:16}"), BarColumn(), TextColumn("{task.percentage:3.0f} %")
    with Progress(*columns, console=console) as bar:
        for path in files:
            task = bar.add_task(path.name, total=path.stat().st_size)
            gonio.upload(session_id, path, on_progress=lambda sent, _total, task=task: bar.update(task, completed=sent))


def analyse(gonio: Client, session_id: str, console: Console, parameters: Mapping[str, Any] | None = None) -> Document:
    """Start the analysis and wait for its end, with a bar."""
    with progress_bar(console) as advance:

        def show(job: Document) -> None:
            progress = job.get("progress")
            if progress:
                advance(progress["stage"], progress["fraction"], progress["remaining_s"])

        return gonio.wait(gonio.analyse(session_id, parameters)["id"], on_progress=show, poll_s=0.2)
