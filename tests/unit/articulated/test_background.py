"""Step A: a still background tells the cameras; what it does not tell is refused by name."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, InputError
from gonio.kernel.articulated.background import locate_pictures
from gonio.kernel.articulated.chain import solve_body
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.articulated import BODIES, virtual_background, virtual_body, virtual_cameras
from gonio.records import Background, Camera, KnownLength, LocatedPictures


def cameras_of(seed: int, pictures: int = 4) -> tuple[Camera, ...]:
    return virtual_cameras(np.random.default_rng(seed), pictures)


def errors(truth: tuple[Camera, ...], found: LocatedPictures) -> np.ndarray:
    """Each picture's error in the covariance's own terms: turn, shift, focal length."""
    rows = []
    for a, b in zip(truth, found.cameras, strict=True):
        moved = b.T_cam_lab @ a.T_lab_cam
        turn = Rotation.from_matrix(moved[:3, :3]).as_rotvec()
        shift = b.T_cam_lab[:3, 3] - moved[:3, :3] @ a.T_cam_lab[:3, 3]
        rows.append([*turn, *shift, b.intrinsic_px[0, 0] - a.intrinsic_px[0, 0]])
    return np.array(rows)


def same(truth: tuple[Camera, ...], found: LocatedPictures) -> None:
    # Noise-free: what is left is the descent's last step, 1e-10 of the loss, amplified.
    off = np.abs(errors(truth, found)).max(axis=0)
    assert off[:6].max() < 1e-5
    assert off[6] < 0.05


def test_exact_marks_give_the_cameras_exactly() -> None:
    for seed in range(3):
        cameras = cameras_of(seed)
        background, _ = virtual_background(cameras, seed, noise_px=0.0)
        same(cameras, locate_pictures(background))


def test_more_pictures_than_the_core_follow() -> None:
    cameras = cameras_of(5, pictures=8)
    background, _ = virtual_background(cameras, 5, noise_px=0.0, points=60)
    same(cameras, locate_pictures(background))


def test_known_focal_lengths_are_held() -> None:
    cameras = cameras_of(1)
    background, _ = virtual_background(cameras, 1, noise_px=0.3, focal_known=True)
    found = locate_pictures(background)
    assert np.abs(errors(cameras, found)[:, 6]).max() < 1e-9
    assert np.all(found.covariance[6::16] == 0)


def test_wrong_marks_are_thrown_out_and_error_bars_hold() -> None:
    squares = []
    for seed in range(8):
        cameras = cameras_of(seed + 20)
        background, X = virtual_background(cameras, seed + 20, noise_px=0.7, wrong=0.06)
        found = locate_pictures(background)
        uv = np.stack([project(camera, X) for camera in cameras])
        wrong = np.linalg.norm(background.uv_px - uv, axis=-1) > 20
        # A point of two pictures may be wrong along its ray, and nothing can tell.
        assert not (wrong & found.used & (found.used.sum(axis=0) >= 3)).any()
        assert found.sigma_px == pytest.approx(0.7, rel=0.35)  # about 100 freedoms: 7 %, less what was cut off
        for i, x in enumerate(errors(cameras, found)):
            squares.append(x @ np.linalg.solve(found.covariance[16 * i : 16 * i + 7, 16 * i : 16 * i + 7], x))
    # Medians of chi-squares of seven freedoms are 6.35; 32 of them, 8 independent: within a factor of 2.
    assert 0.6 < np.sqrt(6.346 / np.median(squares)) < 1.7


def test_a_length_measures_without_a_floor() -> None:
    cameras = cameras_of(2)
    background, X = virtual_background(cameras, 2, noise_px=0.0)
    length = KnownLength(first=0, second=1, length_m=float(np.linalg.norm(X[0] - X[1])))
    found = locate_pictures(replace(background, floor_points=(), heights=(), lengths=(length,)))
    there = [camera.centre_lab_m for camera in cameras]
    here = [camera.centre_lab_m for camera in found.cameras]
    for i in range(1, 4):
        far = np.linalg.norm(there[i] - there[0])
        assert np.linalg.norm(here[i] - here[0]) == pytest.approx(far, rel=1e-5)
    assert np.all(found.covariance[:6] == 0)  # the reference picture holds the world


def test_the_cameras_errors_reach_the_joints() -> None:
    body = virtual_body(BODIES["mannequin"], 4, noise_px=0.5)
    background, _ = virtual_background(body.cameras, 4, noise_px=0.5)
    found = locate_pictures(background)
    exact = solve_body(found.cameras, body.parts, body.floor)
    carried = solve_body(found.cameras, body.parts, body.floor, camera_covariance=found.covariance)
    for without, with_cameras in zip(exact, carried, strict=True):
        assert np.all(with_cameras.rotation_sd_rad[1:] > without.rotation_sd_rad[1:])
        np.testing.assert_allclose(with_cameras.Ts_world_part, without.Ts_world_part)


def test_a_joint_follows_its_cameras_as_the_slopes_say() -> None:
    """One camera moved by a little: the solution moves by its slope times that, in both parts of a chain."""
    body = virtual_body(BODIES["mannequin"], 4, noise_px=0.0)
    change = 0.02 * np.array([2e-4, -1e-4, 1e-4, 3e-4, 1e-4, -2e-4])
    cameras = list(body.cameras)
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(change[:3]).as_matrix(), change[3:]
    cameras[2] = replace(cameras[2], T_lab_cam=cameras[2].T_lab_cam @ np.linalg.inv(moved))
    covariance = np.zeros((64, 64))
    covariance[32:38, 32:38] = np.outer(change, change)
    before = solve_body(body.cameras, body.parts, body.floor, camera_covariance=covariance)
    after = solve_body(tuple(cameras), body.parts, body.floor)
    exact = {motion.part: motion for motion in solve_body(body.cameras, body.parts, body.floor)}
    for a, b in zip(before, after, strict=True):
        turn = Rotation.from_matrix(b.Ts_world_part[:, :3, :3] @ a.Ts_world_part[:, :3, :3].swapaxes(1, 2)).as_rotvec()
        sd = np.sqrt(np.diag(a.world_twist_covariance).reshape(-1, 6)[:, :3])
        own = np.sqrt(np.diag(exact[a.part].world_twist_covariance).reshape(-1, 6)[:, :3])
        np.testing.assert_allclose(turn[1:] ** 2, (sd**2 - own**2)[1:], rtol=0.1, atol=1e-12)


def blank(background: Background, keep: int) -> Background:
    uv = background.uv_px.copy()
    uv[3, keep:] = np.nan
    return replace(background, uv_px=uv)


def test_what_the_background_does_not_tell_is_refused_by_name() -> None:
    cameras = cameras_of(3)
    background, X = virtual_background(cameras, 3)

    def seen(points: np.ndarray, by: tuple[Camera, ...]) -> Background:
        uv = np.stack([project(camera, points) for camera in by])
        uv += np.random.default_rng(0).normal(0, 0.3, uv.shape)
        inside = ((uv > 0) & (uv < by[0].image_size_px)).all(axis=-1, keepdims=True)
        return replace(background, uv_px=np.where(inside, uv, np.nan))

    still = tuple(replace(camera, T_lab_cam=cameras[0].T_lab_cam) for camera in cameras)
    line = X.copy()
    line[:4] = np.array([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0], [0.6, 0, 0]])
    cases = {
        "background-camera-static": seen(X, still),
        "floor-points-collinear": seen(line, cameras),
        "background-pictures-apart": blank(background, 5),
        "background-measure-unseen": replace(
            background, uv_px=np.where(np.arange(len(X))[:, None] < 2, np.nan, background.uv_px)
        ),
    }
    for code, case in cases.items():
        with pytest.raises(CaptureError) as error:
            locate_pictures(case)
        assert error.value.code == code


def test_a_background_without_a_measure_is_refused() -> None:
    background, _ = virtual_background(cameras_of(0), 0)
    for change, code in (
        ({"heights": ()}, "background-scale-missing"),
        ({"floor_points": (0, 1)}, "floor-points-few"),
        ({"floor_points": ()}, "floor-points-few"),
        ({"pictures": ("one",), "uv_px": background.uv_px[:1]}, "too-few-pictures"),
    ):
        with pytest.raises(InputError) as error:
            replace(background, **change)
        assert error.value.code == code
