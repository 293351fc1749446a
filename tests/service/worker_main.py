"""A worker with a small river: real stages that read the files, compute, take their time, and fail on request.

Calibrations and objects it computes with gonio's own rivers.

Run as a process: ``python worker_main.py``. What its stages do is written to the file ``parameters["journal"]``.
"""

import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Float

from gonio.errors import CaptureError
from gonio.jobs.logs import set_up_logging
from gonio.jobs.worker import run_worker
from gonio.pipeline.run import CaptureFile, Outcome, Progress, ReportFiles, River, StageRunner
from gonio.records import Finding, record
from gonio.settings import Settings

SHARES = {"capture": 0.1, "keypoints": 0.7, "dynamics": 0.1, "report": 0.1}


@record
class Brightness:
    """The mean brightness of each frame of a video, standing for its keypoints; NaN before the first frame."""

    path: Path
    mean: Float[np.ndarray, " frame"]


class Course:
    def __init__(self, parameters: Mapping[str, Any], output_dir: Path) -> None:
        self.parameters = parameters
        self.output_dir = output_dir

    def note(self, what: str) -> None:
        with Path(self.parameters["journal"]).open("a") as journal:
            journal.write(f"{what} {os.getpid()}\n")

    def spend(self, seconds: float, progress: Progress) -> None:
        begin_s = time.monotonic()
        fraction = 0.0
        try:
            while fraction < 1:
                progress(fraction)
                time.sleep(0.02)
                fraction = (time.monotonic() - begin_s) / seconds if seconds else 1.0
        except BaseException:
            self.note(f"stopped at {fraction:.3f}")
            raise

    def misbehave(self, stage: str) -> None:
        match self.parameters.get("fault", {}).get(stage):
            case "bug":
                raise RuntimeError("secret: /etc/passwd")
            case "capture":
                raise CaptureError("Nobody is in the videos.", hint="Film a person.", code="nobody-found", frames=3)
            case "crash":
                os._exit(9)
            case _:
                pass

    def stage(self, name: str, seconds: float, value: Any, findings: tuple[Finding, ...] = ()) -> Any:
        def work(progress: Progress) -> Outcome[Any]:
            self.note(f"begin {name}")
            self.misbehave(name)
            self.spend(seconds, progress)
            result = value()
            self.note(f"end {name}")
            return Outcome(result, findings)

        return work


def brightness(file: CaptureFile) -> Brightness:
    with av.open(str(file.path)) as video:
        means = [frame.to_ndarray(format="gray").mean() for frame in video.decode(video=0)]
    return Brightness(path=file.path, mean=np.array([np.nan, *means]))


def analyse(
    capture_files: Sequence[CaptureFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> ReportFiles:
    river = Course(parameters, output_dir)
    seconds = float(parameters.get("seconds", 0.1))
    videos = [file for file in capture_files if file.role == "video"]
    names = runner("capture", river.stage("capture", 0, lambda: tuple(file.name for file in capture_files)))
    dark = Finding(code="dark", severity="warning", stage="keypoints", message="It is dark.", hint="Turn on the light.")
    points = runner("keypoints", river.stage("keypoints", seconds, lambda: tuple(map(brightness, videos)), (dark,)))

    def draw() -> Path:
        path = output_dir / "curves.svg"
        path.write_text("<svg/>")
        return path

    curves: Path = runner("dynamics", river.stage("dynamics", seconds, draw))

    def write() -> ReportFiles:
        document = {
            "files": list(names),
            "frames": [int(np.isfinite(p.mean).sum()) for p in points],
            "exist": [p.path.exists() for p in points] + [curves.exists()],
            "mean": [float(np.nanmean(p.mean)) for p in points],
            "mass_kg": parameters["subject"].get("mass_kg"),
            "findings": [finding.code for finding in runner.findings],
        }
        files = ReportFiles(
            document=output_dir / "report.json", page=output_dir / "report.html", others=(output_dir / "knee.mot",)
        )
        files.document.write_text(json.dumps(document))
        files.page.write_text(
            "<!doctype html><title>report</title><style>p{color:red}</style><script>1</script><p>Knee"
        )
        files.others[0].write_text("time knee\n0 1\n")
        return files

    return runner("report", river.stage("report", 0, write))


class Rivers(dict[str, River]):
    """The small river, and gonio's own ones, which are loaded for the first job of their kind: that takes seconds."""

    def __missing__(self, kind: str) -> River:
        from gonio.pipeline.rivers import RIVERS

        return RIVERS[kind]


if __name__ == "__main__":
    set_up_logging(Settings())
    supervisor = os.environ.get("GONIO_SUPERVISOR_PID")
    rivers = Rivers(human_multicamera=River(analyse, SHARES))
    run_worker(Settings(), rivers, supervisor_pid=int(supervisor) if supervisor else None)
