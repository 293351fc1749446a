from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError, GonioError, InputError
from gonio.kernel.articulated.chain import corrected_cameras, solve_body
from gonio.kernel.articulated.motion import Motions, step, twists_of
from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.kernel.virtual_lab.articulated import (
    BODIES,
    Shape,
    VirtualBody,
    virtual_body,
    virtual_cameras,
    virtual_turntable,
)
from gonio.records import JointKind, JointMotion, KnownLength

KINDS: tuple[JointKind, ...] = ("free", "spherical", "hinge", "planar", "prismatic")
BLOCK = Shape("block", None, "planar", 12, (0, 0.25, 0), (0.3, 0.4, 0.3), (0, 0, 0))
DRAWER = Shape("drawer", None, "prismatic", 12, (0, 0.3, 0), (0.3, 0.2, 0.3), (0, 0, 0), (0.6, 0.0, 0.8))
HEAD = BODIES["head"][0]


def solved(body: VirtualBody, **options: int) -> tuple[JointMotion, ...]:
    return solve_body(body.cameras, body.parts, body.floor, **options)


def worst_turn_deg(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(found[:, :3, :3] @ truth[:, :3, :3].swapaxes(1, 2)).magnitude().max()))


@pytest.mark.parametrize("kind", KINDS)
def test_twists_are_the_derivative_of_a_step(kind: JointKind) -> None:
    rng = np.random.default_rng(3)
    axis = rng.normal(size=(1, 3))
    axis /= np.linalg.norm(axis)
    centre = rng.normal(size=(1, 3))
    angle = np.array([0.0, 0.7, -1.1])
    vector = angle[:, None] * axis if kind in ("hinge", "planar") else rng.normal(size=(3, 3)) * (angle != 0)[:, None]
    R = Rotation.from_rotvec(vector).as_matrix()
    t = centre - R @ centre[0] if kind in ("spherical", "hinge") else rng.normal(size=(3, 3)) * (angle != 0)[:, None]
    if kind == "prismatic":
        R, t = np.tile(np.eye(3), (3, 1, 1)), angle[:, None] * axis
    motions = Motions(R[None], t[None], centre, axis)
    X = rng.normal(size=(1, 4, 3))
    B = twists_of(kind, motions, 0)
    Y = motions.moved(X)
    for unknown in range(B.shape[-1]):
        change = np.zeros((1, B.shape[-1]))
        change[0, unknown] = 1e-6
        both = [step(kind, motions, sign * change, 0).moved(X) for sign in (1, -1)]
        w, v = B[:, :, None, :3, unknown], B[:, :, None, 3:, unknown]
        # Central differences: error of second order in the step, rounding 1e-16 / 1e-6.
        np.testing.assert_allclose((both[0] - both[1]) / 2e-6, np.cross(w, Y) + v, atol=1e-8)


@pytest.mark.parametrize("name", BODIES)
def test_bodies_without_noise_are_recovered(name: str) -> None:
    body = virtual_body(BODIES[name], 1, noise_px=0.0)
    for joint in solved(body):
        # Marks are exact to 1e-13 of 700 px; along the worst-known direction that is amplified some 1e4 times.
        assert worst_turn_deg(joint.Ts_parent_part, body.Ts_parent_part[joint.part]) < 1e-6
        np.testing.assert_allclose(joint.Ts_world_part, body.Ts_world_part[joint.part], atol=1e-7)
        np.testing.assert_allclose(joint.xyz_m, body.xyz_m[joint.part], atol=1e-7)


@pytest.mark.parametrize("shape", [BLOCK, DRAWER], ids=lambda s: s.kind)
def test_planar_and_prismatic_joints(shape: Shape) -> None:
    body = virtual_body((shape,), 2, noise_px=0.0)
    (joint,) = solved(body)
    np.testing.assert_allclose(joint.Ts_world_part, body.Ts_world_part[shape.name], atol=1e-6)
    if shape.kind == "prismatic":
        assert abs(joint.axis @ np.array(shape.axis)) == pytest.approx(1, abs=1e-9)


def test_a_chain_of_three_with_missing_points_and_lens_distortion() -> None:
    hand = Shape("hand", "forearm", "spherical", 12, (0, 0.5, 0.8), (0.12, 0.1, 0.15), (0, 0.5, 0.7))
    body = virtual_body((*BODIES["arm"], hand), 4, noise_px=0.0)
    lens = np.array([-0.12, 0.03, 0.001, -0.0005, 0.0])
    cameras = tuple(replace(camera, distortion=lens) for camera in body.cameras)
    parts = []
    for part in body.parts:
        Ts, X = body.Ts_world_part[part.name], body.xyz_m[part.name]
        uv = np.stack([project(c, X @ T[:3, :3].T + T[:3, 3]) for c, T in zip(cameras, Ts, strict=True)])
        uv[0, 0] = uv[1, 3] = uv[2, 5] = np.nan
        parts.append(replace(part, uv_px=uv))
    for joint in solve_body(cameras, tuple(parts[::-1]), None):
        np.testing.assert_allclose(joint.Ts_world_part, body.Ts_world_part[joint.part], atol=1e-6)
        np.testing.assert_allclose(joint.xyz_m, body.xyz_m[joint.part], atol=1e-6)


