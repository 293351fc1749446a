"""Error bars of angles and torques: what the errors of a motion become behind the filter, the derivatives and the mechanics.

Filtering and differentiating are linear, so an error e of the coordinates becomes S₀e, S₁e, S₂e in positions, rates and
accelerations, with the impulse responses s of the very operations that were used. If the errors of frames k and l are
correlated by ρ(k − l), then in each frame

    cov(δq, δq̇, δq̈) = W ⊗ C,      Wᵢⱼ = Σ_kl sᵢ(k) sⱼ(l) ρ(k − l)

with C the covariance of the coordinates in one frame, and torques follow by the delta method, τ = τ(q, q̇, q̈). A white error
and one that lasts have very different W: what is averaged away in an angle, or blown up in an acceleration, is decided there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import toeplitz

from gonio.kernel.dynamics.opensim import differentiate
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.records import BodyModel

RESPONSE_S = 2.0
"""How far an impulse is followed: a low-pass of 2 Hz or more has forgotten it after a second."""

STEPS = (1e-5, 1e-4, 1e-3)
"""Steps of the finite differences in position, rate and acceleration; rad or m, and per s, per s²."""


@dataclass(frozen=True)
class ErrorBars:
    """Standard deviations, frame by frame."""

    q: Float[np.ndarray, "frame coordinate"]  # of the filtered coordinates, rad and m
    forces: Float[np.ndarray, "frame coordinate"]  # of the generalized forces, Nm and N


def propagate(
    model: BodyModel,
    motion: tuple[Float[np.ndarray, "frame coordinate"], ...],
    covariance: Float[np.ndarray, "frame coordinate coordinate"],
    *,
    rate_hz: float,
    cutoff_hz: float | None,
    correlation_s: float = 0.0,
    wrenches: tuple[Wrench, ...] = (),
) -> ErrorBars:
    """Give the error bars of a motion's angles and torques.

    Args:
        model: The body.
        motion: Filtered positions, rates and accelerations.
        covariance: Of the coordinates before the filter, in each frame; NaN gives NaN.
        rate_hz: Of the frames.
        cutoff_hz: Of the filter; None if there was none.
        correlation_s: How long an error of the coordinates lasts: it falls to 1/e in that time. 0 for white errors.
        wrenches: What pushes from outside; taken as known.
    """
    W = filter_covariance(rate_hz, cutoff_hz, correlation_s)
    variance_q = W[0, 0] * np.diagonal(covariance, axis1=1, axis2=2)
    by_state = _force_jacobians(model, motion, wrenches)
    variance = np.zeros(motion[0].shape)
    for i in range(3):
        for j in range(3):
            variance += W[i, j] * np.einsum("fac,fcd,fad->fa", by_state[i], covariance, by_state[j], optimize=True)
    return ErrorBars(q=np.sqrt(variance_q), forces=np.sqrt(np.maximum(variance, 0.0)))


def filter_covariance(rate_hz: float, cutoff_hz: float | None, correlation_s: float) -> Float[np.ndarray, "3 3"]:
    """Give W for errors of unit variance, in the middle of a long trial."""
    reach = int(np.ceil(RESPONSE_S * rate_hz))
    count = 2 * reach + 1
    impulses = np.zeros((count, count))
    np.fill_diagonal(impulses, 1.0)
    # One column an impulse; the middle row of the output is the response of the middle frame to each.
    smooth = differentiate(np.arange(count) / rate_hz, impulses, cutoff_hz, (reach / rate_hz, reach / rate_hz + 1e-9))
    responses = np.stack([smooth.q[0], smooth.velocity[0], smooth.acceleration[0]])
    lag_s = np.arange(count) / rate_hz
    correlation = toeplitz(np.exp(-lag_s / correlation_s)) if correlation_s > 0 else np.eye(count)
    return responses @ correlation @ responses.T


def _force_jacobians(
    model: BodyModel, motion: tuple[Float[np.ndarray, "frame coordinate"], ...], wrenches: tuple[Wrench, ...]
) -> list[Float[np.ndarray, "frame coordinate coordinate"]]:
    """Give ∂τ/∂q, ∂τ/∂q̇ and ∂τ/∂q̈ by central differences; dependent and locked coordinates have columns of zeros."""
    frames, count = motion[0].shape
    jacobians = [np.zeros((frames, count, count)) for _ in motion]
    moving = np.flatnonzero((model.coordinates.coupled_to < 0) & ~model.coordinates.locked)
    for order, step in enumerate(STEPS):
        for column in moving:
            sides = []
            for sign in (1.0, -1.0):
                state = [part.copy() for part in motion]
                state[order][:, column] += sign * step
                sides.append(solve_dynamics(model, state[0], state[1], state[2], wrenches).forces)
            jacobians[order][:, :, column] = (sides[0] - sides[1]) / (2 * step)
    return jacobians
