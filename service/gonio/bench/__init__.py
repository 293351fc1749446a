"""Benches: accuracy and speed against the rivals, measured in the same run on the same machine.

A bench is a module of this package with ``run(build_dir)``, which gives the content of its JSON file. Rivals live in
environments of their own under ``build/peers/``. What a bench can't measure, because a rival or a recording is out of
reach, it leaves out and says so. An accuracy metric carries the worst value that is still acceptable; going beyond it
fails ``make bench``.
"""

import importlib
import importlib.metadata
import json
import os
import platform
import subprocess
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from gonio.errors import GonioError, InputError

PACKAGES = ("gonio", "numpy", "scipy", "numba", "onnxruntime", "av", "opencv-contrib-python-headless")
NOT_BENCHES = {
    "__init__",
    "gate",
    "peers",
    "recordings",
    "board_sessions",
    "board_faults",
    "servers",
    "service_house",
    "service_load",
    "service_outage",
}


@dataclass(frozen=True)
class Metric:
    """One measured number. ``at_most`` and ``at_least`` are the committed baseline with its tolerance, where it has one."""

    name: str
    value: float
    unit: str
    at_most: float | None = None
    at_least: float | None = None

    @property
    def is_worse(self) -> bool:
        """Whether the number is worse than its baseline allows; a number that is no number is."""
        beyond_most = self.at_most is not None and not self.value <= self.at_most
        return beyond_most or (self.at_least is not None and not self.value >= self.at_least)


@dataclass
class Bench:
    """What one bench measured, and what it left out and why."""

    name: str
    metrics: list[Metric] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(
        self, name: str, value: float, unit: str, *, at_most: float | None = None, at_least: float | None = None
    ) -> None:
        """Add a metric."""
        self.metrics.append(Metric(name, float(value), unit, at_most, at_least))

    def explain(self, docstring: str | None) -> None:
        """Note how a part was measured: each paragraph of its module's docstring but the first, which is its title."""
        self.notes += [part.replace("\n", " ").strip() for part in (docstring or "").split("\n\n")[1:]]

    def leave_out(self, names: str, error: GonioError) -> None:
        """Note which metrics could not be measured, and why."""
        self.notes.append(f"{names}: left out. {error}")

    def to_json(self) -> dict[str, Any]:
        """Give the content of ``build/bench/<name>.json``."""
        metrics = [{k: v for k, v in asdict(metric).items() if v is not None} for metric in self.metrics]
        return {
            "bench": self.name,
            "commit": describe_commit(),
            "machine": describe_machine(),
            "versions": {"python": platform.python_version(), **_versions()},
            "metrics": metrics,
            "notes": self.notes,
        }


def list_benches() -> tuple[str, ...]:
    """List the names of all benches."""
    return tuple(sorted(path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in NOT_BENCHES))


def run_benches(name: str, build_dir: Path, console: Console) -> None:
    """Run one bench, or all of them if ``name`` is empty; write each result to ``build_dir/bench/<name>.json``.

    Raises:
        InputError: There is no such bench (``bench-unknown``).
        GonioError: An accuracy metric got worse than its baseline allows (``bench-worse``).
    """
    if name and name not in list_benches():
        raise InputError(
            f"There is no bench called {name!r}.",
            hint=f"Choose one of: {', '.join(list_benches())}.",
            code="bench-unknown",
        )
    worse: list[str] = []
    for each in (name,) if name else list_benches():
        console.print(f"[bold]{each}[/]")
        result: dict[str, Any] = importlib.import_module(f"gonio.bench.{each}").run(build_dir)
        path = build_dir / "bench" / f"{each}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        metrics = [Metric(**metric) for metric in result["metrics"]]
        for metric in metrics:
            mark = "  [red]worse than its baseline[/]" if metric.is_worse else ""
            console.print(f"  {metric.name:32} {metric.value:10.4g} {metric.unit}{mark}")
        for note in result.get("notes", ()):
            console.print(f"  [yellow]{note}[/]", soft_wrap=True)
        worse += [f"{each}: {metric.name}" for metric in metrics if metric.is_worse]
    if worse:
        raise GonioError(
            f"{len(worse)} metrics got worse: {', '.join(worse)}.",
            hint=f"Compare {build_dir / 'bench'} with the baseline in the bench's module.",
            code="bench-worse",
        )


def describe_machine() -> dict[str, Any]:
    """Tell what the numbers were measured on."""
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = [
            line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = models[0] if models else cpu
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cpu": cpu, "cores": os.cpu_count(), "system": platform.platform(), "load_1min": load}


def describe_commit() -> str:
    """Give the checkout's commit, with ``-dirty`` if it was changed; empty outside a checkout."""
    command = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(  # noqa: S603 - fixed words
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def _versions() -> dict[str, str]:
    found: dict[str, str] = {}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
