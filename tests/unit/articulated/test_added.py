from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.kernel.articulated.added import add_picture
from gonio.kernel.articulated.chain import solve_body
from gonio.kernel.virtual_lab.articulated import BODIES, virtual_body


@pytest.mark.parametrize("name", BODIES)
def test_a_fifth_picture_is_added(name: str) -> None:
    body = virtual_body(BODIES[name], 4, pictures=5, noise_px=0.0)
    first = tuple(replace(part, uv_px=part.uv_px[:4], on_floor=part.on_floor[:4]) for part in body.parts)
    for motion, part in zip(solve_body(body.cameras[:4], first, body.floor), body.parts, strict=True):
        above = body.Ts_world_part[part.parent][4] if part.parent else np.eye(4)
        T, _ = add_picture(motion, body.cameras[4], part.uv_px[4], T_world_parent=above)
        np.testing.assert_allclose(T, body.Ts_parent_part[part.name][4], atol=1e-6)


def test_its_error_is_told() -> None:
    squares = []
    for seed in range(8):
        body = virtual_body(BODIES["head"], seed, pictures=5)
        exact = virtual_body(BODIES["head"], seed, pictures=5, noise_px=0.0)
        first = tuple(replace(p, uv_px=p.uv_px[:4], on_floor=p.on_floor[:4]) for p in exact.parts)
        (motion,) = solve_body(body.cameras[:4], first, None)
        motion = replace(motion, sigma_px=0.3)
        T, covariance = add_picture(motion, body.cameras[4], body.parts[0].uv_px[4], T_world_parent=np.eye(4))
        error = Rotation.from_matrix(T[:3, :3] @ body.Ts_world_part["head"][4, :3, :3].T).as_rotvec()
        squares.append(error @ np.linalg.solve(covariance[:3, :3], error) / 3)
    # Mean of 8 chi-squares of 3 freedoms by 3: 1 with a deviation of sqrt(2 / 3 / 8) = 0.29.
    assert 0.2 < np.mean(squares) < 2.2


def test_three_marks_are_too_few() -> None:
    body = virtual_body(BODIES["head"], 4, pictures=5)
    first = tuple(replace(p, uv_px=p.uv_px[:4], on_floor=p.on_floor[:4]) for p in body.parts)
    (motion,) = solve_body(body.cameras[:4], first, None)
    uv = body.parts[0].uv_px[4].copy()
    uv[3:] = np.nan
    with pytest.raises(CaptureError) as refused:
        add_picture(motion, body.cameras[4], uv, T_world_parent=np.eye(4))
    assert refused.value.code == "too-few-points"
