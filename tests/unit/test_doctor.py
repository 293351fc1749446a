"""The self-test: right where gonio is right, and able to fail."""

import pytest

from gonio import doctor
from gonio.demo import virtual


def test_the_self_test_passes_and_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    found = doctor._self_test()
    assert found.good, found.state
    assert "virtual walk" in found.state
    monkeypatch.setattr(doctor, "LARGEST_KNEE_RMS_DEG", 0.01)
    assert not doctor._self_test().good

    def breaks(*_: object, **__: object) -> None:
        raise ValueError("no such number")

    monkeypatch.setattr(virtual, "film", breaks)
    broken = doctor._self_test()
    assert not broken.good
    assert "no such number" in broken.state
