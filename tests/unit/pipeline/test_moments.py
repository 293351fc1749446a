"""Findings know the moment that they speak of."""

import numpy as np
import pytest

from gonio.pipeline.describe import describe_finding
from gonio.pipeline.findings import finding
from gonio.pipeline.moments import longest_stretch, worst_moment
from gonio.pipeline.reconstruction import judge_gaps
from gonio.pipeline.report_page import moment
from gonio.records import MEASURED, MISSING, LabPoints, Timebase

TIMES_S = 10.0 + np.arange(8) / 2


@pytest.mark.parametrize(
    ("pattern", "span_s"),
    [("........", None), ("x..xx...", (11.5, 12.0)), ("......x.", (13.0, 13.0)), ("xxxxxxxx", (10.0, 13.5))],
)
def test_the_longest_of_several_stretches_is_the_one_to_look_at(
    pattern: str, span_s: tuple[float, float] | None
) -> None:
    assert longest_stretch(np.array([mark == "x" for mark in pattern]), TIMES_S) == span_s


def test_the_worst_moment_is_the_largest_known_value() -> None:
    assert worst_moment(np.array([np.nan, 1.0, 3.0, np.nan, 2.0, 0.0, 0.0, 0.0]), TIMES_S) == (11.0, 11.0)
    assert worst_moment(np.full(8, np.nan), TIMES_S) is None


def test_a_knee_that_was_hidden_leads_to_when_it_was_hidden() -> None:
    frames, names = 60, tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle"))
    xyz = np.zeros((frames, len(names), 3))
    xyz[30:48, 1] = np.nan  # of the right knee
    hidden = np.isnan(xyz[..., 0])
    points = LabPoints(
        camera_names=("a", "b"),
        keypoint_names=names,
        timebase=Timebase(rate_hz=60.0, start_s=2.0),
        xyz_lab_m=xyz,
        origin=np.where(hidden, MISSING, MEASURED).astype(np.uint8),
        covariance_m2=np.where(hidden[..., None, None], np.nan, np.broadcast_to(np.eye(3), (*hidden.shape, 3, 3))),
        residual_px=np.zeros((2, frames, len(names), 2)),
    )
    (said,) = (one for one in judge_gaps(points) if one.code == "keypoint-missing")
    assert (said.where, said.joint, said.camera) == ("right knee", "right knee", "")
    assert said.span_s == pytest.approx((2.5, 2.0 + 47 / 60))


@pytest.mark.parametrize(
    ("span_s", "words"), [(None, ""), ((2.41, 2.43), "at 2.4 s"), ((2.4, 3.39), "from 2.4 s to 3.4 s")]
)
def test_the_printed_page_says_when(span_s: tuple[float, float] | None, words: str) -> None:
    said = finding("camera-lost-subject", camera="south", value=12.0, span_s=span_s)
    assert (said.where, said.camera) == ("south", "south")
    told = describe_finding(said)
    assert (told.start_s, told.end_s) == (span_s or (None, None))
    assert moment(told) == words
