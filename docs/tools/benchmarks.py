"""The pages of the benchmarks, made from the runs in ``docs/benchmarks/baseline``: nothing in them is written by hand."""

import ast
import math
from pathlib import Path
from typing import Any, NamedTuple

import gonio.bench
from gonio.bench import Metric
from gonio.bench.gate import is_held, read_run, tolerance

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
BASELINE = BENCHMARKS / "baseline"
RIVALS = {
    "opensim": "OpenSim",
    "pose2sim": "Pose2Sim",
    "aniposelib": "aniposelib",
    "caliscope": "Caliscope",
    "mediapipe": "MediaPipe",
    "published": "the paper",
}
COLOURS = {
    "gonio": "#b8432f",
    "OpenSim": "#17365c",
    "Pose2Sim": "#3b7ea1",
    "aniposelib": "#7a9e5e",
    "Caliscope": "#8a6fa8",
}
PANELS_ACROSS = 4


class Comparison(NamedTuple):
    """One quantity that gonio and rivals were measured by, in the same run."""

    name: str
    unit: str
    values: dict[str, float]


def benchmark_pages() -> dict[Path, str]:
    """Give each page of the benchmarks with its text."""
    runs = {path.stem: read_run(path) for path in sorted(BASELINE.glob("*.json"))}
    pages = {BENCHMARKS / f"{name}.md": _page(name, *run) for name, run in runs.items()}
    return {BENCHMARKS / "index.md": _index(runs), **pages}


