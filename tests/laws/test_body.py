"""Laws of forward and inverse kinematics, for every kind of joint and function."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import body_poses, couple, marker_jacobian, marker_positions
from gonio.kernel.body.functions import piecewise_linear, polynomial, scaled, simm_spline, stack
from gonio.kernel.body.tree import PIECE, evaluate, flatten
from gonio.kernel.kinematics.inverse import pose_problem
from gonio.kernel.kinematics.newton import linearise, make_workspace
from gonio.records import Tasks

ROOT = Path(__file__).resolve().parents[2]
FILES = [ROOT / "tests/golden/all_joints.osim", ROOT / "models/bodies/fullbody_male.osim"]
SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module", params=FILES, ids=lambda path: path.stem)
def model(request):
    return read_osim(request.param)


def random_pose(model, seed):
    return np.random.default_rng(seed).normal(size=len(model.coordinates.names))


def finite_difference(function, q, step=1e-5):
    """Central differences of an array-valued function, derivative index last."""
    columns = []
    for index in range(len(q)):
        shift = np.zeros(len(q))
        shift[index] = step
        columns.append((function(q + shift) - function(q - shift)) / (2 * step))
    return np.stack(columns, axis=-1)


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_marker_jacobian_is_the_finite_difference(model, seed):
    q = random_pose(model, seed)
    numeric = finite_difference(lambda at: marker_positions(model, at[None])[0], q)
    # Central differences of step h err by h²/6 · third derivative (lengths of metres: 1e-10) and rounding 1e-15/h.
    # A knot of a spline within h breaks that: second derivatives jump there by up to 1 m/rad², so h · 1 = 1e-5.
    np.testing.assert_allclose(marker_jacobian(model, q[None])[0], numeric, rtol=0, atol=2e-5)


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_gradient_and_newton_matrix_are_the_finite_differences_of_the_cost(model, seed):
    random = np.random.default_rng(seed)
    q = random_pose(model, seed)
    observed = marker_positions(model, q[None])[0] + 0.1 * random.normal(size=(len(model.markers.names), 3))
    observed[0] = np.nan
    weights = random.uniform(0, 3, size=len(observed))
    free = np.ones(len(q))
    tasks = Tasks(marker_weights=weights, coordinate_weights=0.1 * free, coordinate_targets=0.2 * free)
    problem = pose_problem(model, tasks, 1e-6, 100)
    work = make_workspace(problem.tree)

    def cost(at):
        return linearise(problem, observed, weights, at.copy(), True, work)

    def gradient(at):
        cost(at)
        return work.unknowns["gradient"].copy()

    independent = model.coordinates.coupled_to < 0
    expected = finite_difference(cost, q)
    np.testing.assert_allclose(gradient(q)[independent], expected[independent], rtol=0, atol=1e-4)
    expected = finite_difference(gradient, q)
    cost(q)
    pick = np.ix_(independent, independent)
    # The tolerance leaves room for a knot inside the difference, as above; a missing term would be of order 0.1 to 1.
    assert np.mean(np.abs(work.hessian[pick] - expected[pick]) > 1e-4) < 0.01
    np.testing.assert_allclose(work.hessian, work.hessian.T, atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_gauss_newton_matrix_is_the_sum_over_marker_jacobians(model, seed):
    q = random_pose(model, seed)
    weights = np.random.default_rng(seed).uniform(0, 3, size=len(model.markers.names))
    nothing = np.zeros(len(q))
    tasks = Tasks(marker_weights=weights, coordinate_weights=nothing, coordinate_targets=nothing)
    problem = pose_problem(model, tasks, 1e-6, 100)
    work = make_workspace(problem.tree)
    linearise(problem, np.zeros((len(weights), 3)), weights, q.copy(), False, work)
    jacobian = marker_jacobian(model, q[None])[0]
    expected = np.einsum("m,mia,mib->ab", weights, jacobian, jacobian) / weights.sum()
    np.testing.assert_allclose(work.hessian, expected, rtol=0, atol=1e-10 * max(1.0, np.abs(expected).max()))


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_poses_are_rigid_and_dependent_coordinates_ignored(model, seed):
    q = random_pose(model, seed)
    poses = body_poses(model, q[None])[0]
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12
    )
    assert np.all(np.linalg.det(rotation) > 0)
    np.testing.assert_allclose(body_poses(model, couple(model, q[None]))[0], poses, atol=1e-12)


def test_moving_the_root_moves_everything():
    model = read_osim(FILES[1])
    q = np.tile(model.coordinates.default, (2, 1))
    q[1, model.coordinates.index("pelvis_tx")] += 2.5
    before, after = marker_positions(model, q)
    np.testing.assert_allclose(after - before, np.tile([2.5, 0, 0], (len(before), 1)), atol=1e-12)


KNOTS = st.lists(st.floats(-1, 1), min_size=4, max_size=9)
FUNCTIONS = {
    "polynomial": lambda y: polynomial(np.array(y)),
    "line": lambda y: polynomial(np.array(y[:2])),
    "piecewise linear": lambda y: piecewise_linear(np.arange(len(y)) * 0.7, np.array(y)),
    "simm spline": lambda y: simm_spline(np.arange(len(y)) * 0.7, np.array(y)),
    "multiplied": lambda y: scaled(simm_spline(np.arange(len(y)) * 0.7, np.array(y)), -1.7),
}


@pytest.mark.parametrize("kind", FUNCTIONS)
@settings(max_examples=30, deadline=None)
@given(y=KNOTS, x=st.floats(-3, 8))
def test_derivatives_of_every_coupling_function_are_finite_differences(kind, y, x):
    functions = stack([polynomial(np.zeros(1)), FUNCTIONS[kind](y)])
    tree = function_tree(functions)
    if np.min(np.abs(functions.piece_from[np.isfinite(functions.piece_from)] - x), initial=np.inf) < 1e-3:
        return  # at a knot a piecewise line has no derivative
    value, first, second = evaluate(tree, 1, x)
    step = 1e-4
    below, above = evaluate(tree, 1, x - step)[0], evaluate(tree, 1, x + step)[0]
    size = max(1.0, abs(value), abs(first), abs(second)) * 10
    assert first == pytest.approx((above - below) / (2 * step), abs=1e-6 * size * (1 + abs(x)) ** 8 / 100)
    assert second == pytest.approx((above - 2 * value + below) / step**2, abs=1e-5 * size * (1 + abs(x)) ** 8 / 100)


@settings(max_examples=30, deadline=None)
@given(y=KNOTS)
def test_the_spline_goes_through_its_knots_smoothly_and_on_straight(y):
    x = np.arange(len(y)) * 0.7
    tree = function_tree(stack([simm_spline(x, np.array(y))]))
    for knot, value in zip(x, y, strict=True):
        left, right = evaluate(tree, 0, knot - 1e-9), evaluate(tree, 0, knot + 1e-9)
        assert left[0] == pytest.approx(value, abs=1e-6)
        assert right[1] == pytest.approx(left[1], abs=1e-6)
    assert evaluate(tree, 0, -5.0)[2] == 0.0
    assert evaluate(tree, 0, x[-1] + 5.0)[2] == 0.0


def function_tree(functions):
    """A tree of nothing but functions."""
    pieces = np.empty(len(functions.origin), dtype=PIECE)
    pieces["start"], pieces["origin"] = functions.piece_from, functions.origin
    return flatten(read_osim(FILES[1]))._replace(
        first_piece=np.array(functions.first_piece), pieces=pieces, coefficients=np.array(functions.coefficients)
    )
