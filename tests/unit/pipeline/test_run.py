import pytest

from gonio.errors import Cancelled
from gonio.pipeline.run import STAGE_SHARES, Estimate, LocalRunner, Outcome
from gonio.records import Finding

FINDING = Finding(code="c", severity="info", stage="b", message="m", hint="h")
SHARES = {"a": 1.0, "b": 3.0, "c": 1.0}


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_the_shares_of_the_stages_are_a_whole():
    assert sum(STAGE_SHARES.values()) == pytest.approx(1.0)


def test_local_runner_gives_values_findings_and_progress():
    heard: list[tuple[str, float]] = []
    runner = LocalRunner(lambda stage, fraction, _: heard.append((stage, round(fraction, 3))), SHARES)

    def work(progress):
        progress(0.5)
        return Outcome(2, (FINDING,))

    assert runner("a", lambda progress: Outcome(1)) == 1
    assert runner("b", work) == 2
    assert runner.findings == (FINDING,)
    assert heard == [("a", 0.0), ("a", 0.2), ("b", 0.2), ("b", 0.5), ("b", 0.8)]
    assert set(runner.seconds) == {"a", "b"}


def test_a_callback_that_raises_stops_the_run():
    def cancel(*_):
        raise Cancelled

    with pytest.raises(Cancelled):
        LocalRunner(cancel)("a", lambda progress: Outcome(1))


def test_a_stage_left_out_counts_as_passed_and_an_unknown_one_stands_still():
    estimate = Estimate(SHARES, Clock())
    assert estimate.at("c", 0.0)[0] == pytest.approx(0.8)
    assert estimate.at("unknown", 1.0)[0] == pytest.approx(0.8)
    assert estimate.at("a", 0.0)[0] == pytest.approx(0.8)


def test_remaining_time_at_an_even_pace_is_exact_once_it_has_settled():
    clock = Clock()
    estimate = Estimate({"only": 1.0}, clock)
    assert estimate.at("only", 0.0)[1] is None
    for second in range(1, 40):
        clock.now_s = second
        remaining_s = estimate.at("only", second / 40)[1]
        # The pace is measured from the first progress, at 1 s, and believed 3 s later.
        assert remaining_s is None if second < 4 else remaining_s == pytest.approx(40 - second)


def test_the_time_before_a_stages_first_progress_does_not_count():
    clock = Clock()
    estimate = Estimate({"only": 1.0}, clock)
    estimate.at("only", 0.0)
    for second in range(20, 30):  # 20 s of loading, then 10 % a second
        clock.now_s = second
        remaining_s = estimate.at("only", (second - 19) / 10)[1]
    assert remaining_s == pytest.approx(0.0)
    clock.now_s = 23
    estimate = Estimate({"only": 1.0}, clock)
    for second in range(43, 47):
        clock.now_s = second
        remaining_s = estimate.at("only", (second - 42) / 10)[1]
    assert remaining_s == pytest.approx(6.0)


def test_remaining_time_follows_a_change_of_pace_without_a_jump():
    clock = Clock()
    estimate = Estimate({"only": 1.0}, clock)
    fraction, last_s = 0.0, None
    for second in range(1, 30):
        clock.now_s = second
        fraction += 0.04 if second <= 10 else 0.01
        remaining_s = estimate.at("only", fraction)[1]
        if last_s is not None:
            # Smoothing takes 1 s of 5 s of the difference to the measured time, which grows by at most 3 s a second.
            assert abs(remaining_s - last_s) < 4
        last_s = remaining_s


def test_remaining_time_runs_on_through_a_stage_that_tells_nothing():
    clock = Clock()
    estimate = Estimate({"a": 0.5, "b": 0.5}, clock)
    for second in range(1, 6):
        clock.now_s = second
        before_s = estimate.at("a", second / 10)[1]
    clock.now_s = 7.0
    after_s = estimate.at("b", 0.0)[1]
    assert after_s == pytest.approx(before_s - 2.0)


def test_stages_taken_from_the_store_move_the_bar_alone():
    clock = Clock()
    estimate = Estimate({"a": 0.9, "b": 0.1}, clock)
    estimate.take("a")
    for second in range(1, 6):
        clock.now_s = second
        fraction, remaining_s = estimate.at("b", second / 10)
    assert fraction == pytest.approx(0.95)
    assert remaining_s == pytest.approx(5.0)
