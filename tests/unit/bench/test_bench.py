import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gonio import bench as benches
from gonio.bench import Bench, Metric, keypoints, list_benches, run_benches
from gonio.bench.peers import run_in_peer
from gonio.errors import GonioError, InputError, ResourceError
from gonio.vision.video import probe_video


def test_a_metric_knows_when_it_is_worse() -> None:
    assert not Metric("free", 9.0, "px").is_worse
    assert [Metric("px", value, "px", at_most=2.0).is_worse for value in (1.9, 2.0, 2.1, math.nan)] == [0, 0, 1, 1]
    assert [Metric("pct", value, "%", at_least=90.0).is_worse for value in (89.0, 90.0, math.nan)] == [1, 0, 1]


def test_the_result_says_what_it_was_measured_on() -> None:
    bench = Bench("example")
    bench.add("median_px", 1.5, "px", at_most=2.0)
    bench.leave_out("rival_*", ResourceError("The rival is not there.", hint="Install it."))
    result = bench.to_json()
    assert result["metrics"] == [{"name": "median_px", "value": 1.5, "unit": "px", "at_most": 2.0}]
    assert result["notes"] == ["rival_*: left out. The rival is not there. (Install it.)"]
    assert result["machine"]["cores"] >= 1
    assert "numpy" in result["versions"]


def test_run_write_and_fail_when_worse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(build_dir: Path) -> dict[str, Any]:
        bench = Bench("keypoints")
        bench.add("mediapipe_median_px", 9.0, "px", at_most=2.0)
        return bench.to_json()

    monkeypatch.setattr(keypoints, "run", measure)
    with pytest.raises(GonioError, match="keypoints: mediapipe_median_px") as caught:
        run_benches("keypoints", tmp_path, Console(quiet=True))
    assert caught.value.code == "bench-worse"
    written = json.loads((tmp_path / "bench" / "keypoints.json").read_text())
    assert written["metrics"][0]["value"] == 9.0


def test_an_unknown_bench_names_the_known_ones(tmp_path: Path) -> None:
    assert "keypoints" in list_benches()
    assert not set(list_benches()) & benches.NOT_BENCHES
    with pytest.raises(InputError, match="nonsense") as caught:
        run_benches("nonsense", tmp_path, Console(quiet=True))
    assert "keypoints" in caught.value.hint


def test_a_rival_that_fails_says_why() -> None:
    with pytest.raises(ResourceError, match="No module named 'mediapipe'"):
        run_in_peer(Path(sys.executable), "mediapipe_pose", "out.npz", "2", "10")


def test_a_video_ten_times_as_long(balancing: Path, tmp_path: Path) -> None:
    for camera in ("cam01", "cam02"):  # H.264, VP9
        keypoints.repeat_video(balancing / "videos" / f"{camera}.mp4", tmp_path / "long.mp4", times=10)
        info = probe_video(tmp_path / "long.mp4")
        assert (info.frame_count, info.rate_hz, info.is_variable_rate) == (1000, 60.0, False)
