"""Error bars of angles and torques: what the errors of a motion become behind the filter, the derivatives and the mechanics.

Filtering and differentiating are linear: an error e of the coordinates in the samples k becomes, in a frame,

    δx_i = Σ_k s_i(k) e(k),        i = 0, 1, 2 for positions, rates and accelerations

with the impulse responses s_i of the very operation that was used, found by giving it impulses. At the ends of a trial they
differ from those in its middle. Errors of two samples are correlated by ρ, so if the coordinate a has the standard
deviation σ_a(k), and its errors are correlated with those of b by r_ab in the frame,

    cov(δx_ia, δx_jb) = r_ab Σ_kl s_i(k) σ_a(k) ρ(t_k − t_l) σ_b(l) s_j(l)

which is exact for any σ(k) where r_ab does not change. Torques follow by the delta method, τ = τ(q, q̇, q̈). A white error and
one that lasts have very different bars: what is averaged away in an angle, or blown up in an acceleration, is decided by ρ.

Bars tell of the errors that the motion had, not of what the filter takes from the truth. In the first and in the last sample
of a trial OpenSim's reflection makes every acceleration 0: their torques are wrong, with bars that are too small.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.recursive import Wrench, solve_dynamics
from gonio.records import BodyModel

Smoother: TypeAlias = Callable[[Float[np.ndarray, " sample"], Float[np.ndarray, "sample column"]], SmoothMotion]
"""What made the motion of its samples: ``differentiate`` of :mod:`opensim` or :mod:`zero_lag` with their settings bound."""

Correlation: TypeAlias = Callable[[Float[np.ndarray, " *lag"]], Float[np.ndarray, " *lag"]]
"""How the errors of samples are correlated that are so many seconds apart: 1 at 0, and even."""

REACH_S = 2.0
"""How far a sample's effect is followed: a low-pass of 2 Hz or more has forgotten it after a second."""

NEGLIGIBLE = 1e-6
"""A sample whose effects are all smaller than this share of the largest ones is left out of a frame's sum."""

UNKNOWN_SHARE = 0.01
"""A frame has no error bar if more than this share of its position comes from samples that have none."""

WINDOW_FRAMES = 256  # frames whose responses are found together; with the reach on either side of them

STEPS = (1e-5, 1e-4, 1e-3)
"""Steps of the finite differences in position, rate and acceleration; rad or m, and per s, per s²."""


@dataclass(frozen=True)
class ErrorBars:
    """Standard deviations, frame by frame; NaN where they are not known."""

    q: Float[np.ndarray, "frame coordinate"]  # of the filtered coordinates, rad and m
    forces: Float[np.ndarray, "frame coordinate"]  # of the generalized forces, Nm and N


def white(lag_s: Float[np.ndarray, " *lag"]) -> Float[np.ndarray, " *lag"]:
    """Correlate nothing: each sample has an error of its own."""
    return (lag_s == 0).astype(float)


def lasting(decay_s: float) -> Correlation:
    """Correlate errors that last: the correlation falls to 1/e in ``decay_s`` (a Gauss-Markov process)."""
    return lambda lag_s: np.exp(-np.abs(lag_s) / decay_s)


