import numpy as np

from gonio.kernel.kinematics.resample import resample
from gonio.records import SOLVED, TOO_FEW_MARKERS, Motion


def motion(times_s: np.ndarray, values: np.ndarray) -> Motion:
    frames = len(times_s)
    return Motion(
        coordinate_names=("angle",),
        rotational=np.array([True]),
        times_s=times_s,
        values=values[:, None],
        status=np.where(np.isnan(values), TOO_FEW_MARKERS, SOLVED).astype(np.uint8),
        iterations=np.ones(frames, dtype=int),
        residual_rms_m=np.zeros(frames),
        covariance=np.where(np.isnan(values), np.nan, 1.0 + np.arange(frames))[:, None, None],
    )


def test_movement_without_jerk_is_interpolated_and_continued_exactly() -> None:
    coarse, fine = np.arange(20) / 30, np.arange(40) / 60  # the last moment lies beyond the coarse ones
    found = resample(motion(coarse, 1 + 2 * coarse - 3 * coarse**2), fine)
    np.testing.assert_allclose(found.values[:, 0], 1 + 2 * fine - 3 * fine**2, atol=1e-9)
    np.testing.assert_array_equal(found.status, SOLVED)


def test_a_gait_is_interpolated_far_below_the_error_of_a_keypoint() -> None:
    coarse, fine = np.arange(60) / 30, np.arange(119) / 60
    flexion = lambda t: np.deg2rad(30 + 25 * np.cos(2 * np.pi * t) + 8 * np.cos(8 * np.pi * t + 1))  # noqa: E731 - one formula
    found = resample(motion(coarse, flexion(coarse)), fine)
    assert np.degrees(np.abs(found.values[:, 0] - flexion(fine)).max()) < 0.2


def test_nothing_is_invented_in_a_gap() -> None:
    coarse = np.arange(10) / 30
    values = np.where(np.isin(np.arange(10), (4, 5)), np.nan, coarse)
    found = resample(motion(coarse, values), np.arange(19) / 60)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found.values[:, 0])), np.arange(7, 12))
    np.testing.assert_array_equal(np.flatnonzero(found.status == TOO_FEW_MARKERS), np.arange(7, 12))
    assert found.covariance is not None
    np.testing.assert_array_equal(np.isnan(found.covariance[:, 0, 0]), np.isnan(found.values[:, 0]))
    np.testing.assert_allclose(found.covariance[[0, 1, 2], 0, 0], [1.0, 1.5, 2.0])


def test_the_same_moments_give_the_same_motion() -> None:
    times_s = 0.4 + np.arange(13) / 60
    given = motion(times_s, np.random.default_rng(0).normal(size=13))
    found = resample(given, times_s)
    np.testing.assert_allclose(found.values, given.values, atol=1e-12)
    np.testing.assert_array_equal(found.covariance, given.covariance)


def test_the_covariances_of_a_long_trial_are_those_of_its_frames() -> None:
    coarse, fine = np.arange(1500) / 30, np.arange(2999) / 60  # several blocks
    found = resample(motion(coarse, coarse), fine)
    assert found.covariance is not None
    np.testing.assert_allclose(
        found.covariance[:, 0, 0], 1.0 + np.arange(2999) / 2, rtol=1e-5
    )  # shares are rounded to 1e-6
