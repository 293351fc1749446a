"""What the command line shows while something long goes on."""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

Advance = Callable[[str, float, float | None], None]
"""Hears the stage, the share of the whole that is done, and the seconds that remain (None: not known yet)."""


@contextmanager
def progress_bar(console: Console) -> Generator[Advance]:
    """Show a bar with the stage, the share that is done, the time so far and the time that remains."""
    columns = (
        TextColumn("  {task.description:14}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, TextColumn("{task.fields[remaining]}"), console=console) as bar:
        task = bar.add_task("waiting", total=1.0, remaining="")

        def advance(stage: str, fraction: float, remaining_s: float | None) -> None:
            remaining = "" if remaining_s is None else f"about {remaining_s:.0f} s left"
            bar.update(task, completed=fraction, description=stage, remaining=remaining)

        yield advance
        bar.update(task, completed=1.0, description="done", remaining="")


def stage_lines(seconds: Mapping[str, float]) -> str:
    """Tell the wall time of each stage in one line."""
    return "Stages: " + ", ".join(f"{stage} {duration_s:.1f} s" for stage, duration_s in seconds.items())
