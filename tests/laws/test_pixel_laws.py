"""The fit to pixels: its gradient is the derivative of its cost, for every kind of unknown; its Hessian is symmetric."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach
from gonio.kernel.body.tree import flatten
from gonio.kernel.geometry.cameras import project, projection_matrices, undistort_rig
from gonio.kernel.kinematics.pixel_priors import make_priors
from gonio.kernel.kinematics.pixel_system import (
    State,
    Step,
    Trial,
    as_change,
    frame_covariance,
    gradient_of,
    linearise,
    personalise,
    prepare_step,
    residuals_px,
    shape_body,
    shared_covariance,
)
from gonio.kernel.kinematics.pixel_terms import GRADIENT
from gonio.pipeline.body import choose_markerset
from gonio.records import Rig
from gonio.resources import models_dir
from gonio.vision.model_cards import load_card

FRAMES = 7
LOSS = 2.0


@pytest.fixture(scope="module")
def trial_and_state(rig: Rig) -> tuple[Trial, State]:
    """A trial of seven frames around a random pose, with outliers, gaps, geometry and biases that are not zero."""
    card = load_card("blazepose_heavy").keypoints
    assert card is not None
    generic = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    markerset = choose_markerset(generic, card.names)
    model = attach(generic, markerset)
    rng = np.random.default_rng(1)
    q = np.tile(model.coordinates.default, (FRAMES, 1))
    q += np.where(model.coordinates.rotational, 0.4, 0.05) * rng.normal(size=q.shape[1])
    q += 0.02 * rng.normal(size=q.shape)
    uv = undistort_rig(rig, np.stack([project(c, marker_positions(model, q)) for c in rig.cameras]))
    uv += rng.normal(0, 6, uv.shape)
    confidence = np.where(rng.random(uv.shape[:3]) < 0.2, 0.0, rng.uniform(0.4, 1.0, uv.shape[:3]))
    priors = make_priors(model, markerset, rig, 60.0, np.full(len(rig.cameras), 5.0))
    trial = Trial(
        model=model,
        projections=projection_matrices(rig),
        uv_px=uv,
        confidence=confidence,
        consecutive=np.ones(FRAMES, dtype=bool),
        priors=priors,
        free=np.flatnonzero(~priors.held),
    )
    cameras, _, markers = confidence.shape
    state = State(
        q=q,
        log_scale=0.03 * rng.normal(size=len(priors.group_sd)),
        offset_m=0.01 * rng.normal(size=(markers, 3)),
        bias_px=2.0 * rng.normal(size=(cameras, markers, 2)),
    )
    return trial, state


SIGMA_PX = np.array([3.0, 4.0, 5.0, 6.0])


def nudged(state: State, kind: str, index: tuple[int, ...], by: float) -> State:
    values = getattr(state, kind).copy()
    values[index] += by
    return replace(state, **{kind: values})


@pytest.mark.parametrize("kind", ["q", "log_scale", "offset_m", "bias_px"])
def test_the_gradient_is_the_derivative_of_the_cost(trial_and_state: tuple[Trial, State], kind: str) -> None:
    trial, state = trial_and_state
    equations = linearise(trial, state, SIGMA_PX, LOSS, shared=True)
    frame_gradient = np.zeros_like(state.q)
    frame_gradient[:, trial.free] = equations.data.gradient + equations.prior_gradient
    shared = equations.data.shared_gradient + equations.prior_shared_gradient
    groups, markers = len(state.log_scale), state.offset_m.size
    analytic = {
        "q": frame_gradient,
        "log_scale": shared[:groups],
        "offset_m": shared[groups : groups + markers].reshape(-1, 3),
        "bias_px": shared[groups + markers :].reshape(state.bias_px.shape),
    }[kind]
    rng = np.random.default_rng(2)
    # Central differences of a cost of some thousands: rounding ~ 1e-16 · 1e4 / step against truncation ~ step².
    step = 1e-3 if kind == "bias_px" else 1e-6
    for _ in range(30):
        index = tuple(int(rng.integers(n)) for n in analytic.shape)
        if kind == "q":
            index = (index[0], int(rng.choice(trial.free)))
        costs = [
            linearise(trial, nudged(state, kind, index, sign * step), SIGMA_PX, LOSS, shared=True).cost
            for sign in (1, -1)
        ]
        slope = (costs[0] - costs[1]) / (2 * step)
        assert analytic[index] == pytest.approx(-slope, rel=2e-4, abs=2e-4 * np.abs(analytic).max())


def test_the_normal_matrix_is_positive_semidefinite_with_its_border(trial_and_state: tuple[Trial, State]) -> None:
    trial, state = trial_and_state
    sums = linearise(trial, state, SIGMA_PX, LOSS, shared=True).data
    np.testing.assert_array_equal(np.triu(sums.hessian, 1), 0.0)  # only the lower half is filled
    np.testing.assert_allclose(sums.corner, sums.corner.T, rtol=1e-9, atol=1e-6)
    # Gauss-Newton's whole matrix is a sum of squares: none of its eigenvalues is negative.
    frames, size, shared = sums.border.shape
    whole = np.zeros((frames * size + shared,) * 2)
    for f in range(frames):
        rows = slice(f * size, (f + 1) * size)
        whole[rows, rows] = sums.hessian[f] + np.tril(sums.hessian[f], -1).T
        whole[rows, frames * size :] = sums.border[f]
        whole[frames * size :, rows] = sums.border[f].T
    whole[frames * size :, frames * size :] = sums.corner
    values = np.linalg.eigvalsh(whole)
    assert values.min() > -1e-9 * values.max()


def test_the_covariance_is_the_inverse_of_the_normal_matrix(trial_and_state: tuple[Trial, State]) -> None:
    trial, state = trial_and_state
    equations = linearise(trial, state, SIGMA_PX, LOSS, shared=True)
    shared, factor = shared_covariance(trial, equations, 1.0)
    covariance = frame_covariance(trial, equations, 1.0, shared)
    np.testing.assert_allclose(
        frame_covariance(trial, equations, 1.0, shared, factor), covariance, rtol=1e-7, atol=1e-12
    )
    inverse = Step(trial, shared_covariance(trial, equations, 1.0)[1])
    rough = prepare_step(trial, equations, 0.0, shared=True)  # of single precision: the way down, not a covariance
    for frame, unknown in ((0, 0), (3, 7), (6, 12)):
        right = np.zeros_like(gradient_of(equations, shared=True))
        right[frame * len(trial.free) + unknown] = 1.0
        column = as_change(trial, inverse.of(right)).q[frame, trial.free]
        np.testing.assert_allclose(covariance[frame, :, unknown], column, rtol=1e-5, atol=1e-9)
        nearly = as_change(trial, rough.of(right)).q[frame, trial.free]
        np.testing.assert_allclose(nearly, column, atol=1e-4 * np.abs(column).max())


@pytest.mark.parametrize("shared", [True, False])
def test_less_than_the_normal_equations_is_the_same_as_their_part(
    trial_and_state: tuple[Trial, State], shared: bool
) -> None:
    trial, state = trial_and_state
    whole = linearise(trial, state, SIGMA_PX, LOSS, shared=shared)
    part = linearise(trial, state, SIGMA_PX, LOSS, shared=shared, order=GRADIENT)
    assert part.cost == pytest.approx(whole.cost, rel=1e-12)
    np.testing.assert_allclose(gradient_of(part, shared=shared), gradient_of(whole, shared=shared), rtol=1e-9)
    np.testing.assert_allclose(residuals_px(trial, state), whole.data.error_px, rtol=1e-12)


def test_the_body_in_a_state_s_shape_is_the_personal_model_laid_out(trial_and_state: tuple[Trial, State]) -> None:
    trial, state = trial_and_state
    ours, whole = shape_body(trial, state), flatten(personalise(trial.model, trial.priors, state))
    for name in ("nodes", "markers"):
        one, other = getattr(ours, name), getattr(whole, name)
        for field in one.dtype.names:
            np.testing.assert_allclose(one[field], other[field], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(ours.coefficients, whole.coefficients, rtol=1e-12, atol=1e-15)
    assert np.abs(state.log_scale).max() > 0.01  # a shape of its own