def propagate(
    model: BodyModel,
    motion: SmoothMotion,
    smoother: Smoother,
    times_s: Float[np.ndarray, " sample"],
    covariance: Float[np.ndarray, "sample coordinate coordinate"],
    *,
    correlation: Correlation = white,
    wrenches: tuple[Wrench, ...] = (),
) -> ErrorBars:
    """Give the error bars of a motion's angles and torques.

    Args:
        model: The body.
        motion: What ``smoother`` made of the samples, all of it or a time range.
        smoother: The operation, linear in the values.
        times_s: Of the samples, those outside of the motion's time range too: they have a part in what is inside.
        covariance: Of the coordinates in each sample, rad and m, before the smoothing; 0 for what is known, NaN for what is
            not. A frame near a NaN is NaN, and so are the torques in which such a coordinate has a part.
        correlation: Of the errors over time.
        wrenches: What pushes from outside, at the motion's times; taken as known.

    Raises:
        InputError: the covariances are not those of the samples.
    """
    if covariance.shape != (len(times_s), motion.q.shape[1], motion.q.shape[1]):
        raise InputError(
            f"{len(times_s)} samples of {motion.q.shape[1]} coordinates have covariances of shape {covariance.shape}.",
            hint="Give the covariance of the coordinates in each sample.",
        )
    frames, count = motion.q.shape
    by_state = force_jacobians(model, motion, wrenches)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    unknown, sd = np.isnan(sd), np.nan_to_num(sd)
    q_sd, force_sd = np.empty((frames, count)), np.empty((frames, count))
    nearest = np.argmin(np.abs(motion.times_s[:, None] - times_s), axis=1) if frames else np.empty(0, dtype=int)
    for frame, first, response in _responses(motion.times_s, times_s, smoother):
        near = slice(first, first + response.shape[1])
        rho = correlation(times_s[near, None] - times_s[near])
        parts = (response[:, None] * sd[near].T).reshape(3 * count, -1)
        joint = (parts @ rho @ parts.T).reshape(3, count, 3, count)
        joint *= _correlations(covariance[nearest[frame]])[:, None]
        lost = np.abs(response[0]) @ unknown[near] > UNKNOWN_SHARE * np.abs(response[0]).sum()
        J = by_state[frame]
        variance = np.einsum("fia,iajb,fjb->f", J, joint, J, optimize=True)
        q_sd[frame] = np.where(lost, np.nan, np.sqrt(np.diagonal(joint[0, :, 0])))
        force_sd[frame] = np.where((J[:, :, lost] != 0).any(axis=(1, 2)), np.nan, np.sqrt(np.maximum(variance, 0.0)))
    return ErrorBars(q=q_sd, forces=force_sd)


def _correlations(covariance: Float[np.ndarray, "coordinate coordinate"]) -> Float[np.ndarray, "coordinate coordinate"]:
    """Give the correlations between the coordinates of one sample; none where one is known exactly, or not known."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    certain = ~(sd > 0)
    found = covariance / np.where(certain, np.inf, sd)[:, None] / np.where(certain, np.inf, sd)
    return np.where(np.eye(len(sd), dtype=bool), 1.0, np.nan_to_num(found))


def _responses(
    frame_times_s: Float[np.ndarray, " frame"], times_s: Float[np.ndarray, " sample"], smoother: Smoother
) -> Iterator[tuple[int, int, Float[np.ndarray, "3 sample"]]]:
    """Give for each frame the first sample that it depends on, and its responses to that one and the next ones.

    Responses are found window by window, so that a long trial costs no more a frame than a short one.
    """
    for start in range(0, len(frame_times_s), WINDOW_FRAMES):
        inside_s = frame_times_s[start : start + WINDOW_FRAMES]
        first = int(np.searchsorted(times_s, inside_s[0] - REACH_S))
        stop = int(np.searchsorted(times_s, inside_s[-1] + REACH_S, side="right"))
        answer = smoother(times_s[first:stop], np.eye(stop - first))
        # A window of uneven times has its own uniform clock, within half a step of the trial's.
        rows = np.argmin(np.abs(inside_s[:, None] - answer.times_s), axis=1)
        window = np.stack([answer.q[rows], answer.velocity[rows], answer.acceleration[rows]], axis=1)
        for offset, response in enumerate(window):
            size = np.abs(response)
            matters = np.flatnonzero((size > NEGLIGIBLE * size.max(axis=1, keepdims=True)).any(axis=0))
            yield start + offset, first + int(matters[0]), response[:, matters[0] : matters[-1] + 1]


def force_jacobians(
    model: BodyModel, motion: SmoothMotion, wrenches: tuple[Wrench, ...]
) -> Float[np.ndarray, "frame coordinate 3 coordinate"]:
    """Give ∂τ/∂(q, q̇, q̈) by central differences; dependent and locked coordinates have columns of zeros."""
    states = (motion.q, motion.velocity, motion.acceleration)
    jacobian = np.zeros((*motion.q.shape, 3, motion.q.shape[1]))
    moving: Bool[np.ndarray, " coordinate"] = (model.coordinates.coupled_to < 0) & ~model.coordinates.locked
    for order, step in enumerate(STEPS):
        for column in np.flatnonzero(moving):
            sides: list[Float[np.ndarray, "frame coordinate"]] = []
            for sign in (1.0, -1.0):
                shifted = [part.copy() for part in states]
                shifted[order][:, column] += sign * step
                sides.append(solve_dynamics(model, shifted[0], shifted[1], shifted[2], wrenches).forces)
            jacobian[:, :, order, column] = (sides[0] - sides[1]) / (2 * step)
    return jacobian
