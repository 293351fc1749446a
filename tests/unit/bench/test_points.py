"""What the bench `reconstruction` does to recordings before anybody is measured on them."""

import numpy as np

from gonio.bench.points.balancing import _delayed
from gonio.bench.points.rates import _distances_m
from gonio.bench.points.speed import _repeat_walk


def test_a_late_camera_shows_what_was() -> None:
    _, points = _repeat_walk(40)
    late = _delayed(points, (0, 3, -2, 0))
    np.testing.assert_array_equal(late.uv_px[1, 3:], points.uv_px[1, :-3])
    np.testing.assert_array_equal(late.uv_px[2, :-2], points.uv_px[2, 2:])
    assert np.isnan(late.uv_px[1, :3]).all()
    halved = _delayed(points, (0, 1, 0, 0), keep=2)
    assert halved.timebase.rate_hz == points.timebase.rate_hz / 2
    np.testing.assert_array_equal(halved.uv_px[1, 1:], points.uv_px[1, 1:-1:2])


def test_a_long_walk_does_not_jump() -> None:
    _, points = _repeat_walk(400)
    steps = np.linalg.norm(np.diff(points.uv_px, axis=1), axis=-1)
    there = np.linalg.norm(np.diff(_repeat_walk(180)[1].uv_px, axis=1), axis=-1)
    assert np.nanmax(steps) == np.nanmax(there)


def test_a_turned_lab_is_no_error() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(20, 5, 3))
    turned = xyz @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) + [1.0, 2.0, 3.0]
    moved = turned.copy()
    moved[3, 2] += [0.0, 0.1, 0.0]
    moved[0, 0] = np.nan
    assert np.nanmax(_distances_m(turned, xyz)) < 1e-12
    away = _distances_m(moved, xyz)
    assert np.isnan(away[0, 0])
    np.testing.assert_allclose(away[3, 2], 0.1, atol=0.005)