def draw_plots() -> list[Path]:
    """Draw what has a rival, a picture a bench, beside the pages."""
    import matplotlib as mpl

    mpl.use("svg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update({"svg.hashsalt": "gonio", "font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    paths: list[Path] = []
    for path in sorted(BASELINE.glob("*.json")):
        if not (shown := compare(read_run(path)[1])):
            continue
        rows = -(-len(shown) // PANELS_ACROSS)
        figure, axes = plt.subplots(
            rows, PANELS_ACROSS, figsize=(9.6, 1.75 * rows), squeeze=False, layout="constrained"
        )
        for axis, comparison in zip(axes.flat, shown, strict=False):
            labels, values = list(comparison.values), list(comparison.values.values())
            bars = axis.barh(labels, values, color=[COLOURS.get(label, "#8c8c8c") for label in labels], height=0.65)
            axis.bar_label(bars, [_number(value) for value in values], padding=2, fontsize=7)
            axis.set_title(f"{comparison.name}, {comparison.unit}".removesuffix(", 1"), fontsize=7.5, loc="left")
            axis.margins(x=0.25)
            axis.invert_yaxis()
            axis.tick_params(left=False, bottom=False, labelbottom=False)
            axis.spines.bottom.set_visible(False)
        for axis in axes.flat[len(shown) :]:
            axis.remove()
        paths.append(BENCHMARKS / f"{path.stem}.svg")
        figure.savefig(paths[-1], metadata={"Date": None}, facecolor="white")
        plt.close(figure)
    return paths


def compare(metrics: list[Metric]) -> list[Comparison]:
    """Put the metrics of gonio and of rivals that mean the same side by side, in the order of the run."""
    values = {metric.name: metric for metric in metrics}
    found: dict[str, Comparison] = {}
    for metric in metrics:
        parts = metric.name.split("_")
        for word, rival in RIVALS.items():
            if word not in parts or "ratio" in parts:
                continue
            # A metric without the rival's name is gonio's; where gonio has several ways, it is the points', as the rivals'.
            names = ("_".join(mine if part == word else part for part in parts) for mine in ("", "gonio", "points"))
            own = next((values[n] for n in (name.replace("__", "_").strip("_") for name in names) if n in values), None)
            if own is not None:
                found.setdefault(own.name, Comparison(own.name, own.unit, {"gonio": own.value})).values[rival] = (
                    metric.value
                )
    return list(found.values())


def _page(name: str, document: dict[str, Any], metrics: list[Metric]) -> str:
    lines = [f"# Bench `{name}`", "", *_about(name), "", *_made_on(name, document), ""]
    if shown := compare(metrics):
        rivals = list(dict.fromkeys(rival for comparison in shown for rival in comparison.values))
        lines += ["## Beside the rivals", "", f"![What gonio and the rivals measured in this run]({name}.svg)", ""]
        lines += [f"| | {' | '.join(rivals)} | unit |", f"|---|{'---|' * len(rivals)}---|"]
        for comparison in shown:
            cells = (_number(comparison.values[r]) if r in comparison.values else "" for r in rivals)
            lines.append(f"| `{comparison.name}` | {' | '.join(cells)} | {_unit(comparison.unit)} |")
        lines.append("")
    lines += [
        "## All numbers",
        "",
        "*Must be*: the bound that the bench itself holds. *May lose*: how much worse than here `make gate` lets it become.",
        "",
    ]
    lines += ["| metric | value | unit | must be | may lose |", "|---|---|---|---|---|"]
    lines += [_row(metric) for metric in metrics]
    if notes := [" ".join(note.split()).replace("``", "`") for note in document["notes"]]:
        lines += ["", "## Notes", "", *(f"* {note}" for note in notes)]
    return "\n".join([*lines, ""])


def _row(metric: Metric) -> str:
    bounds = (("≤", metric.at_most), ("≥", metric.at_least))
    bound = ", ".join(f"{sign} {_number(limit)}" for sign, limit in bounds if limit is not None)
    value = f"**{_number(metric.value)}, beyond its bound**" if metric.is_worse else _number(metric.value)
    loss = _number(tolerance(metric)) if is_held(metric) else ""
    return f"| `{metric.name}` | {value} | {_unit(metric.unit)} | {bound} | {loss} |"


def _about(name: str) -> list[str]:
    """Give what the bench says of itself: the docstring of its module."""
    source = (Path(gonio.bench.__file__).parent / f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").replace("``", "`").replace(":mod:", "").splitlines()


def _made_on(name: str, document: dict[str, Any]) -> list[str]:
    machine, versions = document["machine"], document["versions"]
    load = f", load {machine['load_1min']:.1f} at the end" if machine.get("load_1min") is not None else ""
    return [
        f"* Command: `make bench NAME={name}`",
        f"* Commit: `{document['commit']}`",
        f"* Machine: {machine['cpu']}, {machine['cores']} cores, {machine['system']}{load}",
        f"* Versions: {', '.join(f'{package} {version}' for package, version in versions.items())}",
    ]


def _index(runs: dict[str, tuple[dict[str, Any], list[Metric]]]) -> str:
    lines = [
        "# Benchmarks",
        "",
        "Made by `make reference` from the runs in `docs/benchmarks/baseline`: each is a file that `gonio bench` wrote.",
        "`make bench` measures all again, rivals included, in the same run on the same machine; `NAME=` chooses one.",
        "Times and ratios belong to that machine and to how busy it was; accuracy does not.",
        "",
        "`make gate` compares what `make bench` measured with these runs, and fails where an accuracy metric is worse by more",
        "than a tenth of its value, or a twentieth of its bound if that is more. What is copied there is the next baseline.",
        "",
        "| bench | what | metrics | beyond their bound | commit |",
        "|---|---|---|---|---|",
    ]
    for name, (document, metrics) in runs.items():
        beyond = [f"`{metric.name}`" for metric in metrics if metric.is_worse]
        what = _about(name)[0].rstrip(".")
        lines.append(
            f"| [{name}]({name}.md) | {what} | {len(metrics)} | {', '.join(beyond) or 'none'} | `{document['commit'][:10]}` |"
        )
    return "\n".join([*lines, ""])


def _number(value: float) -> str:
    if math.isnan(value):
        return "not known"
    if value and abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"


def _unit(unit: str) -> str:
    return {"1": "", "deg": "°"}.get(unit, unit)
