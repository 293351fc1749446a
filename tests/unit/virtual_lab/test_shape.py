"""Self-occlusion: which keypoints the body hides."""

import numpy as np
import pytest

from gonio.kernel.virtual_lab.shape import _enter, capsules_of, hidden, place


def test_rays_enter_a_capsule_where_its_surface_is():
    rng = np.random.default_rng(3)
    start, end, radius = np.array([0.1, -0.2, 3.0]), np.array([0.4, 0.5, 3.4]), 0.15
    direction = rng.normal([0.05, 0.05, 1.0], [0.1, 0.15, 0.0], (1, 400, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    entry = _enter(np.zeros(3), direction, start[None, None], end[None, None], radius)[0]
    along = np.linspace(2.0, 4.5, 2501)
    points = along[:, None, None] * direction
    share = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    inside = np.linalg.norm(points - start - share[..., None] * (end - start), axis=-1) < radius
    stepped = np.where(inside.any(axis=0), along[inside.argmax(axis=0)], np.inf)
    assert 50 < np.isfinite(entry).sum() < 350
    grazing = np.isfinite(entry) != np.isfinite(stepped)  # a ray that leaves within a millimetre is missed by the steps
    assert grazing.sum() < 5
    np.testing.assert_allclose(entry[~grazing], stepped[~grazing], atol=1.01e-3)


@pytest.fixture
def standing(man):
    """The default pose with its capsules and joint centres."""
    q = man.coordinates.default[None]
    placed = place(man, capsules_of(man), q)
    joint = {name: placed.start_m[0, i] for i, name in enumerate(capsules_of(man).names)}
    return placed, joint


def seen_from(centre, point, placed):
    return not hidden(np.array(centre, dtype=float), point[None, None], placed)[0, 0]


def test_from_the_right_the_right_leg_hides_the_left_one(standing):
    placed, joint = standing
    camera = (0.0, 0.9, 4.0)
    for name in ("thigh", "shank", "foot"):
        assert seen_from(camera, joint[f"{name} r"], placed)
        assert not seen_from(camera, joint[f"{name} l"], placed)


def test_from_the_front_nothing_of_the_legs_is_hidden(standing):
    placed, joint = standing
    for name in ("thigh r", "thigh l", "shank r", "shank l", "upper arm r", "forearm l"):
        assert seen_from((4.0, 1.2, 0.0), joint[name], placed)


def test_a_joint_is_not_hidden_by_its_own_limb(standing):
    placed, joint = standing
    for angle in np.linspace(0, np.pi, 7):
        camera = 4.0 * np.array([np.cos(angle), 0.0, np.sin(angle)]) + [0.0, 1.0, 0.0]
        assert seen_from(camera, joint["shank r"], placed)
