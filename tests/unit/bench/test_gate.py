import json
from pathlib import Path

import pytest
from rich.console import Console

from gonio.bench import Metric
from gonio.bench.gate import check, compare_run, is_held, tolerance
from gonio.errors import GonioError, InputError

KNEE = Metric("knee_deg", 1.5, "deg", at_most=2.5)
FOUND = Metric("found_pct", 98.0, "%", at_least=90.0)
LOST = Metric("jobs lost", 0.0, "", at_most=0.0)


def write(folder: Path, *metrics: Metric) -> None:
    folder.mkdir(exist_ok=True)
    content = {"bench": "walks", "metrics": [{k: v for k, v in vars(m).items() if v is not None} for m in metrics]}
    (folder / "walks.json").write_text(json.dumps(content))


def test_accuracy_with_a_better_side_is_held_and_speed_is_not() -> None:
    assert [is_held(m) for m in (KNEE, FOUND, LOST)] == [True] * 3
    assert not is_held(Metric("free", 1.0, "mm"))
    assert not is_held(Metric("coverage95_pct", 95.0, "%", at_most=98.0, at_least=92.0))
    assert not is_held(Metric("solver_ratio_opensim", 300.0, "1", at_least=250.0))
    assert not is_held(Metric("peak_rss_growth", 1.0, "1", at_most=1.1))
    assert not is_held(Metric("whole", 7.0, "s", at_most=9.0))


def test_a_tolerance_is_a_tenth_of_the_value_or_a_twentieth_of_the_bound() -> None:
    assert tolerance(KNEE) == pytest.approx(0.15)  # 0.1 · 1.5 against 0.05 · 2.5 = 0.125
    assert tolerance(Metric("tiny", 1e-9, "Nm", at_most=1e-3)) == pytest.approx(5e-5)
    assert tolerance(LOST) == 0.0


@pytest.mark.parametrize(
    ("baseline", "value", "lines"),
    [
        (KNEE, 1.64, 0),
        (KNEE, 1.66, 1),
        (KNEE, 0.2, 0),
        (KNEE, float("nan"), 1),
        (FOUND, 88.3, 0),  # 9.8 less are allowed
        (FOUND, 88.1, 1),
        (LOST, 0.0, 0),
        (LOST, 1.0, 1),
    ],
)
def test_worse_means_beyond_the_tolerance_on_the_bad_side(baseline: Metric, value: float, lines: int) -> None:
    assert len(compare_run([Metric(baseline.name, value, baseline.unit)], [baseline])) == lines


def test_a_metric_that_is_gone_does_not_pass() -> None:
    assert compare_run([], [KNEE]) == ["knee_deg: not measured; the baseline has 1.5 deg"]


def test_the_gate_says_what_got_worse_and_what_to_do(tmp_path: Path) -> None:
    runs, baselines = tmp_path / "bench", tmp_path / "baseline"
    write(baselines, KNEE, FOUND)
    write(runs, KNEE, FOUND)
    console = Console(record=True, width=200)
    check("", runs, baselines, console)
    assert "walks: 2 of 2 accuracy metrics as good as the baseline" in console.export_text()
    write(runs, Metric("knee_deg", 2.0, "deg", at_most=2.5), FOUND)
    with pytest.raises(GonioError) as caught:
        check("walks", runs, baselines, console)
    assert caught.value.code == "bench-worse"
    assert "walks: knee_deg: 2 deg, 0.5 worse than the baseline's 1.5 (allowed: 0.15)" in caught.value.message


@pytest.mark.parametrize(("made", "code"), [("nothing", "bench-not-run"), ("run", "bench-no-baseline")])
def test_nothing_to_compare_is_an_error(tmp_path: Path, made: str, code: str) -> None:
    if made == "run":
        write(tmp_path / "bench", KNEE)
    with pytest.raises(InputError) as caught:
        check("", tmp_path / "bench", tmp_path / "baseline", Console())
    assert caught.value.code == code


def test_a_broken_result_is_named(tmp_path: Path) -> None:
    for folder in (tmp_path / "bench", tmp_path / "baseline"):
        write(folder, KNEE)
    (tmp_path / "baseline" / "walks.json").write_text("{")
    with pytest.raises(InputError, match=r"walks\.json"):
        check("", tmp_path / "bench", tmp_path / "baseline", Console())
