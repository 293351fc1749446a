import numpy as np
import pytest

from gonio.errors import CaptureError, InputError
from gonio.kernel.calibration.lab_frame import (
    camera_up,
    heading_rad,
    lab_from_board,
    lab_from_cameras,
    lab_from_points,
    lab_from_walker,
)
from gonio.kernel.geometry.transforms import apply, inverse, rotation_about_y, transform
from gonio.kernel.virtual_lab import make_rig

STANDING = np.zeros((20, 3))
HALF_WIDTH = 0.1


@pytest.mark.parametrize("facing_deg", [0, 60, 90, 180, -135])
def test_a_standing_subject_heads_where_the_hips_face(facing_deg: float) -> None:
    angle = np.deg2rad(facing_deg)
    to_the_right = np.array([np.sin(angle), 0.0, np.cos(angle)])  # +Z for a subject who faces +X
    heading = heading_rad(STANDING - HALF_WIDTH * to_the_right, STANDING + HALF_WIDTH * to_the_right)
    assert np.cos(heading - angle) == pytest.approx(1.0)


def test_a_walk_heads_where_it_goes_even_backwards() -> None:
    path = np.linspace([0, 0, 0], [0, 0, -3.0], 50)  # towards -Z, hips facing +Z
    path[[0, 49]] = np.nan
    right = np.array([-HALF_WIDTH, 0.0, 0.0])
    assert heading_rad(path - right, path + right) == pytest.approx(np.pi / 2)


def test_nobody_keeps_the_calibrations_heading() -> None:
    nothing = np.full((5, 3), np.nan)
    assert heading_rad(nothing, nothing) == 0.0


def ring(count: int = 4, height_m: float = 2.0) -> np.ndarray:
    """``T_lab_cam`` of cameras around the origin."""
    return np.stack([camera.T_lab_cam for camera in make_rig(count, height_m=height_m).cameras])


def in_first_camera(T_lab_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cameras in the first one's frame, and what should be found: ``T_lab_ref``."""
    return inverse(T_lab_cam[0]) @ T_lab_cam, T_lab_cam[0]


@pytest.mark.parametrize("face_down", [False, True])
def test_the_board_on_the_floor_is_the_lab_whichever_side_is_up(face_down: bool) -> None:
    Ts_ref_cam, T_lab_ref = in_first_camera(ring())
    # Seen from the front a board's Z runs into the paper: printed side up, Z is down.
    Z = np.array([0.0, 1.0 if face_down else -1.0, 0.0])
    T_lab_board = transform(np.stack([[1.0, 0, 0], np.cross(Z, [1.0, 0, 0]), Z], axis=1), np.array([0.4, 0.003, -0.2]))
    middle = np.array([0.2, 0.1, 0.0])
    frame = lab_from_board(
        (inverse(T_lab_ref) @ T_lab_board)[None], Ts_ref_cam, middle_board_m=middle, thickness_m=0.003
    )
    # The same axes; the origin is below the board's middle, on the floor.
    origin = apply(T_lab_board, middle) - [0, 0.003, 0]
    np.testing.assert_allclose(apply(frame.T_lab_ref, apply(inverse(T_lab_ref), origin)), np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(frame.T_lab_ref[:3, :3], T_lab_ref[:3, :3], atol=1e-12)
    assert frame.source == "board"


def test_a_board_above_some_cameras_does_not_lie_on_the_floor() -> None:
    T_lab_cam = ring()
    T_lab_cam[1, 1, 3] = -1.0
    Ts_ref_cam, T_lab_ref = in_first_camera(T_lab_cam)
    T_lab_board = transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    with pytest.raises(CaptureError) as caught:
        lab_from_board((inverse(T_lab_ref) @ T_lab_board)[None], Ts_ref_cam, middle_board_m=np.zeros(3))
    assert caught.value.code == "floor-contradicts"


def test_floor_points_are_the_lab_and_their_misfit_is_told() -> None:
    _, T_lab_ref = in_first_camera(ring())
    lab = np.array([[0, 0, 0], [3, 0, 0], [3, 0, 2], [0, 0, 2.0]])
    seen = apply(inverse(T_lab_ref), lab)
    frame = lab_from_points(seen, lab)
    np.testing.assert_allclose(frame.T_lab_ref, T_lab_ref, atol=1e-9)
    wrong = lab.copy()
    wrong[3, 1] += 0.2
    assert lab_from_points(seen, wrong).misfit_m > 0.02
    for few in (lab[:2], lab[[0, 1, 1, 0]]):
        with pytest.raises(InputError) as caught:
            lab_from_points(apply(inverse(T_lab_ref), few), few)
        assert caught.value.code == "floor-points-few"


def contacts(rng: np.random.Generator, heading_rad: float, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Where the feet stood, alternating left and right 8 cm beside the line, 12 mm of noise."""
    is_left = np.arange(count) % 2 == 0
    along = 0.65 * np.arange(count) - 0.3 * count
    places = np.stack([along, np.zeros(count), np.where(is_left, -0.08, 0.08)], axis=-1)
    turned = places @ rotation_about_y(heading_rad).T
    return turned + rng.normal(0, 0.012, places.shape), is_left


def test_a_walker_gives_the_floor_and_the_direction_of_progression() -> None:
    T_lab_cam = ring()
    Ts_ref_cam, T_lab_ref = in_first_camera(T_lab_cam)
    places, is_left = contacts(np.random.default_rng(0), np.deg2rad(30))
    frame = lab_from_walker(apply(inverse(T_lab_ref), places), is_left, camera_up(Ts_ref_cam))
    T_found_lab = frame.T_lab_ref @ inverse(T_lab_ref)
    forward = T_found_lab[:3, :3] @ rotation_about_y(np.deg2rad(30)) @ [1.0, 0, 0]
    # 12 contacts of 12 mm over 7 m: heading to 0.1°, pitch to 0.1°; three of these and more.
    assert np.rad2deg(np.arctan2(np.hypot(forward[1], forward[2]), forward[0])) < 0.6
    # Across, one line of steps says little: ±12 mm over 16 cm are 2.8° in the median of the reference's sessions.
    assert T_found_lab[1, 1] > np.cos(np.deg2rad(5.0))
    assert frame.source == "walker"
    with pytest.raises(CaptureError) as caught:
        lab_from_walker(apply(inverse(T_lab_ref), places[:3]), is_left[:3], camera_up(Ts_ref_cam))
    assert caught.value.code == "walk-too-short"


def test_without_anything_the_cameras_own_posture_is_up() -> None:
    Ts_ref_cam, T_lab_ref = in_first_camera(ring())
    seen = apply(inverse(T_lab_ref), np.random.default_rng(0).uniform([-1, 0, -1], [1, 2, 1], (500, 3)))
    frame = lab_from_cameras(Ts_ref_cam, seen)
    up = frame.T_lab_ref[:3, :3] @ inverse(T_lab_ref)[:3, :3] @ [0, 1.0, 0]
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-9)
    assert apply(frame.T_lab_ref, seen)[:, 1].min() == pytest.approx(0.0, abs=0.03)
    assert frame.source == "cameras"
