import cv2
import numpy as np
import pytest

from gonio.errors import InputError
from gonio.kernel.geometry.cameras import distort, nearest_point_to_axes, normalize, project, undistort
from gonio.records import Camera, Rig

POINTS = np.random.default_rng(1).uniform([-1.5, 0.0, -1.5], [1.5, 2.0, 1.5], (200, 3))


def test_projection_is_opencvs(rig: Rig) -> None:
    for camera in rig.cameras:
        T = camera.T_cam_lab
        expected, _ = cv2.projectPoints(
            POINTS, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.intrinsic_px, camera.distortion
        )
        np.testing.assert_allclose(project(camera, POINTS), expected[:, 0], atol=1e-8)


def test_normalize_undoes_projection(rig: Rig) -> None:
    camera = rig.cameras[0]
    in_camera = POINTS @ camera.T_cam_lab[:3, :3].T + camera.T_cam_lab[:3, 3]
    np.testing.assert_allclose(
        normalize(camera, project(camera, POINTS)), in_camera[:, :2] / in_camera[:, 2:], atol=1e-11
    )


def test_undistorting_without_distortion_changes_nothing(rig: Rig) -> None:
    from dataclasses import replace

    camera = replace(rig.cameras[0], distortion=np.zeros(5))
    uv = np.array([[0.0, 0.0], [1279.0, 719.0], [np.nan, 3.0]])
    np.testing.assert_allclose(undistort(camera, uv)[:2], uv[:2], atol=1e-9)
    assert np.isnan(undistort(camera, uv)[2]).all()


def test_distortion_jacobian_is_the_derivative() -> None:
    distortion = np.array([-0.28, 0.09, 0.002, -0.003, 0.01])
    xy = np.random.default_rng(2).uniform(-0.6, 0.6, (50, 2))
    _, jacobian = distort(xy, distortion)
    step = 1e-6
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = step
        slope = (distort(xy + shift, distortion)[0] - distort(xy - shift, distortion)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[..., axis], slope, atol=1e-8)  # central differences: error ~ step² = 1e-12


def test_a_folded_lens_gives_nan_never_a_wrong_point(rig: Rig) -> None:
    from dataclasses import replace

    camera = replace(rig.cameras[0], distortion=np.array([-0.9, 0.0, 0.0, 0.0, 0.0]))
    far_outside = np.array([[9000.0, 9000.0]])
    assert np.isnan(undistort(camera, far_outside)).all()


def test_points_behind_the_camera_are_nan(rig: Rig) -> None:
    camera = rig.cameras[0]
    behind = camera.centre_lab_m - camera.T_lab_cam[:3, 2]
    assert np.isnan(project(camera, behind)).all()


def test_the_middle_of_the_rig_is_where_the_axes_meet(rig: Rig) -> None:
    np.testing.assert_allclose(nearest_point_to_axes(rig), [0.0, 0.9, 0.0], atol=1e-9)


def test_a_mirror_is_no_camera_pose(rig: Rig) -> None:
    camera = rig.cameras[0]
    mirrored = camera.T_lab_cam.copy()
    mirrored[:3, 0] *= -1
    with pytest.raises(InputError, match="no rotation matrix"):
        Camera(
            name="x",
            image_size_px=camera.image_size_px,
            intrinsic_px=camera.intrinsic_px,
            distortion=camera.distortion,
            T_lab_cam=mirrored,
        )
