"""Virtual cameras: where they stand, how a calibration misses them, when they take their frames."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.kernel.geometry.cameras import nearest_point_to_axes, project
from gonio.kernel.virtual_lab import CalibrationErrors, Clocks, make_rig, miscalibrate
from gonio.kernel.virtual_lab.rig import camera_times_s
from gonio.records import Timebase


def test_the_default_rig_stands_in_the_corners_of_a_square_of_seven_metres():
    rig = make_rig()
    centres = np.array([camera.centre_lab_m for camera in rig.cameras])
    np.testing.assert_allclose(np.abs(centres), np.tile([3.5, 2.4, 3.5], (4, 1)), atol=1e-9)
    np.testing.assert_allclose(nearest_point_to_axes(rig), [0.0, 0.9, 0.0], atol=1e-9)
    for camera in rig.cameras:
        head, feet = project(camera, np.array([[0.0, 1.8, 0.0], [0.0, 0.0, 0.0]]))
        assert head[1] < feet[1]  # upright
        assert camera.image_size_px == (720, 540)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_any_number_of_cameras_on_a_ring(count):
    rig = make_rig(count, radius_m=5.0, height_m=1.5, image_size_px=(1920, 1080), focal_px=1400.0)
    assert len(rig.cameras) == count
    for camera in rig.cameras:
        assert np.hypot(*camera.centre_lab_m[[0, 2]]) == pytest.approx(5.0)
        np.testing.assert_allclose(project(camera, np.array([0.0, 0.9, 0.0])), [959.5, 539.5], atol=1e-9)


def test_no_camera_is_no_rig():
    with pytest.raises(InputError, match="no rig"):
        make_rig(0)


def test_calibration_errors_have_the_stated_size():
    rig = make_rig(200)
    errors = CalibrationErrors(rotation_rad=0.01, translation_m=0.004, focal=0.005)
    wrong = miscalibrate(rig, errors, seed=1)
    pairs = list(zip(rig.cameras, wrong.cameras, strict=True))
    turns = [Rotation.from_matrix(a.T_lab_cam[:3, :3].T @ b.T_lab_cam[:3, :3]).as_rotvec() for a, b in pairs]
    moves = [a.centre_lab_m - b.centre_lab_m for a, b in pairs]
    focal = [b.intrinsic_px[0, 0] / a.intrinsic_px[0, 0] - 1 for a, b in pairs]
    # 600 (focal 200) draws know their standard deviation to 3 (5) %: four times that is allowed.
    assert np.std(turns) == pytest.approx(0.01, rel=0.12)
    assert np.std(moves) == pytest.approx(0.004, rel=0.12)
    assert np.std(focal) == pytest.approx(0.005, rel=0.2)


def test_without_errors_a_calibration_is_the_rig():
    rig = make_rig()
    again = miscalibrate(rig, CalibrationErrors(), seed=1)
    for camera, copy in zip(rig.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(camera.T_lab_cam, copy.T_lab_cam)


def test_clocks_run_late_and_drift_against_the_first_camera():
    times = camera_times_s(Timebase(rate_hz=100.0), 1001, 4, Clocks(delay_s=0.02, drift=1e-3), seed=5)
    np.testing.assert_array_equal(times[0], np.arange(1001) / 100.0)
    assert np.all(np.abs(times[1:, 0]) > 0)
    rates = (times[:, -1] - times[:, 0]) / 10.0
    assert rates[0] == 1.0
    assert np.all(np.abs(rates[1:] - 1.0) > 0)
    assert np.all(np.abs(rates - 1.0) < 5e-3)
