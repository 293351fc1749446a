"""The gate: what the benches measured against the committed baseline, metric by metric.

Held are the accuracy metrics: those with one bound, ``at_most`` or ``at_least``, that are no speeds. A metric may be worse
than its baseline by a tenth of it, or by a twentieth of its bound, whichever is more: numbers far inside their bound may
move, counts that must be 0 may not. Metrics with two bounds (how often a band holds the truth) have no better and worse, and
only their bounds hold.
"""

import json
import re
from pathlib import Path
from typing import Any

from rich.console import Console

from gonio.bench import Metric
from gonio.errors import GonioError, InputError

SHARE_OF_BASELINE, SHARE_OF_BOUND = 0.10, 0.05
SPEED = re.compile(r"(^|_)(fps|cpu|ratio|growth|rss|time|memory)(_|$)")
SPEED_UNITS = {"s", "1/s", "MB", "kB", "ms/frame"}


def read_run(path: Path) -> tuple[dict[str, Any], list[Metric]]:
    """Read what one bench wrote: the whole document, and its metrics.

    Raises:
        InputError: ``bench-unreadable``: the file is no result of ``gonio bench``.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return document, [Metric(**metric) for metric in document["metrics"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} can't be read as the result of a bench: {error!r}.",
            hint="Write it again: gonio bench NAME.",
            code="bench-unreadable",
        ) from error


def is_held(metric: Metric) -> bool:
    """Whether the gate compares a metric with its baseline: it has a better side, and is no speed."""
    one_sided = (metric.at_most is None) != (metric.at_least is None)
    return one_sided and metric.unit not in SPEED_UNITS and not SPEED.search(metric.name)


def tolerance(baseline: Metric) -> float:
    """Give by how much a metric may be worse than its baseline, in its own unit."""
    bound = baseline.at_most if baseline.at_most is not None else baseline.at_least
    return max(SHARE_OF_BASELINE * abs(baseline.value), SHARE_OF_BOUND * abs(bound or 0.0))


def compare_run(run: list[Metric], baseline: list[Metric]) -> list[str]:
    """Say of each held metric that got worse, or that is missing, by how much and what was allowed."""
    found = {metric.name: metric for metric in run}
    worse: list[str] = []
    for before in filter(is_held, baseline):
        now = found.get(before.name)
        if now is None:
            worse.append(f"{before.name}: not measured; the baseline has {before.value:.4g} {before.unit}".rstrip())
            continue
        allowed = tolerance(before)
        loss = now.value - before.value if before.at_most is not None else before.value - now.value
        if not loss <= allowed:  # a number that is no number is worse, too
            worse.append(
                f"{before.name}: {now.value:.4g} {before.unit}, {loss:.3g} worse than the baseline's "
                f"{before.value:.4g} (allowed: {allowed:.3g})"
            )
    return worse


def check(name: str, runs: Path, baselines: Path, console: Console) -> None:
    """Compare the runs in ``runs`` with their baselines, one bench or all that were run, and say what was compared.

    Raises:
        InputError: ``bench-not-run`` or ``bench-no-baseline``: there is nothing to compare; ``bench-unreadable``.
        GonioError: ``bench-worse``: an accuracy metric is worse than its baseline allows.
    """
    paths = [runs / f"{name}.json"] if name else sorted(runs.glob("*.json"))
    if not any(path.is_file() for path in paths):
        raise InputError(
            f"There is no result of a bench in {runs}.", hint=f"Run it first: gonio bench {name}.", code="bench-not-run"
        )
    kept = [path for path in paths if (baselines / path.name).is_file()]
    if not kept:
        raise InputError(
            f"There is no baseline in {baselines} for {', '.join(path.stem for path in paths)}.",
            hint="Copy a run that is right there, and commit it.",
            code="bench-no-baseline",
        )
    worse: list[str] = []
    for path in kept:
        _, run = read_run(path)
        _, baseline = read_run(baselines / path.name)
        lost = compare_run(run, baseline)
        held = sum(map(is_held, baseline))
        console.print(f"{path.stem}: {held - len(lost)} of {held} accuracy metrics as good as the baseline")
        worse += [f"{path.stem}: {line}" for line in lost]
    for path in (path for path in paths if path not in kept):
        console.print(f"{path.stem}: has no baseline, not compared")
    if worse:
        raise GonioError(
            f"{len(worse)} accuracy metrics are worse than the baseline:\n  " + "\n  ".join(worse),
            hint="Find the change that did it. If it is right, copy the run into the baseline and say why in the commit.",
            code="bench-worse",
        )
