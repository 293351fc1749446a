"""What the service promises when it is treated badly: kills, cut uploads, outages, many clients at once.

On SQLite with a folder, and on PostgreSQL with an S3 server; both are started here. No rival: the promises are absolute.
"""

import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import av
import numpy as np

from gonio.bench import Bench, servers
from gonio.bench.service_house import House, Kills, kill_at_random, open_house
from gonio.bench.service_load import Cuts, Load, cut_at_random, load, p99_s
from gonio.bench.service_outage import Server, outage
from gonio.errors import ResourceError
from gonio.settings import Settings

KILLS = CUTS = 100
OUTAGE_S = 20.0
LOAD_S = 20.0
POLLERS = 50
_CAMERA = (
    '<camera serial="{name}"><fov_video bottom="47" left="0" right="63" top="0"/><transform r11="1" r12="0" r13="0" r21="0" '
    'r22="0" r23="1" r31="0" r32="-1" r33="0" x="1000" y="-4000" z="1500"/><intrinsic centerPointU="2048" centerPointV="1536" '
    'focalLengthU="107520" focalLengthV="107584" radialDistortion1="-0.046" radialDistortion2="0.14"/></camera>'
)


@dataclass
class Seen:
    """What came of the kills, the cuts and the load; of one database, or of all."""

    kills: list[Kills] = field(default_factory=list)
    cuts: list[Cuts] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)


def run(build_dir: Path) -> dict[str, Any]:
    """Measure everything; takes about an hour. ``GONIO_BENCH_SHARE=0.1`` does a tenth of the counts.

    Metrics that end in the name of a database are of that one, the same without it of both.
    """
    bench = Bench("service")
    share = float(os.environ.get("GONIO_BENCH_SHARE", "1"))
    everything = Seen()
    for kind in ("sqlite", "postgres"):
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gonio-bench-")))
            url, environment, outages = "", dict[str, str](), dict[str, Any]()
            objects = ""
            if kind == "postgres":
                try:
                    postgres, bucket = stack.enter_context(servers.postgres()), stack.enter_context(servers.bucket())
                except ResourceError as error:
                    bench.leave_out("*_postgres", error)
                    continue
                url, objects, environment = postgres.new_database(), bucket.url, bucket.environment
                outages = {"database": postgres, "store": bucket}
            settings = make_settings(folder, url, objects)
            with open_house(settings, folder, environment) as house:
                _measure(bench, kind, house, make_capture(folder), share, everything)
                for name, server in outages.items():
                    _outage(bench, name, house, server, make_capture(folder))
    _report(bench, "", everything)
    _measure_hostile(bench, build_dir)
    return bench.to_json()


def make_settings(folder: Path, database_url: str = "", objects_url: str = "") -> Settings:
    """Give the settings of a service that has two workers and keeps everything in a folder."""
    return Settings(
        data_dir=folder / "data",
        cache_dir=folder / "cache",
        database_url=database_url,
        objects_url=objects_url,
        workers=2,
        requests_per_minute=0,
        free_disk_floor=0,
        jobs_per_lab=1000,
    )


def make_capture(folder: Path) -> list[Path]:
    """Write two small videos and their calibration."""
    cameras = ("cam01", "cam02")
    calibration = folder / "calibration.xml"
    lines = "".join(_CAMERA.format(name=name) for name in cameras)
    calibration.write_text(f"<calibration><cameras>{lines}</cameras></calibration>")
    paths = [calibration]
    for name in cameras:
        paths.append(folder / f"{name}.mp4")
        with av.open(str(paths[-1]), "w") as file:
            stream = file.add_stream("mpeg4", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 90, np.uint8), format="rgb24")
            for _ in range(8):
                file.mux(stream.encode(picture))
            file.mux(stream.encode())
    return paths


def _measure(bench: Bench, kind: str, house: House, capture: list[Path], share: float, everything: Seen) -> None:
    dice = random.Random(8)  # noqa: S311 - no secret
    kills = kill_at_random(house, capture, max(round(KILLS * share), 4), dice)
    bench.notes.append(f"{kind}: killed {_told(kills.kills)}; the journal then stood at {_told(kills.stages)}.")
    cuts = cut_at_random(house, capture[-1], house.folder, max(round(CUTS * share), 4), dice)
    if cuts.given_up:
        bench.notes.append(f"{kind}: uploads that the client gave up: {_told(cuts.reasons)}.")
    seen = load(house, capture, house.folder, LOAD_S, POLLERS, dice)
    _report(bench, f"_{kind}", Seen([kills], [cuts], [seen]))
    everything.kills.append(kills)
    everything.cuts.append(cuts)
    everything.loads.append(seen)