def test_a_turn_about_one_axis_is_found_to_be_a_hinge() -> None:
    (lid,) = BODIES["lid"]
    body = virtual_body((lid,), 5)
    parts = (replace(body.parts[0], kind="spherical"),)
    (joint,) = solve_body(body.cameras, parts, None)
    assert joint.kind == "hinge"
    assert joint.found_hinge
    assert np.isnan(joint.centre_m).all(), "no point of an axis is its centre"
    assert np.degrees(np.arccos(min(1.0, abs(joint.axis[0])))) < 1
    off = joint.axis_point_m - np.array(lid.joint_m)
    assert np.hypot(off[1], off[2]) < 1e-3


def test_half_turns_are_found_without_a_guess() -> None:
    body = virtual_body((HEAD,), 6, turn_rad=(2.0, 2.97))
    (joint,) = solved(body)
    # 0.6° is the median at 0.3 px; its predicted deviation bounds this case.
    assert worst_turn_deg(joint.Ts_parent_part, body.Ts_parent_part["head"]) < 4 * np.degrees(
        joint.rotation_sd_rad.max()
    )


def test_wrong_marks_are_thrown_out() -> None:
    body = virtual_body((replace(HEAD, points=20),), 7, noise_px=0.5, wrong=0.08)
    clean = virtual_body((replace(HEAD, points=20),), 7, noise_px=0.5)
    (joint,) = solved(body)
    wrong = np.linalg.norm(body.parts[0].uv_px - clean.parts[0].uv_px, axis=-1) > 10
    assert wrong.any()
    assert not (joint.used & wrong).any()
    assert worst_turn_deg(joint.Ts_parent_part, body.Ts_parent_part["head"]) < 5
    assert 0.3 < joint.sigma_px < 0.8


def test_a_known_length_gives_the_size() -> None:
    body = virtual_body((BODIES["mannequin"][0],), 8, noise_px=0.0)
    X = body.xyz_m["base"]
    length = KnownLength(first=5, second=6, length_m=float(np.linalg.norm(X[5] - X[6])), sd_m=0.001)
    part = replace(body.parts[0], on_floor=np.zeros_like(body.parts[0].on_floor), length=length)
    (joint,) = solve_body(body.cameras, (part,), None)
    np.testing.assert_allclose(joint.Ts_world_part, body.Ts_world_part["base"], atol=1e-6)
    assert (np.diag(joint.twist_covariance)[6:] > 0).all()


def test_a_turntable_before_a_still_camera_gives_its_steps() -> None:
    squares = []
    for seed in range(6):
        body = virtual_turntable(seed)
        thing = body.parts[0]
        (joint,) = solve_body(body.cameras, (replace(thing, kind="spherical") if seed % 2 else thing,), None)
        assert joint.kind == "hinge"
        turns = Rotation.from_matrix(joint.Ts_parent_part[:, :3, :3]).as_rotvec() @ joint.axis
        off = np.unwrap(turns) * np.sign(turns[1]) - np.pi / 12 * np.arange(8)
        axis = joint.axis
        sd = np.array([np.sqrt(axis @ block[i, :3, i, :3] @ axis) for block in [joint.twist_covariance.reshape(8, 6, 8, 6)]
                       for i in range(1, 8)])  # fmt: skip
        squares += list((off[1:] / sd) ** 2)
        assert np.linalg.norm(joint.xyz_m[0] - joint.xyz_m[1]) == pytest.approx(thing.length.length_m, abs=0.003)
    # Six tables whose seven steps share their errors: as few as 12 independent squares, whose mean's sd is 0.41.
    assert 0.2 < np.mean(squares) < 2.2


def test_a_length_that_no_two_pictures_show_is_refused() -> None:
    body = virtual_turntable(0)
    thing = body.parts[0]
    uv = thing.uv_px.copy()
    uv[1:, 0] = np.nan
    with pytest.raises(CaptureError) as refused:
        solve_body(body.cameras, (replace(thing, uv_px=uv),), None)
    assert refused.value.code == "length-unseen"


def test_a_picture_of_one_face_is_not_taken_for_its_twin() -> None:
    body = virtual_body((HEAD,), 1007, noise_px=1.0)
    X, Ts = body.xyz_m["head"].copy(), body.Ts_world_part["head"]
    X[:8, 0] = 0.1
    rng = np.random.default_rng(7)
    uv = np.stack([project(c, X @ T[:3, :3].T + T[:3, 3]) for c, T in zip(body.cameras, Ts, strict=True)])
    uv += rng.normal(0, 1.0, uv.shape)
    uv[2, 8:] = np.nan
    uv[2, :3] += rng.choice([-8, 8], (3, 2))
    (joint,) = solve_body(body.cameras, (replace(body.parts[0], uv_px=uv),), None)
    # The twin is off by 122°.
    assert worst_turn_deg(joint.Ts_parent_part, Ts) < 3 * np.degrees(joint.rotation_sd_rad.max())


