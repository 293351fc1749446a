"""Segments that keep their lengths: what it does to the points, and what it leaves alone."""

import numpy as np
import pytest

from gonio.kernel.triangulation.segments import FEWEST_FRAMES, LEAST_SPREAD, hold_segments

FRAMES = 200
ENDS = np.array([[0, 1], [1, 2]])
"""Hip, knee, ankle; the fourth keypoint belongs to no segment."""

THIGH_M, SHANK_M = 0.42, 0.40


@pytest.fixture
def leg() -> np.ndarray:
    """A leg that swings, and a keypoint beside it, (frame, 4, 3)."""
    swing = 0.5 * np.sin(np.linspace(0, 12, FRAMES))
    hip = np.stack([np.linspace(0, 2, FRAMES), np.full(FRAMES, 0.9), np.zeros(FRAMES)], axis=-1)
    down = np.stack([np.sin(swing), -np.cos(swing), np.zeros(FRAMES)], axis=-1)
    knee = hip + THIGH_M * down
    return np.stack([hip, knee, knee + SHANK_M * down, hip + 0.3], axis=1)


def seen(leg: np.ndarray, sd_m: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points that are off by ``sd_m`` (keypoint, 3), and the covariances that say so."""
    covariance = np.broadcast_to(np.stack([np.diag(sd**2) for sd in sd_m]), (*leg.shape[:2], 3, 3)).copy()
    return leg + sd_m * np.random.default_rng(seed).normal(size=leg.shape), covariance


def test_points_come_nearer_to_the_truth_by_what_the_lengths_tell(leg: np.ndarray) -> None:
    sd_m = np.full((4, 3), 0.02)
    points, covariance = seen(leg, sd_m)
    held, held_covariance = hold_segments(points, covariance, ENDS)
    before, after = (np.sqrt(np.mean((each[:, :3] - leg[:, :3]) ** 2)) for each in (points, held))
    assert after < 0.95 * before
    length_m = np.linalg.norm(held[:, 0] - held[:, 1], axis=-1)
    assert length_m.std() / THIGH_M < LEAST_SPREAD
    assert length_m.mean() == pytest.approx(THIGH_M, rel=0.01)
    usual = np.linalg.norm(points[:, 0] - points[:, 1], axis=-1) - THIGH_M < 0.05
    assert (held_covariance[usual, 0] == covariance[usual, 0]).all()


def test_the_uncertain_end_is_moved(leg: np.ndarray) -> None:
    sd_m = np.array([[0.001] * 3, [0.001] * 3, [0.2] * 3, [0.001] * 3])
    points, covariance = seen(leg, sd_m, seed=1)
    points[:, 2] = leg[:, 2] + 0.1 * (leg[:, 2] - leg[:, 1]) / SHANK_M * np.sin(np.arange(FRAMES))[:, None]
    held, _ = hold_segments(points, covariance, ENDS, least_spread=0.005)
    assert np.abs(held[:, :2] - points[:, :2]).max() < 0.001
    assert np.linalg.norm(held[:, 2] - leg[:, 2], axis=-1).max() < 0.01


def test_both_ends_are_doubted_where_a_length_is_impossible(leg: np.ndarray) -> None:
    points, covariance = seen(leg, np.full((4, 3), 0.005))
    points[100, 2] += [0.5, 0.0, 0.0]
    _, held_covariance = hold_segments(points, covariance, ENDS)
    sd_m = np.sqrt(np.trace(held_covariance, axis1=2, axis2=3))
    assert (sd_m[100, [1, 2]] > 4 * np.median(sd_m[:, [1, 2]], axis=0)).all()
    assert sd_m[100, 0] < 2 * np.median(sd_m[:, 0])


def test_what_has_no_segment_or_no_usual_length_stays(leg: np.ndarray) -> None:
    points, covariance = seen(leg, np.full((4, 3), 0.02))
    points[30:60, 1] = np.nan
    covariance[30:60, 1] = np.nan
    held, held_covariance = hold_segments(points, covariance, ENDS)
    assert (held[:, 3] == points[:, 3]).all()
    assert (held_covariance[:, 3] == covariance[:, 3]).all()
    assert np.isnan(held[30:60, 1]).all()
    assert (held[30:60, [0, 2]] == points[30:60, [0, 2]]).all()
    points[FEWEST_FRAMES - 1 :, 1] = np.nan
    held, held_covariance = hold_segments(points, covariance, ENDS)
    np.testing.assert_array_equal(held, points)
    np.testing.assert_array_equal(held_covariance, covariance)
