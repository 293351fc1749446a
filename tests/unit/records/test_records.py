from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from gonio.errors import InputError
from gonio.records import ImagePoints, Timebase


def points(**change: object) -> ImagePoints:
    fields = {
        "camera_names": ("a", "b"),
        "keypoint_names": ("knee",),
        "timebase": Timebase(rate_hz=60.0),
        "uv_px": np.zeros((2, 5, 1, 2)),
        "confidence": np.ones((2, 5, 1)),
    }
    return ImagePoints(**(fields | change))  # type: ignore[arg-type]


def test_a_mismatch_of_two_fields_names_the_field_and_the_shape() -> None:
    with pytest.raises(TypeCheckError, match=r"confidence.*\n.*2,4,1"):
        points(confidence=np.ones((2, 4, 1)))


def test_arrays_are_copied_and_read_only() -> None:
    mine = np.zeros((2, 5, 1, 2))
    record = points(uv_px=mine)
    mine[:] = 7.0  # the caller's array stays the caller's
    assert record.uv_px.max() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record.uv_px[0] = 1.0


def test_missing_points_have_no_confidence() -> None:
    with pytest.raises(InputError, match="has a confidence"):
        points(uv_px=np.full((2, 5, 1, 2), np.nan))


def test_names_are_counted() -> None:
    with pytest.raises(InputError, match="2 cameras and 2 keypoints are named"):
        points(keypoint_names=("knee", "hip"))


@pytest.mark.parametrize("rate_hz", [0.0, -60.0, float("nan"), float("inf")])
def test_impossible_rates(rate_hz: float) -> None:
    with pytest.raises(InputError, match="impossible"):
        Timebase(rate_hz=rate_hz)


def test_records_share_what_cannot_change() -> None:
    first = points()
    assert replace(first, confidence=np.full((2, 5, 1), 0.5)).uv_px is first.uv_px


def test_a_view_is_copied_though_it_is_read_only() -> None:
    mine = np.zeros((2, 5, 1, 2))
    view = mine.view()
    view.setflags(write=False)
    record = points(uv_px=view)
    mine[:] = 7.0
    assert record.uv_px.max() == 0.0
