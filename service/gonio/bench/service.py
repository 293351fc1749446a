"""What the service promises when it is treated badly: kills, cut uploads, outages, many clients at once.

On SQLite with a folder, and on PostgreSQL with an S3 server; both are started here. No rival: the promises are absolute.
"""

import os
import random
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import av
import numpy as np

from gonio.bench import Bench, servers
from gonio.bench.service_house import House, kill_at_random, open_house
from gonio.bench.service_load import cut_at_random, load, p99_s
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


def run(_build_dir: Path) -> dict[str, Any]:
    """Measure everything; takes about half an hour. ``GONIO_BENCH_SHARE=0.1`` does a tenth of the counts."""
    bench = Bench("service")
    share = float(os.environ.get("GONIO_BENCH_SHARE", "1"))
    for kind in ("sqlite", "postgres"):
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gonio-bench-")))
            url, environment, outages = "", dict[str, str](), dict[str, Any]()
            objects = ""
            if kind == "postgres":
                try:
                    postgres, bucket = stack.enter_context(servers.postgres()), stack.enter_context(servers.bucket())
                except ResourceError as error:
                    bench.leave_out("PostgreSQL and S3", error)
                    continue
                url, objects, environment = postgres.new_database(), bucket.url, bucket.environment
                outages = {"database down": postgres, "store down": bucket}
            settings = make_settings(folder, url, objects)
            with open_house(settings, folder, environment) as house:
                _measure(bench, kind, house, make_capture(folder), share)
                for name, server in outages.items():
                    _outage(bench, name, house, server, make_capture(folder))
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


def _measure(bench: Bench, kind: str, house: House, capture: list[Path], share: float) -> None:
    dice = random.Random(8)  # noqa: S311 - no secret
    kills = kill_at_random(house, capture, max(round(KILLS * share), 4), dice)
    bench.add(f"{kind}: kills", sum(kills.kills.values()), "")
    bench.add(f"{kind}: jobs lost", kills.lost, "", at_most=0)
    bench.add(f"{kind}: reports different", kills.different, "", at_most=0)
    bench.add(f"{kind}: reports too many", kills.surplus_reports, "", at_most=0)
    bench.add(f"{kind}: finished stages repeated", kills.repeated_stages, "", at_most=0)
    bench.add(f"{kind}: take-over, median", float(np.median(kills.takeover_s)), "s")
    bench.add(f"{kind}: take-over, longest", max(kills.takeover_s), "s")
    bench.notes.append(f"{kind}: killed {_told(kills.kills)}; the journal then stood at {_told(kills.stages)}.")
    cuts = cut_at_random(house, capture[-1], house.folder, max(round(CUTS * share), 4), dice)
    bench.add(f"{kind}: uploads", cuts.uploads, "")
    bench.add(f"{kind}: cuts of uploads", cuts.cuts, "")
    bench.add(f"{kind}: kills of the API under uploads", cuts.server_kills, "")
    bench.add(f"{kind}: hashes wrong", cuts.wrong, "", at_most=0)
    seen = load(house, capture, house.folder, LOAD_S, POLLERS, dice)
    bench.add(f"{kind}: polls", len(seen.poll_s), "")
    bench.add(f"{kind}: poll, 99th percentile", 1000 * p99_s(seen.poll_s), "ms")
    bench.add(f"{kind}: the same before the uploads", 1000 * p99_s(seen.quiet_poll_s), "ms")
    bench.add(f"{kind}: upload throughput over copy and hash", seen.share_of_copy, "")
    bench.add(f"{kind}: errors under load", seen.errors, "", at_most=0)


def _outage(bench: Bench, name: str, house: House, server: Server, capture: list[Path]) -> None:
    seen = outage(house, server, capture, OUTAGE_S)
    bench.add(f"{name}: job succeeded", float(seen.ended_as == "succeeded"), "", at_least=1)
    # Beside the outage's own length: two stages of it, the first of which it met.
    bench.add(f"{name}: job ended after its return, over the length of a stage", seen.ended_after_s / OUTAGE_S, "")
    bench.add(f"{name}: unclear answers", seen.unclear, "", at_most=0)
    bench.notes.append(f"{name}: answers for {OUTAGE_S:.0f} s: {_told(seen.answers)}.")


def _told(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} × {count}" for name, count in sorted(counts.items()))