def _report(bench: Bench, of: str, seen: Seen) -> None:
    takeover_s = [second for kills in seen.kills for second in kills.takeover_s]
    bench.add(f"kill_runs{of}", sum(sum(kills.kills.values()) for kills in seen.kills), "kills")
    bench.add(f"jobs_lost{of}", sum(kills.lost for kills in seen.kills), "jobs", at_most=0)
    bench.add(f"reports_different{of}", sum(kills.different for kills in seen.kills), "reports", at_most=0)
    bench.add(f"duplicate_reports{of}", sum(kills.surplus_reports for kills in seen.kills), "reports", at_most=0)
    bench.add(f"repeated_stages{of}", sum(kills.repeated_stages for kills in seen.kills), "stages", at_most=0)
    bench.add(f"takeover_median_s{of}", float(np.median(takeover_s)), "s")
    bench.add(f"takeover_max_s{of}", max(takeover_s), "s")
    bench.add(f"uploads{of}", sum(cuts.uploads for cuts in seen.cuts), "uploads")
    bench.add(f"upload_cuts{of}", sum(cuts.cuts for cuts in seen.cuts), "cuts")
    bench.add(f"upload_server_kills{of}", sum(cuts.server_kills for cuts in seen.cuts), "kills")
    bench.add(f"upload_bad_hashes{of}", sum(cuts.wrong for cuts in seen.cuts), "uploads", at_most=0)
    bench.add(f"uploads_given_up{of}", sum(cuts.given_up for cuts in seen.cuts), "uploads", at_most=0)
    bench.add(f"polls{of}", sum(len(each.poll_s) for each in seen.loads), "polls")
    bench.add(f"poll_p99_ms{of}", 1000 * max(p99_s(each.poll_s) for each in seen.loads), "ms")
    bench.add(f"poll_p99_ms_without_uploads{of}", 1000 * max(p99_s(each.quiet_poll_s) for each in seen.loads), "ms")
    bench.add(f"upload_vs_copy{of}", min(each.share_of_copy for each in seen.loads), "1")
    bench.add(f"server_errors_5xx{of}", sum(each.errors for each in seen.loads), "answers", at_most=0)


def _outage(bench: Bench, name: str, house: House, server: Server, capture: list[Path]) -> None:
    seen = outage(house, server, capture, OUTAGE_S)
    bench.add(f"outage_{name}_job_succeeded", float(seen.ended_as == "succeeded"), "", at_least=1)
    # Beside the outage's own length: two stages of it, the first of which it met.
    bench.add(f"outage_{name}_job_ended_after_over_stage", seen.ended_after_s / OUTAGE_S, "1")
    bench.add(f"outage_{name}_unclear_answers", seen.unclear, "answers", at_most=0)
    bench.notes.append(f"outage of the {name}: answers for {OUTAGE_S:.0f} s: {_told(seen.answers)}.")


def _measure_hostile(bench: Bench, build_dir: Path) -> None:
    """Count the hostile inputs that the tests send to a running service, and those that are not refused as they should be."""
    tests = Path(__file__).parents[3] / "tests" / "service" / "test_hostile.py"
    if not tests.is_file():
        where = ResourceError(
            f"The hostile inputs are in {tests}, which is not here.",
            hint="Run the bench in a checkout of gonio.",
            code="tests-missing",
        )
        bench.leave_out("hostile_*", where)
        return
    told = (build_dir / "hostile.xml").resolve()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junit-xml={told}", str(tests)]
    subprocess.run(command, cwd=tests.parents[2], stdout=subprocess.DEVNULL, check=False)  # noqa: S603 - our own tests
    suites = ElementTree.parse(told).getroot().iter("testsuite")  # noqa: S314 - pytest wrote it just now
    counts = [
        {word: int(suite.get(word, 0)) for word in ("tests", "failures", "errors", "skipped")} for suite in suites
    ]
    bench.add("hostile_inputs", sum(each["tests"] - each["skipped"] for each in counts), "inputs")
    failed = sum(each["failures"] + each["errors"] for each in counts)
    bench.add("hostile_inputs_failed", failed, "inputs", at_most=0)


def _told(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} × {count}" for name, count in sorted(counts.items()))
