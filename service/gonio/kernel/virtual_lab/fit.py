"""Find the walk: a periodic motion near what is wanted, that stands on its feet and that the ground can carry.

The idea is that of residual elimination [Remy & Thelen 2009, J Biomech Eng 131:031005]: trade a little of the angles for
dynamics that hold. Here the motion is a sum of harmonics of the stride, and one least-squares problem, solved by
Gauss-Newton's method, holds all of it together: feet, ground forces and their place, and the lead.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from gonio.errors import SolverError
from gonio.kernel.body.soles import Sole, mark_soles
from gonio.kernel.virtual_lab.harmonics import ORDERS, Basis, Course, harmonic_basis
from gonio.kernel.virtual_lab.terms import Term, carry, clear, see_soles, stand
from gonio.kernel.virtual_lab.wanted import Wanted, spread
from gonio.records import BodyModel, Steps

NODES = 84  # seven for each wave of the highest harmonic
ROUGH_ORDER = 5  # from here on harmonics cost more than their lead's tolerance, with the sixth power of their order
MAX_ITERATIONS = 15
CONVERGED = 1e-3  # of the cost, in a step: what is left to gain is worth nothing


def node_phases() -> Float[np.ndarray, " node"]:
    """Give the stride phases at which the walk is held to what it must obey."""
    return np.arange(NODES) / NODES


def fit_harmonics(
    body: BodyModel, steps: Steps, sole: Sole, wanted: Wanted
) -> Float[np.ndarray, "harmonic coordinate"]:
    """Find the harmonics of the coordinates, in the frame that walks along at the mean speed.

    Args:
        body: The walker.
        steps: Where and when it steps.
        sole: Its feet.
        wanted: Its lead at :func:`node_phases`.

    Raises:
        SolverError: no walk was found near the lead.
    """
    phase, marked = node_phases(), mark_soles(body)
    basis = harmonic_basis(phase * steps.stride_s, steps.stride_s, ORDERS)
    lead = _project(basis, wanted.q)
    sd = spread(body)
    free = np.flatnonzero(sd)
    precision = _prior(sd[free])

    def demand(harmonics: Float[np.ndarray, "harmonic coordinate"]) -> tuple[list[Term], float]:
        course = Course(*(functions @ harmonics for functions in basis))
        soles = see_soles(marked, course.q, free)
        terms = [
            *stand(steps, sole, phase, soles),
            *clear(steps, sole, phase, soles),
            carry(body, course, wanted, free),
        ]
        cost = sum(float((term.residual**2).sum()) for term in terms) / NODES
        return terms, cost + float((precision * (harmonics - lead)[:, free] ** 2).sum())

    harmonics = lead.copy()
    terms, cost = demand(harmonics)
    for _ in range(MAX_ITERATIONS):
        step = _gauss_newton(basis, terms, precision, (harmonics - lead)[:, free])
        before = cost
        for share in (1.0, 0.5, 0.25, 0.125):
            trial = harmonics.copy()
            trial[:, free] += share * step
            terms, cost = demand(trial)
            if cost < before:
                break
        harmonics = trial
        if before - cost < CONVERGED * before:
            return harmonics
    raise SolverError(
        "No walk was found for this body and these steps.",
        hint="Choose a speed nearer to comfortable walking, or a milder limp.",
        code="walk-not-found",
        cost=cost,
    )


def _project(basis: Basis, q: Float[np.ndarray, "node coordinate"]) -> Float[np.ndarray, "harmonic coordinate"]:
    """Give the harmonics nearest to a course: on evenly spread nodes the basis functions are orthogonal."""
    return basis.value.T @ q / (basis.value**2).sum(axis=0)[:, None]


def _prior(sd: Float[np.ndarray, " free"]) -> Float[np.ndarray, "harmonic free"]:
    """Give the precision of each coefficient: that of a mean square distance from the lead, and the cost of roughness."""
    order = np.arange(1, ORDERS + 1)
    rough = 0.5 * (1.0 + 2.0 * (order / ROUGH_ORDER) ** 6)
    return np.outer(np.concatenate([[1.0], rough, rough]), 1.0 / sd**2)


def _gauss_newton(
    basis: Basis,
    terms: list[Term],
    precision: Float[np.ndarray, "harmonic free"],
    offset: Float[np.ndarray, "harmonic free"],
) -> Float[np.ndarray, "harmonic free"]:
    """Take one step: the mean over the nodes of the terms' squares, plus the squared distance from the lead."""
    scale = 1.0 / np.sqrt(len(basis.value))
    designs, residuals = [], []
    for term in terms:
        design = np.einsum("nrf,nh->nrhf", term.by_q, basis.value[term.nodes])
        if term.by_velocity is not None and term.by_acceleration is not None:
            design += np.einsum("nrf,nh->nrhf", term.by_velocity, basis.first[term.nodes])
            design += np.einsum("nrf,nh->nrhf", term.by_acceleration, basis.second[term.nodes])
        designs.append(scale * design.reshape(-1, offset.size))
        residuals.append(scale * term.residual.ravel())
    design, residual = np.concatenate(designs), np.concatenate(residuals)
    gradient = (precision * offset).ravel() + design.T @ residual
    matrix = np.diag(precision.ravel()) + design.T @ design  # one large product is several times faster than many small
    return cho_solve(cho_factor(matrix), -gradient).reshape(offset.shape)
