"""Kinetics: the knee's angle and torque from foot pressure, against full plates, Plug-in Gait and virtual people.

The parts are modules of :mod:`gonio.bench.torque`; each says what it measures and on what. What needs a recording of
``../shared/data`` is left out where it is out of reach.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gonio.bench import Bench
from gonio.bench.torque.clock import measure_clock
from gonio.bench.torque.gait2354 import measure_gait2354
from gonio.bench.torque.vicon import measure_vicon
from gonio.bench.torque.walks import measure_walks
from gonio.errors import GonioError


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("kinetics")
    parts: dict[str, Callable[[Bench], None]] = {"gait2354_*": measure_gait2354, "vicon_*": measure_vicon}
    for metrics, measure in parts.items():
        try:
            measure(bench)
        except GonioError as error:
            bench.leave_out(metrics, error)
    measure_clock(bench)
    measure_walks(bench)
    return bench.to_json()
