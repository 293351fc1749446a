"""Inverse kinematics and scaling on motions whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import CaptureError, InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.body.scaling import measure_scale_factors, scale_model
from gonio.kernel.kinematics.clinical import clinical_deg, find_clinical_angles
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import NOT_CONVERGED, PARTIAL, SOLVED, TOO_FEW_MARKERS, Tasks

MODELS = Path(__file__).resolve().parents[3] / "models"


@pytest.fixture(scope="module")
def markerset():
    return read_markerset(MODELS / "markersets" / "blazepose33.toml")


@pytest.fixture(scope="module")
def model(markerset):
    return attach(read_osim(MODELS / "bodies" / "fullbody_male.osim"), markerset)


@pytest.fixture(scope="module")
def tasks(model):
    """All markers alike and no priors: without noise the truth is the only minimum."""
    return Tasks(
        marker_weights=np.ones(len(model.markers.names)),
        coordinate_weights=np.zeros(len(model.coordinates.names)),
        coordinate_targets=np.zeros(len(model.coordinates.names)),
        target_sd=np.zeros(len(model.coordinates.names)),
    )


def walking(model, frames=150, heading_rad=0.0):
    """Coordinates of something like a walk: every joint swings within its range."""
    phase = np.linspace(0, 6 * np.pi, frames)
    q = np.tile(model.coordinates.default, (frames, 1))
    for index, name in enumerate(model.coordinates.names):
        swing = {"knee_angle": 0.5, "hip_flexion": 0.4, "elbow_flex": 0.3, "arm_flex": 0.4}
        amplitude = swing.get(name[:-2], 0.05)
        q[:, index] += amplitude * np.sin(phase + (np.pi if name.endswith("_l") else 0.0) + 0.3 * index)
        if name.startswith(("knee", "elbow")):
            q[:, index] += amplitude + 0.1
    q[:, model.coordinates.index("pelvis_rotation")] = heading_rad + 0.1 * np.sin(phase)
    q[:, model.coordinates.index("pelvis_tx")] = np.linspace(0, 3, frames)
    for side in "rl":  # what 33 keypoints can't tell apart
        q[:, model.coordinates.index(f"mtp_angle_{side}")] = 0.0
    return q


@pytest.mark.parametrize("heading_rad", [0.0, 0.7, 1.6, 2.5, 3.1, -2.0, -0.8])
def test_a_motion_is_recovered_whatever_way_the_person_faces(model, tasks, heading_rad):
    q = walking(model, heading_rad=heading_rad)
    motion = solve_motion(model, tasks, marker_positions(model, q), np.arange(len(q)) / 60)
    assert np.all(motion.status == SOLVED)
    # Convergence is to 1e-6 rad by estimate; toe and ankle share two points, which makes those worst determined.
    np.testing.assert_allclose(motion.values, q, atol=1e-4)
    assert motion.residual_rms_m.max() < 1e-6


def test_the_heading_is_followed_through_whole_turns(model, tasks):
    q = walking(model, frames=300)
    q[:, model.coordinates.index("pelvis_rotation")] = np.linspace(0.0, 4 * np.pi, 300)
    motion = solve_motion(model, tasks, marker_positions(model, q), np.arange(300) / 60)
    assert np.all(motion.status == SOLVED)
    np.testing.assert_allclose(
        motion.of("pelvis_rotation"), q[:, model.coordinates.index("pelvis_rotation")], atol=1e-4
    )


def test_results_do_not_depend_on_the_number_of_cores(model, tasks, monkeypatch):
    q = walking(model)
    seen = marker_positions(model, q) + np.random.default_rng(0).normal(0, 0.01, size=(len(q), 33, 3))
    first = solve_motion(model, tasks, seen, np.arange(len(q)) / 60)
    monkeypatch.setattr("gonio.kernel.parallel._cores", lambda: 1)
    second = solve_motion(model, tasks, seen, np.arange(len(q)) / 60)
    np.testing.assert_array_equal(first.values, second.values)


def test_noise_of_a_centimetre_leaves_the_knee_right_to_a_degree_or_two(model, markerset):
    q = walking(model)
    seen = marker_positions(model, q) + np.random.default_rng(1).normal(0, 0.01, size=(len(q), 33, 3))
    motion = solve_motion(model, make_tasks(model, markerset), seen, np.arange(len(q)) / 60)
    assert np.all(motion.status == SOLVED)
    for angle in find_clinical_angles(model):
        error_deg = clinical_deg(motion, angle) - angle.sign * np.degrees(
            q[:, model.coordinates.index(angle.coordinate)]
        )
        # A knee between bones of 43 cm: 10 mm · √(1 + 2² ...)/430 mm ≈ 2.3°; hip and ankle carry the priors' pull too.
        if angle.name == "knee_flexion":
            assert np.sqrt(np.mean(error_deg**2)) < 3.0


def test_a_limb_that_is_not_seen_is_unknown_and_nothing_else(model, tasks):
    q = walking(model)
    seen = marker_positions(model, q)
    for name in ("left_elbow", "left_wrist", "left_pinky", "left_index", "left_thumb"):
        seen[40:60, model.markers.index(name)] = np.nan
    motion = solve_motion(model, tasks, seen, np.arange(len(q)) / 60)
    unknown = [name for name in motion.coordinate_names if np.isnan(motion.of(name)[50])]
    arm = ("arm_flex", "arm_add", "arm_rot", "elbow_flex", "pro_sup", "wrist_flex", "wrist_dev")
    assert unknown == [f"{name}_l" for name in arm]
    assert set(motion.status[40:60]) == {PARTIAL}
    assert set(motion.status[60:]) == {SOLVED}


def test_too_few_markers_give_nan_and_say_so(model, tasks):
    q = walking(model)
    seen = marker_positions(model, q)
    seen[10:20, 2:] = np.nan
    motion = solve_motion(model, tasks, seen, np.arange(len(q)) / 60)
    assert set(motion.status[10:20]) == {TOO_FEW_MARKERS}
    assert np.all(np.isnan(motion.values[10:20]))
    assert np.all(motion.status[20:] == SOLVED)


def test_no_frames_and_no_markers_at_all(model, tasks):
    assert solve_motion(model, tasks, np.empty((0, 33, 3)), np.empty(0)).values.shape == (0, 40)
    motion = solve_motion(model, tasks, np.full((5, 33, 3), np.nan), np.arange(5.0))
    assert set(motion.status) == {TOO_FEW_MARKERS}


def test_arms_at_the_pole_of_their_angles_are_found(model, markerset):
    """With the arms held out sideways flexion and rotation turn about one axis, and a full step would be many turns."""
    default = model.coordinates.default.copy()
    for side in "rl":
        default[model.coordinates.index(f"arm_add_{side}")] = -np.pi / 2
    t_pose = replace(model, coordinates=replace(model.coordinates, default=default))
    q = walking(model, frames=100)
    phase = np.linspace(0, 4 * np.pi, 100)
    for side in "rl":
        q[:, model.coordinates.index(f"arm_add_{side}")] = -np.pi / 2 + 0.3 * np.sin(phase)
        q[:, model.coordinates.index(f"pro_sup_{side}")] = np.radians(50)  # what the card believes: fingers hardly tell
    seen = marker_positions(model, q) + np.random.default_rng(2).normal(0, 0.005, size=(100, 33, 3))
    tasks = make_tasks(model, markerset)
    motion = solve_motion(t_pose, tasks, seen, np.arange(100) / 60)
    assert set(motion.status) == {SOLVED}
    elbows = [model.markers.index(name) for name in ("left_elbow", "right_elbow", "left_wrist", "right_wrist")]
    apart_m = np.linalg.norm(
        marker_positions(model, motion.values)[:, elbows] - marker_positions(model, q)[:, elbows], axis=-1
    )
    # Noise of 5 mm a direction on a point, shared between neighbours, and the pull of the priors: a wrong arm is 100 mm off.
    assert apart_m.max() < 0.05


def test_clamped_coordinates_stay_in_their_range(model, tasks):
    q = walking(model, frames=40)
    knee = model.coordinates.index("knee_angle_r")
    q[:, knee] = -0.6  # the model allows −15°
    motion = solve_motion(model, tasks, marker_positions(model, q), np.arange(40) / 60)
    np.testing.assert_allclose(motion.values[:, knee], np.radians(-15), atol=1e-9)
    assert np.all(motion.status == SOLVED)


def test_locked_coordinates_keep_their_default(model, tasks):
    locked = model.coordinates.locked.copy()
    locked[model.coordinates.index("lumbar_rotation")] = True
    stiff = replace(model, coordinates=replace(model.coordinates, locked=locked))
    motion = solve_motion(stiff, tasks, marker_positions(model, walking(model, 30)), np.arange(30) / 60)
    assert np.all(motion.of("lumbar_rotation") == 0.0)


def test_the_iteration_limit_is_reported(model, tasks):
    q = walking(model, frames=3)
    motion = solve_motion(model, tasks, marker_positions(model, q), np.arange(3) / 60, max_iterations=1)
    assert set(motion.status) == {NOT_CONVERGED}


def test_wrong_shapes_are_refused(model, tasks):
    with pytest.raises(InputError, match="33 markers, the trial 5"):
        solve_motion(model, tasks, np.zeros((4, 5, 3)), np.arange(4.0))


def test_scale_factors_come_from_the_distances(model, markerset):
    person = scale_model(model, sized(model, femur=1.1, tibia=0.9, radius=1.2), mass_kg=70.0)
    seen = marker_positions(person, standing(person))
    factors = measure_scale_factors(model, markerset.measurements, seen)
    # The knee keypoint is fixed to the thigh, 4.6 mm beside the shank's origin: the ratio of lengths differs by 1.4e-5.
    assert factors[model.bodies.index("tibia_r")] == pytest.approx(0.9, abs=1e-4)
    assert factors[model.bodies.index("radius_l")] == pytest.approx(1.2, abs=1e-6)
    assert factors[model.bodies.index("femur_l")] == pytest.approx(1.1, abs=1e-6)
    squares = measure_scale_factors(model, markerset.measurements, seen, method="least_squares")
    np.testing.assert_allclose(squares, factors, atol=0.02)


def test_one_wild_frame_does_not_change_the_scale(model, markerset):
    seen = marker_positions(model, walking(model))
    seen[7] += np.random.default_rng(3).normal(size=seen[7].shape)
    factors = measure_scale_factors(model, markerset.measurements, seen)
    assert factors[model.bodies.index("femur_r")] == pytest.approx(1.0, abs=1e-3)


def test_sides_are_pooled_unless_told_otherwise(model, markerset):
    seen = marker_positions(scale_model(model, sized(model, tibia_r=1.2)), standing(model))
    pooled = measure_scale_factors(model, markerset.measurements, seen)
    apart = measure_scale_factors(model, markerset.measurements, seen, symmetric=False)
    assert pooled[model.bodies.index("tibia_r")] == pytest.approx(1.1, abs=1e-4)
    assert apart[model.bodies.index("tibia_r")] == pytest.approx(1.2, abs=1e-4)
    assert apart[model.bodies.index("tibia_l")] == pytest.approx(1.0, abs=1e-6)


def test_a_pair_that_is_never_seen_says_which(model, markerset):
    seen = marker_positions(model, walking(model))
    seen[:, model.markers.index("left_knee")] = np.nan
    with pytest.raises(CaptureError, match="left_hip and left_knee are never seen"):
        measure_scale_factors(model, markerset.measurements, seen)


def test_uniform_scaling_scales_lengths_masses_and_inertias(model):
    twice = scale_model(model, np.full((len(model.bodies.names), 3), 2.0), mass_kg=3 * model.mass_kg)
    q = model.coordinates.default.copy()
    q[model.coordinates.index("knee_angle_r")] = 1.0
    there = q.copy()
    for name in ("pelvis_tx", "pelvis_ty", "pelvis_tz"):
        there[model.coordinates.index(name)] *= 2
    np.testing.assert_allclose(
        marker_positions(twice, there[None]), 2 * marker_positions(model, q[None]), rtol=0, atol=1e-12
    )
    assert twice.mass_kg == pytest.approx(3 * model.mass_kg)
    np.testing.assert_allclose(twice.bodies.inertia_body_kgm2, 12 * model.bodies.inertia_body_kgm2, rtol=1e-12)


def test_stretching_a_body_stretches_its_inertia(model):
    factors = np.ones((len(model.bodies.names), 3))
    thigh = model.bodies.index("femur_r")
    factors[thigh] = (1.0, 2.0, 1.0)
    before, after = model.bodies.inertia_body_kgm2[thigh], scale_model(model, factors).bodies.inertia_body_kgm2[thigh]
    along_y = (before[0, 0] + before[2, 2] - before[1, 1]) / 2  # ∫ρ y²
    assert after[1, 1] == pytest.approx(before[1, 1])
    assert after[0, 0] == pytest.approx(before[0, 0] + 3 * along_y)


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan])
def test_impossible_factors_are_refused(model, factor):
    with pytest.raises(InputError, match="not positive"):
        scale_model(model, np.full((len(model.bodies.names), 3), factor))


def standing(model, frames=10):
    """The default pose, wandering: distances are then those that a scale factor is the ratio of."""
    q = np.tile(model.coordinates.default, (frames, 1))
    q[:, model.coordinates.index("pelvis_tx")] = np.linspace(0, 1, frames)
    return q


def sized(model, **stems):
    """Factors for all bodies whose name starts with a stem."""
    factors = np.ones((len(model.bodies.names), 3))
    for index, name in enumerate(model.bodies.names):
        for stem, factor in stems.items():
            if name.startswith(stem):
                factors[index] = factor
    return factors
