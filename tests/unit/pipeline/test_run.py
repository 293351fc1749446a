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


def test_remaining_time_at_an_even_pace_is_exact_and_settles_first():
    clock = Clock()
    estimate = Estimate({"only": 1.0}, clock)
    assert estimate.at("only", 0.0)[1] is None
    for second in range(1, 40):
        clock.now_s = second
        remaining_s = estimate.at("only", second / 40)[1]
        assert remaining_s is None if second < 3 else remaining_s == pytest.approx(40 - second)


def test_remaining_time_follows_a_change_of_pace_without_a_jump():
    clock = Clock()
    estimate = Estimate({"only": 1.0}, clock)
    fraction, last_s = 0.0, None
    for second in range(1, 30):
        clock.now_s = second
        fraction += 0.04 if second <= 10 else 0.01
        remaining_s = estimate.at("only", fraction)[1]
        if last_s is not None:
            # smoothing takes 1 s of 5 s of the difference to the new raw estimate, which grows by at most 3 s a second
            assert abs(remaining_s - last_s) < 4
        last_s = remaining_s


def test_stages_taken_from_the_store_tell_nothing_about_the_pace():
    clock = Clock()
    estimate = Estimate({"a": 0.9, "b": 0.1}, clock)
    clock.now_s = 1.0
    estimate.take("a")
    clock.now_s = 5.0
    fraction, remaining_s = estimate.at("b", 0.5)
    assert fraction == pytest.approx(0.95)
    assert remaining_s == pytest.approx(4.0)
