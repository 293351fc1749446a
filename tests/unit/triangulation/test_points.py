import numpy as np
import pytest
from scipy.optimize import least_squares

from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.triangulation.points import CAUCHY_SCALE_M, triangulate
from gonio.kernel.triangulation.solve import SOLVED, TOO_FEW_CAMERAS
from gonio.records import Rig

RNG = np.random.default_rng(3)
POINTS = RNG.uniform([-1.0, 0.0, -1.0], [1.0, 2.0, 1.0], (300, 3))


def observe(rig: Rig, noise_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    uv = np.stack([project(camera, POINTS) for camera in rig.cameras])
    rng = np.random.default_rng(4)
    return undistort_rig(rig, uv + rng.normal(0, noise_px, uv.shape)), rng.uniform(0.5, 1.0, uv.shape[:2])


def solve(rig: Rig, uv: np.ndarray, confidence: np.ndarray, method: str = "robust"):
    return triangulate(projection_matrices(rig), focal_lengths_px(rig), uv, confidence, method=method)  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["stereo", "linear3", "linear4", "linear", "reprojection", "robust"])
def test_perfect_observations_give_the_points(rig: Rig, method: str) -> None:
    solved = solve(rig, *observe(rig), method)
    # 1 µm: the step at which the solver stops (STEP_TOLERANCE_M); the linear solution is exact to rounding.
    np.testing.assert_allclose(solved.xyz_lab_m, POINTS, atol=1e-6)
    assert (solved.status == SOLVED).all()


def test_reprojection_is_the_least_squares_minimum(rig: Rig) -> None:
    uv, confidence = observe(rig, noise_px=4.0)
    solved = solve(rig, uv, confidence, "reprojection")
    P = projection_matrices(rig)
    for i in range(0, 300, 60):

        def residual(x: np.ndarray, i: int = i) -> np.ndarray:
            homogeneous = P @ np.r_[x, 1.0]
            return (np.sqrt(confidence[:, i, None]) * (uv[:, i] - homogeneous[:, :2] / homogeneous[:, 2:])).ravel()

        oracle = least_squares(residual, POINTS[i], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(solved.xyz_lab_m[i], oracle.x, atol=2e-6)


def test_plain_rungs_count_all_cameras_alike(rig: Rig) -> None:
    uv, confidence = observe(rig, noise_px=4.0)
    ones = np.ones_like(confidence)
    for method in ("stereo", "linear3", "linear4"):
        np.testing.assert_array_equal(
            solve(rig, uv, confidence, method).xyz_lab_m, solve(rig, uv, ones, method).xyz_lab_m
        )
    assert (
        np.abs(solve(rig, uv, confidence, "linear").xyz_lab_m - solve(rig, uv, ones, "linear").xyz_lab_m).max() > 1e-4
    )


def test_robust_minimises_the_cauchy_cost(rig: Rig) -> None:
    uv, confidence = observe(rig, noise_px=4.0)
    uv[1, :, 0] += 80.0
    solved = solve(rig, uv, confidence)
    P, focal = projection_matrices(rig), focal_lengths_px(rig)
    for i in range(0, 300, 60):
        # The scale is held at the start's depth; here at the solution's, 1 % off, which moves the minimum by micrometres.
        s2 = (focal * CAUCHY_SCALE_M / (P[:, 2] @ np.r_[solved.xyz_lab_m[i], 1.0])) ** 2

        def cost(x: np.ndarray, i: int = i, s2: np.ndarray = s2) -> float:
            homogeneous = P @ np.r_[x, 1.0]
            r2 = ((uv[:, i] - homogeneous[:, :2] / homogeneous[:, 2:]) ** 2).sum(axis=1)
            return float((confidence[:, i] ** 2 * s2 * np.log1p(r2 / s2)).sum())

        best = cost(solved.xyz_lab_m[i])
        assert all(best < cost(solved.xyz_lab_m[i] + step) for step in RNG.normal(0, 1e-3, (100, 3)))


def test_two_good_cameras_outvote_two_that_disagree(rig: Rig) -> None:
    uv, confidence = observe(rig)
    uv[0] += np.array([150.0, -90.0])
    uv[3] += np.array([-70.0, 120.0])
    error = np.linalg.norm(solve(rig, uv, confidence).xyz_lab_m - POINTS, axis=1)
    # An outlier of d px keeps the pull w d / (1 + d²/s²) ≈ s²/d px (s = 6 px at 5 m): about 0.3 px, a millimetre or two.
    assert np.median(error) < 0.003
    assert np.median(np.linalg.norm(solve(rig, uv, confidence, "linear").xyz_lab_m - POINTS, axis=1)) > 0.1


def test_fewer_than_two_cameras_give_nan(rig: Rig) -> None:
    uv, confidence = observe(rig)
    confidence[1:, 0] = 0.0
    uv[:, 1] = np.nan
    uv[2:, 2] = np.inf
    solved = solve(rig, uv, confidence)
    assert np.isnan(solved.xyz_lab_m[:2]).all()
    assert (solved.status[:2] == TOO_FEW_CAMERAS).all()
    np.testing.assert_allclose(solved.xyz_lab_m[2], POINTS[2], atol=1e-6)


def test_two_parallel_rays_are_no_point(rig: Rig) -> None:
    P = np.stack([projection_matrices(rig)[0]] * 2)
    solved = triangulate(P, np.full(2, 1000.0), np.zeros((2, 1, 2)) + 400.0, np.ones((2, 1)))
    assert np.isnan(solved.xyz_lab_m).all()


def test_covariance_is_the_scatter_that_noise_causes(rig: Rig) -> None:
    uv, confidence = observe(rig, noise_px=3.0)
    solved = solve(rig, uv, np.ones_like(confidence), "reprojection")
    error = solved.xyz_lab_m - POINTS
    normalised = np.einsum("pi,pij,pj->p", error, np.linalg.inv(solved.covariance_m2), error)
    # Mean of 300 draws of chi²(3)/3 is 1 ± sqrt(2/900) = 0.05; the inflation by a point's own residuals lowers it.
    assert 0.6 < normalised.mean() / 3 < 1.15


def test_each_step_of_the_ladder_is_better_than_the_one_before(rig: Rig) -> None:
    uv, confidence = observe(rig, noise_px=6.0)
    rng = np.random.default_rng(8)
    wild = rng.random(uv.shape[:2]) < 0.05
    uv[wild] += rng.normal(0, 100, (int(wild.sum()), 2))
    error = {
        method: float(np.linalg.norm(solve(rig, uv, confidence, method).xyz_lab_m - POINTS, axis=1).mean())
        for method in ("stereo", "linear3", "linear4", "robust")
    }
    assert error["stereo"] > error["linear3"] > error["linear4"] > error["robust"]
