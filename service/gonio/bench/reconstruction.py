"""Reconstruction: from keypoints in the images to points and motion, against truth, the paper, Pose2Sim and aniposelib.

The parts are modules of :mod:`gonio.bench.points`; each says what it measures and on what. What needs the balancing trial of
``../shared/data`` or a rival is left out where they are out of reach.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gonio.bench import Bench
from gonio.bench.points.bad_input import measure_bad_input
from gonio.bench.points.balancing import measure_balancing
from gonio.bench.points.ladder import measure_error_bars, measure_ladder, measure_mismatch
from gonio.bench.points.outliers import measure_outliers
from gonio.bench.points.people import measure_people
from gonio.bench.points.rates import measure_rates
from gonio.bench.points.speed import measure_growth, measure_ratios
from gonio.errors import GonioError


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("reconstruction")
    measure_ladder(bench)
    measure_mismatch(bench)
    measure_error_bars(bench)
    measure_bad_input(bench)
    parts: dict[str, Callable[[], None]] = {
        "burst_*, clean_*": lambda: measure_outliers(bench, build_dir),
        "real_*, sync_*": lambda: measure_balancing(bench, build_dir),
        "*_ratio_*": lambda: measure_ratios(bench, build_dir),
        "people_*": lambda: measure_people(bench, build_dir),
        "default_mode_*": lambda: measure_rates(bench, build_dir),
    }
    for metrics, measure in parts.items():
        try:
            measure()
        except GonioError as error:
            bench.leave_out(metrics, error)
    measure_growth(bench)
    return bench.to_json()
