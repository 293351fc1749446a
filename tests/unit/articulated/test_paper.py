import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.kernel.articulated.chain import sights_of
from gonio.kernel.articulated.paper import meet, residuals, rotation_of, solve_paper
from gonio.kernel.virtual_lab.articulated import BODIES, virtual_body


def sights(name: str, noise_px: float = 0.0, turn_rad: tuple[float, float] = (0.1, 0.3)):
    body = virtual_body(BODIES[name][:1], 3, noise_px=noise_px, turn_rad=turn_rad)
    return body, *sights_of(body.parts[0], body.cameras, np.tile(np.eye(4), (4, 1, 1)), body.floor, 0, 1.0)


@pytest.mark.parametrize("name", ["head", "mannequin"])
def test_the_true_motion_leaves_no_residual(name: str) -> None:
    body, seen, pivot = sights(name)
    Ts = body.Ts_world_part[body.parts[0].name]
    R = Ts[:, :3, :3]
    assert np.abs(residuals(seen, R, Ts[:, :3, 3] + R @ pivot - pivot)).max() < 1e-6


@pytest.mark.parametrize("name", ["head", "mannequin"])
def test_small_turns_are_found(name: str) -> None:
    body, seen, _ = sights(name)
    rotation, _ = solve_paper(body.parts[0].kind, seen)
    truth = body.Ts_world_part[body.parts[0].name][:, :3, :3]
    off = Rotation.from_matrix(rotation @ truth.swapaxes(1, 2)).magnitude()
    assert np.degrees(off).max() < 0.1  # noise-free: what is left is where the optimiser stopped


def test_quaternions_are_scipys() -> None:
    q = np.random.default_rng(1).normal(size=(5, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(rotation_of(q), Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix(), atol=1e-12)


def test_parallel_rays_meet_nowhere() -> None:
    d = np.array([0.0, 0.0, 1.0])
    assert np.isnan(meet(np.zeros(3), d, np.ones(3), d).t)


def test_the_paper_knows_no_planar_joint() -> None:
    with pytest.raises(InputError):
        solve_paper("planar", sights("head")[1])
