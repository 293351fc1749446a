from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.kernel.calibration.bundle import adjust_poses, pose_jacobians
from gonio.kernel.calibration.person import refine_on_person
from gonio.kernel.geometry.cameras import focal_lengths_px, project, projection_matrices, undistort_rig
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.triangulation.points import triangulate
from gonio.records import ImagePoints, Rig, Timebase

RATE_HZ, FRAMES, KEYPOINTS = 60.0, 240, 17


def walker(seed: int) -> np.ndarray:
    """Points on a body of 0.5 × 1.7 × 0.5 m that walks three metres: (frame, keypoint, 3)."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([-0.25, 0.05, -0.25], [0.25, 1.75, 0.25], (KEYPOINTS, 3))
    path = np.linspace([-1.5, 0, 0.2], [1.5, 0, -0.2], FRAMES)
    return path[:, None] + body + 0.1 * np.sin(np.arange(FRAMES)[:, None, None] / 9.0 + body * 20)


def film(rig: Rig, points: np.ndarray, noise_px: float, seed: int) -> ImagePoints:
    rng = np.random.default_rng(seed)
    uv = np.stack([project(camera, points) for camera in rig.cameras])
    uv = uv + rng.normal(0, noise_px, uv.shape)
    return ImagePoints(
        camera_names=rig.names,
        keypoint_names=tuple(f"k{i}" for i in range(points.shape[1])),
        timebase=Timebase(rate_hz=RATE_HZ),
        uv_px=uv,
        confidence=np.ones(uv.shape[:3]),
    )


def knocked(rig: Rig, camera: int, turn_deg: float, move_m: float) -> Rig:
    """The rig as its calibration says, while in truth one camera has been knocked: turned and moved in its own frame."""
    R = Rotation.from_rotvec(np.deg2rad(turn_deg) * np.array([0.6, 0.8, 0.0])).as_matrix()
    T = rig.cameras[camera].T_lab_cam @ transform(R, np.array([move_m, 0.0, 0.0]))
    return replace(rig, cameras=tuple(replace(c, T_lab_cam=T) if i == camera else c for i, c in enumerate(rig.cameras)))


def test_jacobians_are_the_derivatives(rig: Rig) -> None:
    points = walker(1)[0]
    Ts = np.stack([c.T_cam_lab for c in rig.cameras])
    Ks = np.stack([c.intrinsic_px for c in rig.cameras])

    def projected(Ts: np.ndarray, points: np.ndarray) -> np.ndarray:
        xyz = np.einsum("cij,pj->cpi", Ts[:, :3, :3], points) + Ts[:, None, :3, 3]
        homogeneous = np.einsum("cij,cpj->cpi", Ks, xyz)
        return homogeneous[..., :2] / homogeneous[..., 2:]

    to_pose, to_point = pose_jacobians(Ts, Ks, points)
    step = 1e-6  # central differences: error ~ step² · f; rounding ~ 1e-16 · 1000 px / step
    for axis in range(6):
        delta = np.zeros(6)
        delta[axis] = step
        forth, back = (
            np.stack([transform(Rotation.from_rotvec(s * delta[:3]).as_matrix(), s * delta[3:]) @ T for T in Ts])
            for s in (1, -1)
        )
        slope = (projected(forth, points) - projected(back, points)) / (2 * step)
        np.testing.assert_allclose(to_pose[..., axis], slope, rtol=1e-5, atol=1e-3)
    for axis in range(3):
        delta = np.zeros(3)
        delta[axis] = step
        slope = (projected(Ts, points + delta) - projected(Ts, points - delta)) / (2 * step)
        np.testing.assert_allclose(to_point[..., axis], slope, rtol=1e-5, atol=1e-3)


def test_a_right_calibration_stays(rig: Rig) -> None:
    refinement = refine_on_person(rig, film(rig, walker(2), 4.0, 3), 0.5)
    assert not refinement.kept
    assert refinement.rig is rig


@pytest.mark.parametrize(("turn_deg", "move_m"), [(1.0, 0.0), (0.0, 0.04), (0.7, 0.05)])
def test_a_knocked_camera_is_found_and_put_right(rig: Rig, turn_deg: float, move_m: float) -> None:
    truth = knocked(rig, 2, turn_deg, move_m)
    refinement = refine_on_person(rig, film(truth, walker(4), 4.0, 5), 0.5)
    assert refinement.kept
    assert refinement.error_after_px < refinement.error_before_px
    assert int(np.argmax(refinement.turned_rad + refinement.moved_m)) == 2
    # With noise of 4 px per axis and four cameras, the mean length of what is left after fitting a point (3 of 8 degrees
    # of freedom) is 4 · sqrt(π/2) · sqrt(5/8) = 3.96 px; 3 % more for the refinement's own error.
    assert refinement.error_after_px < 3.96 * 1.03


def bending_mm(used: Rig, truth: Rig, points: np.ndarray) -> float:
    """How far points are off that ``truth`` films without noise and ``used`` triangulates, but for a common turn and shift:
    the frame itself is held by the prior alone."""
    uv = undistort_rig(used, film(truth, points, 0.0, 0).uv_px).reshape(4, -1, 2)
    solved = triangulate(
        projection_matrices(used), focal_lengths_px(used), uv, np.ones(uv.shape[:2]), method="reprojection"
    ).xyz_lab_m
    there, here = solved - solved.mean(axis=0), points.reshape(-1, 3) - points.mean(axis=(0, 1))
    turned = Rotation.align_vectors(here, there)[0].apply(there)
    return 1e3 * float(np.linalg.norm(turned - here, axis=-1).mean())


def test_the_correction_is_unbiased_where_points_are(rig: Rig) -> None:
    truth, points = knocked(rig, 1, 1.0, 0.03), walker(6)
    refined = refine_on_person(rig, film(truth, points, 4.0, 7), 0.5).rig
    # 40 sampled frames × 17 points with 4 px (20 mm at 5 m): 20 mm / sqrt(680) = 0.8 mm a camera; the prior's pull and
    # the scale, which nothing measures but the other cameras' distances, leave a few times that.
    assert bending_mm(rig, truth, points) > 7
    assert bending_mm(refined, truth, points) < 3


def test_two_cameras_or_a_moment_prove_nothing(rig: Rig) -> None:
    two = replace(rig, cameras=rig.cameras[:2])
    assert not refine_on_person(two, film(knocked(two, 1, 1.0, 0.0), walker(8), 2.0, 9), 0.5).kept
    short = film(knocked(rig, 1, 1.0, 0.0), walker(8)[:20], 2.0, 9)
    assert not refine_on_person(rig, short, 0.5).kept


def test_outliers_do_not_move_the_cameras(rig: Rig) -> None:
    points = walker(10)
    filmed = film(rig, points, 2.0, 11)
    uv = filmed.uv_px.copy()
    rng = np.random.default_rng(12)
    wild = rng.random(uv.shape[:3]) < 0.1
    uv[wild] += rng.normal(0, 120, (int(wild.sum()), 2))
    sample = undistort_rig(rig, uv[:, ::6]).reshape(4, -1, 2)
    bundle = adjust_poses(rig, sample, np.ones(sample.shape[:2]), sigma_px=8.0, scale_m=0.06)
    assert bundle.converged
    assert bending_mm(bundle.rig, rig, points) < 4  # as without outliers
