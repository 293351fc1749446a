"""How the fit to pixels goes downhill.

The normal equations of a trial cost ten times as much to factorise as to evaluate a gradient, most of it for what the frames
share. So they are factorised where the descent begins, and again only where it has left their neighbourhood; in between,
what the gradients tell of the curvature is added to them (limited-memory BFGS with the factorised equations for its first
matrix [Nocedal & Wright 2006, §7.2]).
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.kernel.kinematics.pixel_system import (
    Equations,
    State,
    Step,
    Trial,
    as_change,
    gradient_of,
    linearise,
    moved,
    prepare_step,
    shape_body,
)
from gonio.kernel.kinematics.pixel_terms import GRADIENT, NORMAL_EQUATIONS

TOLERANCE_RAD = 1e-5
MAX_ITERATIONS = 100
"""Usually some 15 are enough; beside a stretch that hardly any camera saw, steps are short, and 40 were not."""

LARGEST_STEP_RAD = 0.6
REMEMBERED = 8

SHORTEST, OFTEN = 0.1, 3
"""A step that leads uphill is shortened once, to this share at least; where that happens so often, the equations are old."""

ROUGHLY = 1e-3
"""How well, as a share of the cost, it has settled where the noise level is estimated once more."""

ALIKE = 0.3
"""Noise levels whose logarithms differ by less make much the same equations: steps are a little long or short."""

FAR = 0.1
"""A step that takes this share off the cost has changed the observations' weights so much that the equations are old."""


class Found(NamedTuple):
    """Where the descent ended: the noise level that was estimated on its way, and whether it came to rest."""

    state: State
    sigma_px: Float[np.ndarray, " camera"]
    iterations: int
    converged: bool


def minimise(
    trial: Trial,
    start: State,
    estimate_noise_px: Callable[[Trial, State], Float[np.ndarray, " camera"]],
    loss_scale: float,
    tolerance: float,
    on_iteration: Callable[[], None],
    *,
    shared: bool,
    settles: bool = True,
) -> Found:
    """Find the state of least cost; the noise level is estimated where it starts and once more where it has settled.

    Args:
        trial: What was seen, and what is believed.
        start: Where to begin.
        estimate_noise_px: Gives an observation's standard deviation at confidence 1, by camera.
        loss_scale: Cauchy's scale, in standard deviations.
        tolerance: Ends where neither the last step nor the next is to take more than this share off the cost.
        on_iteration: Is called before each step.
        shared: Whether what the frames share is unknown, too.
        settles: Go on from where it has settled first, with the noise level that it has there.
    """
    descent = _Descent(trial, start, estimate_noise_px(trial, start), loss_scale, shared=shared)
    settled = not settles
    for iteration in range(1, MAX_ITERATIONS + 1):
        on_iteration()
        largest_rad, expected, gain = descent.go()
        enough = tolerance if settled else max(tolerance, ROUGHLY)
        if largest_rad < TOLERANCE_RAD or max(abs(gain), expected) < enough * descent.cost:
            if settled:
                return Found(descent.state, descent.sigma_px, iteration, converged=True)
            settled = True
            descent.weigh(estimate_noise_px(trial, descent.state))
        elif gain < 0 or gain > FAR * descent.cost or descent.shortened == OFTEN:
            descent.factorise()
    return Found(descent.state, descent.sigma_px, MAX_ITERATIONS, converged=False)


class _Descent:
    """A state, its cost and gradient, and what is known of the curvature there."""

    def __init__(
        self, trial: Trial, start: State, sigma_px: Float[np.ndarray, " camera"], loss_scale: float, *, shared: bool
    ) -> None:
        self._trial, self._loss_scale, self._shared = trial, loss_scale, shared
        self._tree = None if shared else shape_body(trial, start)
        self._damping = 1e-4
        self._size = len(trial.consecutive) * len(trial.free)
        self.state, self.sigma_px = start, sigma_px
        self.factorise()

    def factorise(self) -> None:
        """Factorise the normal equations where the descent is now, and forget what older gradients told."""
        equations = self._linearise(self.state, NORMAL_EQUATIONS)
        self._step: Step = prepare_step(self._trial, equations, self._damping, shared=self._shared)
        self._is_fresh, self.shortened = True, 0
        self._pairs: deque[tuple[np.ndarray, np.ndarray, float]] = deque(maxlen=REMEMBERED)
        self.cost, self._gradient = equations.cost, gradient_of(equations, shared=self._shared)

    def weigh(self, sigma_px: Float[np.ndarray, " camera"]) -> None:
        """Weigh the observations by another noise level; what was factorised stays if it is much the same."""
        alike = bool((np.abs(np.log(sigma_px / self.sigma_px)) < ALIKE).all())
        self.sigma_px = sigma_px
        if not alike:
            self.factorise()
            return
        equations = self._linearise(self.state, GRADIENT)
        self._pairs.clear()
        self.cost, self._gradient = equations.cost, gradient_of(equations, shared=self._shared)

    def go(self) -> tuple[float, float, float]:
        """Take a step if it goes downhill; give the largest turn in it, and what it was to take off the cost and did."""
        step = self._direction()
        largest_rad = float(np.abs(step[: self._size]).max())
        if largest_rad > LARGEST_STEP_RAD:
            step *= LARGEST_STEP_RAD / largest_rad
        slope = float(step @ self._gradient)
        state, equations, gain = self._try(step)
        if gain < 0:  # too long: as far as a parabola through what is known now falls, costs a tenth of factorising
            step *= max(0.5 * slope / (slope - gain), SHORTEST)
            state, equations, gain = self._try(step)
            self.shortened += 1
        expected = 0.5 * slope
        if gain >= 0:
            gradient = gradient_of(equations, shared=self._shared)
            fallen = self._gradient - gradient  # both point downhill
            curvature = float(step @ fallen)
            if curvature > 0:
                self._pairs.append((step, fallen, 1.0 / curvature))
            self.state, self.cost, self._gradient = state, equations.cost, gradient
            self._damping = max(0.2 * self._damping, 1e-7)
        elif self._is_fresh:
            self._damping *= 10.0
        self._is_fresh = False
        return largest_rad, expected, gain

    def _try(self, step: Float[np.ndarray, " unknown"]) -> tuple[State, Equations, float]:
        """Go a step, and give what it takes off the cost."""
        state = moved(self.state, as_change(self._trial, step))
        equations = self._linearise(state, GRADIENT)
        return state, equations, self.cost - equations.cost

    def _direction(self) -> Float[np.ndarray, " unknown"]:
        """Turn the gradient into a step, by the two loops of BFGS."""
        gradient, shares = self._gradient.copy(), []
        for step, fallen, inverse in reversed(self._pairs):
            shares.append(inverse * float(step @ gradient))
            gradient -= shares[-1] * fallen
        direction = self._step.of(gradient)
        for (step, fallen, inverse), share in zip(self._pairs, reversed(shares), strict=True):
            direction += (share - inverse * float(fallen @ direction)) * step
        return direction

    def _linearise(self, state: State, order: int) -> Equations:
        return linearise(
            self._trial, state, self.sigma_px, self._loss_scale, shared=self._shared, tree=self._tree, order=order
        )
