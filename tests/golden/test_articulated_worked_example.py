"""The paper's worked example: three joints and two pictures, all whole numbers, so that everything holds to rounding."""

import json
from pathlib import Path

import numpy as np
import pytest

from gonio.kernel.articulated.chain import corrected_cameras
from gonio.kernel.articulated.paper import meet
from gonio.kernel.geometry.transforms import apply, inverse, transform

EXAMPLE = json.loads((Path(__file__).parent / "articulated_worked_example.json").read_text())
C1, C2 = np.array(EXAMPLE["camera1"], float), np.array(EXAMPLE["camera2"], float)


def matrix(name: str) -> np.ndarray:
    return np.array(EXAMPLE[name], float)


# The frame of each joint's parent in picture 1 and 2, and the relative motion in it (eq. 1's D).
MOTIONS = {
    "J1": (np.eye(4), np.eye(4), matrix("Tr1")),
    "J2": (matrix("W_I1J1"), matrix("W_I2J1"), matrix("Tr2")),
    "J3": (matrix("W_I1J2"), matrix("W_I2J2"), matrix("Tr3")),
}


@pytest.mark.parametrize("joint", EXAMPLE["joints"], ids=lambda j: j["name"])
def test_rays_meet_where_the_paper_says(joint: dict) -> None:
    parent1, parent2, moved = MOTIONS[joint["name"]]
    p1, p2 = np.array(joint["p1"], float), np.array(joint["p2"], float)
    first = moved @ inverse(parent1)
    o1, end1 = apply(first, C1), apply(first, p1)
    o2, end2 = apply(inverse(parent2), C2), apply(inverse(parent2), p2)
    met = meet(o1, end1 - o1, o2, end2 - o2)
    np.testing.assert_allclose([met.t, met.s], [joint["t"], joint["s"]], atol=1e-9)
    np.testing.assert_allclose(met.middle, joint["meet"], atol=1e-9)
    assert met.gap < 1e-9


def test_the_published_matrix_of_eq_11_is_a_reflection() -> None:
    assert np.linalg.det(matrix("eq11_published_WRONG")[:3, :3]) == pytest.approx(-1, abs=1e-12)
    for name in EXAMPLE:
        if name.startswith(("W_", "I1", "I2", "Tr")):
            assert np.linalg.det(matrix(name)[:3, :3]) == pytest.approx(1, abs=1e-12), name


def test_with_the_published_matrix_the_rays_do_not_meet() -> None:
    o1, end1 = apply(matrix("Tr2"), C1), apply(matrix("Tr2"), np.array([0, 0, 25.0]))
    into = inverse(matrix("eq11_published_WRONG"))
    o2, end2 = into[:3, :3] @ C2 + into[:3, 3], into[:3, :3] @ np.array([5.0, 0, 20]) + into[:3, 3]
    assert meet(o1, end1 - o1, o2, end2 - o2).gap > 1


@pytest.mark.parametrize(("joint", "in_camera"), [("J1", (10, 400, 20)), ("J2", (5, 400, 20)), ("J3", (-20, 400, 70))])
def test_corrected_cameras_of_eq_20(joint: str, in_camera: tuple[float, ...]) -> None:
    moved = matrix(f"W_I2{joint}") @ inverse(matrix(f"W_I1{joint}"))
    T_world_c2 = transform(np.eye(3), C2)
    corrected = corrected_cameras(T_world_c2[None], moved[None])[0]
    np.testing.assert_allclose(corrected, matrix(f"C2_corrected_{joint}"), atol=1e-9)
    p1 = apply(matrix(f"W_I1{joint}"), apply(inverse(matrix(f"W_I2{joint}")), np.zeros(3)))  # any point of the part
    np.testing.assert_allclose(apply(inverse(corrected), p1), apply(inverse(T_world_c2), apply(moved, p1)), atol=1e-9)
    points = {"J1": (10, 0, 20), "J2": (5, 0, 20), "J3": (-20, 0, 70)}
    np.testing.assert_allclose(apply(inverse(T_world_c2), np.array(points[joint], float)), in_camera, atol=1e-9)