def test_error_bars_are_right() -> None:
    squares = []
    for seed in range(12):
        body = virtual_body((HEAD,), 100 + seed)
        (joint,) = solved(body)
        error = Rotation.from_matrix(
            joint.Ts_parent_part[1:, :3, :3] @ body.Ts_parent_part["head"][1:, :3, :3].swapaxes(1, 2)
        ).as_rotvec()
        block = joint.twist_covariance.reshape(4, 6, 4, 6)
        squares += [e @ np.linalg.solve(block[i, :3, i, :3], e) / 3 for i, e in enumerate(error, start=1)]
    # Mean of 36 chi-squares of 3 freedoms by 3, three a body sharing a centre: sd about sqrt(2/3/12) = 0.24 at worst.
    assert 0.4 < np.mean(squares) < 1.75


def test_the_reference_does_not_matter_without_noise() -> None:
    body = virtual_body((HEAD,), 9, noise_px=0.0)
    (joint,) = solved(body, reference=2)
    truth = body.Ts_world_part["head"] @ inverse(body.Ts_world_part["head"][2])
    np.testing.assert_allclose(joint.Ts_world_part, truth, atol=1e-6)


def test_a_corrected_camera_sees_the_part_where_it_was() -> None:
    body = virtual_body((HEAD,), 10, noise_px=0.0)
    corrected = corrected_cameras(np.stack([c.T_lab_cam for c in body.cameras]), body.Ts_world_part["head"])
    for i, camera in enumerate(body.cameras):
        there = replace(camera, T_lab_cam=corrected[i])
        np.testing.assert_allclose(project(there, body.xyz_m["head"]), body.parts[0].uv_px[i], atol=1e-9)


def still(zooms: int = 4) -> tuple:
    cameras = virtual_cameras(np.random.default_rng(1), zooms)
    return tuple(replace(camera, T_lab_cam=cameras[0].T_lab_cam) for camera in cameras)


def degenerate(case: str) -> tuple[VirtualBody, Shape]:
    sight = tuple(still()[0].T_lab_cam[:3, 2])
    line = replace(HEAD, size_m=(0.3, 0.0, 0.0))
    base = BODIES["mannequin"][0]
    low = virtual_cameras(np.random.default_rng(2), 4)
    level = tuple(
        replace(c, T_lab_cam=transform(c.T_lab_cam[:3, :3], c.centre_lab_m * (1, 0, 1) + (0, 0.8, 0))) for c in low
    )
    shape, options = {
        "camera-static": (HEAD, {"cameras": still()}),
        "no-motion": (HEAD, {"turn_rad": (0.0, 0.0)}),
        "no-parallax": (
            replace(HEAD, kind="hinge", axis=sight, middle_m=(0, 0.35, 0), joint_m=(0, 0.35, 0)), {"cameras": still()}
        ),
        "collinear-points": (line, {}),
        "scale-unobservable": (base, {}),
        "planar at constant height": (BLOCK, {"cameras": level}),
        "too-few-points": (replace(HEAD, points=4), {}),
    }[case]  # fmt: skip
    return virtual_body((shape,), 3, **options), shape


@pytest.mark.parametrize(
    "case",
    [
        "camera-static",
        "no-motion",
        "no-parallax",
        "collinear-points",
        "scale-unobservable",
        "planar at constant height",
        "too-few-points",
    ],
)
def test_what_cannot_be_told_is_refused_by_name(case: str) -> None:
    body, _ = degenerate(case)
    part = body.parts[0]
    if case == "scale-unobservable":
        part = replace(part, on_floor=np.zeros_like(part.on_floor))
    with pytest.raises(CaptureError) as refused:
        solve_body(body.cameras, (part,), body.floor)
    assert refused.value.code == ("scale-unobservable" if "planar" in case else case)


def test_bad_bodies_are_refused_by_name() -> None:
    body = virtual_body(BODIES["arm"], 1)
    upper, fore = body.parts
    base = virtual_body(BODIES["mannequin"], 1).parts[0]
    cases: list[tuple[str, tuple, tuple]] = [
        ("joint-tree-broken", body.cameras, (replace(upper, parent="forearm"), fore)),
        ("joint-tree-broken", body.cameras, (upper, replace(fore, parent="leg"))),
        ("joint-tree-broken", body.cameras, (upper, upper)),
        ("too-few-pictures", body.cameras[:1], (upper,)),
        ("tracks-do-not-fit", body.cameras[:3], (upper,)),
        ("floor-missing", body.cameras, (base,)),
        ("floor-under-child", body.cameras, (upper, replace(base, parent="upper arm"))),
    ]
    for code, cameras, parts in cases:
        floor = body.floor if code == "floor-under-child" else None
        with pytest.raises(GonioError) as refused:
            solve_body(cameras, parts, floor)
        assert isinstance(refused.value, InputError)
        assert refused.value.code == code
