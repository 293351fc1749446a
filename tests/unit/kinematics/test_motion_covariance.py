"""The covariance of inverse kinematics against what noise really does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.kinematics.clinical import clinical_sd_deg, find_clinical_angles
from gonio.kernel.kinematics.covariance import add_covariance
from gonio.kernel.kinematics.inverse import solve_motion
from gonio.records import Tasks

ROOT = Path(__file__).resolve().parents[3]
SAMPLES = 4000


@pytest.fixture(scope="module")
def markerset():
    return read_markerset(ROOT / "models/markersets/blazepose33.toml")


@pytest.fixture(scope="module")
def model(markerset):
    return attach(read_osim(ROOT / "models/bodies/fullbody_female.osim"), markerset)


def pose(model, markerset, random):
    """A pose with bent joints, and what the priors believe drawn as they believe it."""
    q = np.tile(model.coordinates.default, (SAMPLES, 1))
    for name, value in {"knee_angle_r": 0.9, "knee_angle_l": 0.4, "elbow_flex_r": 0.8, "elbow_flex_l": 0.8}.items():
        q[:, model.coordinates.index(name)] = value
    for prior in markerset.priors:
        spread = 0.2 * prior.sd  # a fifth: the linear propagation is tested, not the bounds and the sines
        q[:, model.coordinates.index(prior.coordinate)] = prior.value + spread * random.normal(size=SAMPLES)
    return q


def test_the_predicted_spread_is_the_spread_of_repeated_trials(model, markerset):
    random = np.random.default_rng(4)
    q = pose(model, markerset, random)
    # Different noise in each direction and at each point, correlated within a point as triangulation makes it.
    shape = 0.002 * random.normal(size=(len(model.markers.names), 3, 3))
    noise_m = np.einsum("mij,fmj->fmi", shape, random.normal(size=(SAMPLES, len(model.markers.names), 3)))
    covariance_m2 = np.tile(shape @ shape.transpose(0, 2, 1), (SAMPLES, 1, 1, 1))
    tasks = make_tasks(model, markerset)
    tasks = replace(tasks, target_sd=0.2 * tasks.target_sd)
    seen = marker_positions(model, q) + noise_m
    motion = solve_motion(model, tasks, seen, np.arange(SAMPLES) / 60)
    motion = add_covariance(motion, model, tasks, seen, covariance_m2)
    assert motion.covariance is not None
    predicted = np.sqrt(np.einsum("fcc->fc", motion.covariance))
    normalised = (motion.values - q) / predicted
    # χ² of 4000 samples: 1 ± √(2/4000) = 1 ± 0.022, three of that for forty coordinates, and the curvature's share.
    assert np.abs(np.mean(normalised**2, axis=0) - 1).max() < 0.12
    inside = np.mean(np.abs(normalised) < 1.96, axis=0)
    assert np.all((inside > 0.93) & (inside < 0.97))
    pair = [model.coordinates.index("hip_flexion_r"), model.coordinates.index("knee_angle_r")]
    error = (motion.values - q)[:, pair]
    claimed = motion.covariance[:, pair[0], pair[1]].mean()
    assert np.mean(error[:, 0] * error[:, 1]) == pytest.approx(claimed, rel=0.15)


def test_what_is_unknown_has_no_covariance(model, markerset):
    q = np.tile(model.coordinates.default, (3, 1))
    seen = marker_positions(model, q)
    for name in ("left_knee", "left_ankle", "left_heel", "left_foot_index"):
        seen[1, model.markers.index(name)] = np.nan
    seen[2] = np.nan
    tasks = make_tasks(model, markerset)
    noise = np.tile(1e-6 * np.eye(3), (3, 33, 1, 1))
    motion = add_covariance(solve_motion(model, tasks, seen, np.arange(3.0)), model, tasks, seen, noise)
    assert motion.covariance is not None
    knee, other = model.coordinates.index("knee_angle_l"), model.coordinates.index("knee_angle_r")
    assert np.isnan(motion.covariance[1, knee]).all()
    assert np.isfinite(motion.covariance[1, other, other])
    assert np.isnan(motion.covariance[2]).all()


def test_dependent_coordinates_follow_their_source():
    model = read_osim(ROOT / "tests/golden/all_joints.osim")
    q = np.full((1, len(model.coordinates.names)), 0.2)
    seen = marker_positions(model, q)
    flat = np.zeros(q.shape[1])
    tasks = Tasks(
        marker_weights=np.ones(seen.shape[1]),
        coordinate_weights=flat + 1e-6,
        coordinate_targets=q[0],
        target_sd=flat,
    )
    noise = np.tile(1e-6 * np.eye(3), (1, seen.shape[1], 1, 1))
    motion = add_covariance(solve_motion(model, tasks, seen, np.zeros(1)), model, tasks, seen, noise)
    assert motion.covariance is not None
    source, follower = model.coordinates.index("c1"), model.coordinates.index("d1")
    variance = np.diag(motion.covariance[0])
    # d1 = 1.5 · spline(c1): fully correlated with c1.
    assert motion.covariance[0, source, follower] ** 2 == pytest.approx(variance[source] * variance[follower])


def test_wrong_shapes_are_refused(model, markerset):
    q = np.tile(model.coordinates.default, (2, 1))
    seen = marker_positions(model, q)
    tasks = make_tasks(model, markerset)
    motion = solve_motion(model, tasks, seen, np.arange(2.0))
    with pytest.raises(InputError, match="covariances"):
        add_covariance(motion, model, tasks, seen, np.zeros((2, 5, 3, 3)))


def test_standard_deviations_alone_are_the_roots_of_the_diagonal(model, markerset):
    q = np.tile(model.coordinates.default, (3, 1))
    seen = marker_positions(model, q)
    seen[2] = np.nan
    tasks = make_tasks(model, markerset)
    noise = np.tile(1e-6 * np.eye(3), (3, 33, 1, 1))
    solved = solve_motion(model, tasks, seen, np.arange(3.0))
    whole = add_covariance(solved, model, tasks, seen, noise)
    short = add_covariance(solved, model, tasks, seen, noise, whole=False)
    assert whole.covariance is not None
    assert short.covariance is None
    np.testing.assert_allclose(short.sd, np.sqrt(np.einsum("fcc->fc", whole.covariance)), rtol=1e-12)
    for angle in find_clinical_angles(model):
        np.testing.assert_allclose(clinical_sd_deg(short, angle), clinical_sd_deg(whole, angle), rtol=1e-12)
