import numpy as np
import pytest

from gonio.kernel.calibration.lab_frame import heading_rad

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
