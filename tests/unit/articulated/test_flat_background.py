"""Step A before a floor alone: a plane tells the cameras where the focal lengths are known, or the pictures are enough."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.kernel.articulated.background import locate_pictures
from gonio.kernel.articulated.two_views import fit_homography
from gonio.kernel.virtual_lab.articulated import virtual_background, virtual_cameras
from gonio.records import Camera, LocatedPictures


def cameras_of(seed: int, pictures: int) -> tuple[Camera, ...]:
    return virtual_cameras(np.random.default_rng(seed), pictures)


def worst(truth: tuple[Camera, ...], found: LocatedPictures) -> tuple[float, float, float]:
    """Give the largest error of turn (degrees), place (metres) and focal length (share)."""
    turns, shifts, focals = [], [], []
    for a, b in zip(truth, found.cameras, strict=True):
        turns.append(Rotation.from_matrix((b.T_cam_lab @ a.T_lab_cam)[:3, :3]).magnitude())
        shifts.append(np.linalg.norm(a.centre_lab_m - b.centre_lab_m))
        focals.append(abs(b.intrinsic_px[0, 0] / a.intrinsic_px[0, 0] - 1))
    return float(np.degrees(max(turns))), float(max(shifts)), float(max(focals))


def refusal(cameras: tuple[Camera, ...], seed: int, **kind: float) -> str:
    background, _ = virtual_background(cameras, seed, tallest_m=0.0, **kind)
    with pytest.raises(CaptureError) as error:
        locate_pictures(background)
    return error.value.code


def test_exact_marks_of_a_floor_give_the_cameras_exactly() -> None:
    for pictures, known in ((3, True), (5, False)):
        cameras = cameras_of(1000, pictures)
        background, _ = virtual_background(cameras, 1000, noise_px=0.0, tallest_m=0.0, focal_known=known)
        turn, shift, focal = worst(cameras, locate_pictures(background))
        # Noise-free: what is left is the descent's last step, amplified along the valley of a plane.
        assert turn < 1e-3
        assert shift < 1e-4
        assert focal < 1e-4


def test_wrong_marks_before_a_floor_are_thrown_out_and_error_bars_hold() -> None:
    squares = []
    for seed in range(1100, 1103):
        cameras = cameras_of(seed, 4)
        background, _ = virtual_background(cameras, seed, noise_px=0.7, wrong=0.08, tallest_m=0.0, focal_known=True)
        found = locate_pictures(background)
        assert found.sigma_px == pytest.approx(0.7, rel=0.35)
        for i, (a, b) in enumerate(zip(cameras, found.cameras, strict=True)):
            moved = b.T_cam_lab @ a.T_lab_cam
            turn = Rotation.from_matrix(moved[:3, :3]).as_rotvec()
            x = np.append(turn, b.T_cam_lab[:3, 3] - moved[:3, :3] @ a.T_cam_lab[:3, 3])
            squares.append(x @ np.linalg.solve(found.covariance[16 * i : 16 * i + 6, 16 * i : 16 * i + 6], x))
    # Medians of chi-squares of six freedoms are 5.35, of three independent backgrounds; the floor has no millimetre of error.
    assert 0.6 < np.sqrt(5.348 / np.median(squares)) < 2.0


def test_unknown_focal_lengths_are_found_before_a_nearly_flat_background_with_wrong_marks() -> None:
    cameras = cameras_of(1102, 5)
    background, _ = virtual_background(cameras, 1102, noise_px=0.3, wrong=0.08, tallest_m=0.03)
    found = locate_pictures(background)
    turn, shift, focal = worst(cameras, found)
    assert turn < 1.0
    assert shift < 0.05
    assert focal < 0.05


def test_pictures_beyond_the_first_ones_are_resected_from_the_plane() -> None:
    cameras = cameras_of(1003, 7)
    background, _ = virtual_background(cameras, 1003, noise_px=0.3, tallest_m=0.0, focal_known=True)
    turn, shift, _ = worst(cameras, locate_pictures(background))
    assert turn < 0.5
    assert shift < 0.03


def test_what_a_plane_does_not_tell_is_refused_by_name() -> None:
    # Two pictures: a homography has two poses, and in this one both have the floor before the camera.
    assert refusal(cameras_of(1002, 2), 1002, focal_known=True) == "background-two-answers"
    # Three unknown focal lengths: two homographies of eight numbers for 14 unknowns of the cameras and three of the plane.
    assert refusal(cameras_of(1001, 3), 1001) == "background-not-observable"


def test_a_camera_that_only_turned_is_no_camera_before_a_plane() -> None:
    first = cameras_of(3, 1)[0]
    rng = np.random.default_rng(3)
    turned = []
    for i in range(4):
        T = first.T_lab_cam.copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.08, 3)).as_matrix()
        turned.append(replace(first, name=f"picture {i + 1}", T_lab_cam=T))
    for known in (True, False):
        assert refusal(tuple(turned), 3, focal_known=known, wrong=0.08) == "background-camera-static"


def test_a_homography_is_found_among_wrong_matches() -> None:
    rng = np.random.default_rng(0)
    H = np.array([[1.1, 0.2, 30.0], [-0.1, 0.9, -20.0], [2e-4, -3e-4, 1.0]])
    x = rng.uniform(-300, 300, (40, 2))
    y = np.column_stack([x, np.ones(40)]) @ H.T
    uv = y[:, :2] / y[:, 2:]
    uv[:12] += rng.uniform(20, 60, (12, 2))
    found, fits = fit_homography(x, uv, 0)
    assert not fits[:12].any()
    assert fits[12:].all()
    np.testing.assert_allclose(found / found[2, 2], H, rtol=1e-6)
