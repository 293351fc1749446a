"""One camera: the joints of articulated bodies, their carved parts, and the knees of people who walk by.

The parts are modules of :mod:`gonio.bench.joints`; each says what it measures and on what. What needs a recording of
``../shared/data`` is left out where it is out of reach.
"""

from pathlib import Path
from typing import Any

from gonio.bench import Bench
from gonio.bench.joints.bodies import measure_bodies
from gonio.bench.joints.carving import measure_carving
from gonio.bench.joints.drawn import measure_drawn
from gonio.bench.joints.one_camera import measure_balancing, measure_walkers
from gonio.errors import GonioError
from gonio.kernel.parallel import one_blas_thread


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("articulated")
    with one_blas_thread():
        measure_bodies(bench)
        measure_carving(bench)
        measure_drawn(bench)
    measure_walkers(bench)
    try:
        measure_balancing(bench)
    except GonioError as error:
        bench.leave_out("human_balancing_*", error)
    return bench.to_json()
