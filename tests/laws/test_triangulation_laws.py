"""What must not change a triangulation, changes nothing."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import apply, rotation_about_y, transform
from gonio.kernel.triangulation.points import triangulate
from gonio.records import Rig

seeds = st.integers(0, 2**32 - 1)


def scene(rig: Rig, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, 0, -1], [1, 2, 1], (20, 3))
    uv = np.stack([project(camera, points) for camera in rig.cameras])
    uv += rng.normal(0, 3, uv.shape)
    uv[rng.integers(0, 4, 4), rng.integers(0, 20, 4)] += 200.0
    return undistort_rig(rig, uv), rng.uniform(0.1, 1, uv.shape[:2])


def solve(rig: Rig, uv: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    return triangulate(projection_matrices(rig), focal_lengths_px(rig), uv, confidence).xyz_lab_m


@settings(max_examples=25, deadline=None)
@given(seed=seeds, order=st.permutations(range(4)))
def test_the_order_of_the_cameras_does_not_matter(rig: Rig, seed: int, order: list[int]) -> None:
    uv, confidence = scene(rig, seed)
    shuffled = replace(rig, cameras=tuple(rig.cameras[i] for i in order))
    np.testing.assert_allclose(solve(shuffled, uv[order], confidence[order]), solve(rig, uv, confidence), atol=2e-5)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, angle=st.floats(-3.1, 3.1), x=st.floats(-5, 5), z=st.floats(-5, 5))
def test_moving_the_world_moves_the_points_with_it(rig: Rig, seed: int, angle: float, x: float, z: float) -> None:
    uv, confidence = scene(rig, seed)
    T = transform(rotation_about_y(angle), np.array([x, 0.3, z]))
    moved = replace(rig, cameras=tuple(replace(c, T_lab_cam=T @ c.T_lab_cam) for c in rig.cameras))
    # 20 µm: twice the step at which each of the two solutions stops, times the slow last steps beside an outlier.
    np.testing.assert_allclose(solve(moved, uv, confidence), apply(T, solve(rig, uv, confidence)), atol=2e-5)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, factor=st.floats(0.01, 100))
def test_only_the_ratio_of_confidences_matters(rig: Rig, seed: int, factor: float) -> None:
    uv, confidence = scene(rig, seed)
    np.testing.assert_allclose(solve(rig, uv, confidence * factor), solve(rig, uv, confidence), atol=2e-5)
