"""A periodic motion as a few harmonics of the stride: known exactly, with all its derivatives, at any time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.records import Walk

ORDERS = 12
"""Harmonics of the stride: up to 11 Hz in ordinary walking. Marker tracks of walkers hold next to nothing beyond."""


class Basis(NamedTuple):
    """The functions that harmonics multiply (1, cosines, sines), and their derivatives with respect to time."""

    value: Float[np.ndarray, "time harmonic"]
    first: Float[np.ndarray, "time harmonic"]
    second: Float[np.ndarray, "time harmonic"]


class Course(NamedTuple):
    """Coordinates over time (rad, m), their rates, and the rates' rates."""

    q: Float[np.ndarray, "time coordinate"]
    velocity: Float[np.ndarray, "time coordinate"]
    acceleration: Float[np.ndarray, "time coordinate"]


def harmonic_basis(times_s: Float[np.ndarray, " time"], stride_s: float, orders: int) -> Basis:
    """Evaluate 1, cos kωt and sin kωt for k = 1 … ``orders``, ω = 2π / stride."""
    rate = 2 * np.pi / stride_s * np.arange(1, orders + 1)
    cosine, sine = np.cos(np.outer(times_s, rate)), np.sin(np.outer(times_s, rate))
    one = np.ones((len(times_s), 1))
    return Basis(
        value=np.hstack([one, cosine, sine]),
        first=np.hstack([0 * one, -rate * sine, rate * cosine]),
        second=np.hstack([0 * one, -(rate**2) * cosine, -(rate**2) * sine]),
    )


def coordinates_at(walk: Walk, times_s: Float[np.ndarray, " time"]) -> Course:
    """Give the walker's coordinates and their first two derivatives at any times, exactly."""
    basis = harmonic_basis(times_s, walk.steps.stride_s, len(walk.harmonics) // 2)
    q, velocity, acceleration = (functions @ walk.harmonics for functions in basis)
    forward = walk.body.coordinates.index("pelvis_tx")
    q[:, forward] += walk.start_m + walk.steps.speed_m_s * times_s
    velocity[:, forward] += walk.steps.speed_m_s
    return Course(q, velocity, acceleration)
