import pytest

from gonio import errors
from gonio.errors import CaptureError, GonioError, InputError, ResourceError, SolverError
from gonio.jobs.failure import describe, revive


class TooFewViews(CaptureError):
    code = "too-few-views"


@pytest.mark.parametrize("kind", [GonioError, InputError, CaptureError, SolverError, ResourceError])
def test_an_error_comes_back_as_it_was(kind):
    error = kind("Message.", hint="Hint.", code="a-code", frames=3, where=["cam01"])
    back = revive(describe(error))
    assert type(back) is kind
    assert describe(back) == describe(error)


def test_an_error_of_another_room_comes_back_as_its_class_in_the_tree():
    back = revive(describe(TooFewViews("Message.", hint="Hint.")))
    assert type(back) is CaptureError
    assert back.code == "too-few-views"


def test_cancelled_comes_back():
    assert isinstance(revive(describe(errors.Cancelled())), errors.Cancelled)


def test_details_that_are_no_json_stay_behind():
    error = SolverError("Message.", hint="Hint.", report=object(), cost=float("nan"), iterations=7)
    assert describe(error)["details"] == {"iterations": 7}


def test_a_bug_is_told_by_a_reference_alone_and_logged_once(caplog):
    problem = describe(RuntimeError("secret"))
    assert "secret" not in str(problem)
    assert problem["details"]["reference"] in caplog.text
    assert "secret" in caplog.text
    assert describe(revive(problem)) == problem
    assert caplog.text.count("Traceback") <= 1
