"""Motion straight from pixels: the body model fitted to all cameras' keypoints over the whole trial at once.

Points that are triangulated one by one and then given to inverse kinematics lose what holds them together: one body, whose
segments keep their length, that moves smoothly. Here every keypoint in every camera pulls at that one body. A limb that is
hidden in two cameras for a while is held by its neighbours in space and in time; an outlier is outvoted by the rest of the
body. The subject's geometry (segment lengths, where the detector puts its keypoints) and each camera's constant error are
estimated along with the motion, once for the trial.

What that does not solve: the absolute tilt of the pelvis. Hips and shoulders hardly tell it from a bent back, so pelvis and
trunk keep the geometry they came with, and hip flexion has an offset that only a static trial can remove.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.body.forward import couple
from gonio.kernel.geometry.cameras import projection_matrices
from gonio.kernel.kinematics.floor import with_floor
from gonio.kernel.kinematics.pixel_descent import Found, minimise
from gonio.kernel.kinematics.pixel_priors import TrialPriors
from gonio.kernel.kinematics.pixel_system import (
    Equations,
    State,
    Trial,
    body_factor,
    frame_covariance,
    linearise,
    personalise,
    residuals_px,
    shared_covariance,
)
from gonio.kernel.optimize.bordered_band import BorderedFactor
from gonio.kernel.parallel import one_blas_thread
from gonio.kernel.smoothing.correlation import repeats
from gonio.records import NOT_CONVERGED, SOLVED, TOO_FEW_MARKERS, BodyModel, Motion, Rig, record

MIN_CONFIDENCE = 0.3
WIDE_LOSS, LOSS = 4.0, 2.0
"""Cauchy's scale in standard deviations: wide while the start is still off, then narrow."""

ROUGH_TOLERANCE, COST_TOLERANCE = 1e-3, 1e-5
"""The cost is half a chi-square: in a trial of a thousand observations a change by this share is a hundredth of a standard
deviation of one unknown. On five trials coordinates ended 0.06 standard deviations (root mean square) or less from where it
takes them without end."""
MOST_SHARED_FRAMES = 250
"""Scales, offsets and biases are estimated on at most so many frames: more hardly sharpen them and cost time and memory."""

WINDOW_FRAMES, OVERLAP_FRAMES = 600, 30
"""A longer trial is then solved in windows, for the memory's sake; the frames of an overlap are taken from the window that
sees more around them. The jerk prior carries no further than some tenths of a second."""

GEOMETRY_JERK = 4.0
"""So many times the expected jerk is allowed where lengths and offsets are found. A leg that is bent a little more needs less
jerk, so a smoothness that is right for the motion bent the knee: thighs came out 4 mm short, shanks 5 mm long."""

SHARPEST = 0.25
"""An observation is never believed to be sharper than this share of a camera's constant errors (2 mm at the subject): the
body is not that much like its model, and a fit to exact points would chase the difference for ever."""

LONGEST_BLIND_S = 0.2
"""In a longer span in which two cameras don't see the subject, and beyond the ends, the smoothness prior alone would speak:
those frames are NaN."""

FEWEST_KEYPOINTS = 6
"""A camera with fewer keypoints does not see the subject."""

SWAP_GAIN = 4.0


@record
class PixelFit:
    """The motion, the subject's own body, and what the fit says of itself.

    ``sigma_px`` is an observation's standard deviation at confidence 1, by camera. ``inlier_share`` is the share of the
    observations that keep more than half their weight. ``correlation_frames`` is by how many frames of the motion the
    residuals repeat each other; the covariance counts with that. ``bias_px`` is each camera's constant error for each keypoint.
    """

    motion: Motion
    model: BodyModel
    log_scale: Float[np.ndarray, " group"]
    body_factor: Float[np.ndarray, " body"]
    offset_m: Float[np.ndarray, "marker 3"]
    bias_px: Float[np.ndarray, "camera marker 2"]
    sigma_px: Float[np.ndarray, " camera"]
    inlier_share: float
    correlation_frames: float
    swapped: Bool[np.ndarray, "camera frame"]
    converged: bool
    iterations: int

    @property
    def error_lasts_s(self) -> float:
        """How long a residual lasts, in seconds."""
        return self.correlation_frames * float(self.motion.times_s[1] - self.motion.times_s[0])


def fit_pixels(
    model: BodyModel,
    rig: Rig,
    uv_px: Float[np.ndarray, "camera frame marker 2"],
    confidence: Float[np.ndarray, "camera frame marker"],
    start: "Motion | PixelFit",
    priors: TrialPriors,
    on_progress: Callable[[float], None] | None = None,
    resting_m: Float[np.ndarray, "frame marker"] | None = None,
) -> PixelFit:
    """Fit a body model to a trial's keypoints.

    Args:
        model: The body, scaled to the subject; its markers are the keypoints.
        rig: The cameras.
        uv_px: Undistorted keypoints in the order of the model's markers; NaN is missing.
        confidence: Theirs; below 0.3 a keypoint is not used.
        start: The motion to start from, of the same model: its root should face the right way; NaN is filled. Or another fit
            of that model, to go on from with its lengths, offsets and biases.
        priors: What is believed beforehand.
        on_progress: Is told the done share, 0 to 1.
        resting_m: The height of each marker that rests on the floor, NaN elsewhere
            (:mod:`gonio.kernel.kinematics.floor`). What is reported by cameras has the floor as its last one then.
    """
    usable = np.isfinite(uv_px).all(axis=-1) & (confidence >= MIN_CONFIDENCE)
    trial = Trial(
        model=model,
        projections=projection_matrices(rig),
        uv_px=np.where(usable[..., None], uv_px, 0.0),
        confidence=np.where(usable, confidence, 0.0),
        consecutive=np.ones(uv_px.shape[1], dtype=bool),
        priors=priors,
        free=np.flatnonzero((model.coordinates.coupled_to < 0) & ~model.coordinates.locked & ~priors.held),
    )
    if resting_m is not None:
        trial = with_floor(trial, resting_m)
    after, start = (start, start.motion) if isinstance(start, PixelFit) else (None, start)
    state = _start(trial, start, after)
    chosen = _sample(uv_px.shape[1])
    progress = _Stages(on_progress, 3 + len(_windows(uv_px.shape[1])))
    with one_blas_thread():
        solved = _solve_sample(_part(trial, chosen), replace(state, q=state.q[chosen]), progress)
        equations = _linearise(solved)
        belief, factor = _believe(solved, equations)
        count = len(model.coordinates.names)
        covariance = np.zeros((uv_px.shape[1], count, count))
        if len(chosen) == uv_px.shape[1]:
            parts = [_describe(solved, equations, belief, slice(None), covariance, factor)]
        else:
            parts = []
            for window, keep in _windows(uv_px.shape[1]):
                frames = np.arange(window.start, window.stop)
                own = _solve_window(_part(trial, frames), replace(solved.state, q=state.q[frames]), progress)
                kept = covariance[window][keep]
                parts.append(_describe(own, _linearise(own), belief, keep, kept))
    return _report(solved, belief, parts, covariance, start)


class _Stages:
    """Turns iterations, whose number nobody knows beforehand, into a share that only grows."""

    def __init__(self, report: Callable[[float], None] | None, count: int) -> None:
        self._report, self._count, self._stage, self._iteration = report, count, 0, 0

    def iterate(self) -> None:
        """Count an iteration; half of what is left of the stage is thought to take five."""
        self._iteration += 1
        if self._report is not None:
            self._report((self._stage + 1.0 - 0.5 ** (self._iteration / 5)) / self._count)

    def finish(self) -> None:
        """Count a stage."""
        self._stage, self._iteration = self._stage + 1, 0


class _Solved(NamedTuple):
    """A solved stretch of a trial; with the legs in place."""

    trial: Trial
    state: State
    sigma_px: Float[np.ndarray, " camera"]
    swapped: Bool[np.ndarray, "camera frame"]
    converged: bool
    iterations: int


class _Belief(NamedTuple):
    """What the sample says of the trial: what a residual's information is worth, and how well the geometry is known."""

    repeat: float
    data_share: float
    shared_covariance: Float[np.ndarray, "shared shared"]


class _Part(NamedTuple):
    """What is reported of a stretch."""

    q: Float[np.ndarray, "frame coordinate"]
    seen: Bool[np.ndarray, " frame"]
    swapped: Bool[np.ndarray, "camera frame"]
    kept: int
    observations: int
    converged: bool
    iterations: int


def _solve_sample(trial: Trial, start: State, progress: _Stages) -> _Solved:
    """Solve for the motion first, then for what is shared along with a rougher one, and last for the motion again."""
    state, sigma_px, first, _ = _descend(trial, start, WIDE_LOSS, ROUGH_TOLERANCE, progress, shared=False)
    trial, swapped = _unswap_legs(trial, state, sigma_px)
    trial = replace(trial, repeat=max(_repeat(trial, state, sigma_px), _least_repeat(trial, sigma_px)))
    rough = replace(trial, priors=replace(trial.priors, jerk_sd=GEOMETRY_JERK * trial.priors.jerk_sd))
    state, _, third, settled = _descend(rough, state, LOSS, COST_TOLERANCE, progress, shared=True)
    state, sigma_px, fourth, converged = _descend(trial, state, LOSS, COST_TOLERANCE, progress, shared=False)
    iterations = first + third + fourth
    return _Solved(replace(trial, repeat=1.0), state, sigma_px, swapped, settled and converged, iterations)


def _descend(
    trial: Trial, start: State, loss_scale: float, tolerance: float, progress: _Stages, *, shared: bool
) -> Found:
    """Go down one stage; after a rough one another follows, which estimates the noise anew."""
    settles = tolerance < ROUGH_TOLERANCE
    found = minimise(trial, start, _noise_px, loss_scale, tolerance, progress.iterate, shared=shared, settles=settles)
    progress.finish()
    return found


def _solve_window(trial: Trial, start: State, progress: _Stages) -> _Solved:
    """Solve for the motion of a stretch, with what is shared as it is."""
    silent = _Stages(None, 1)
    state, sigma_px, first, _ = _descend(trial, start, WIDE_LOSS, ROUGH_TOLERANCE, silent, shared=False)
    trial, swapped = _unswap_legs(trial, state, sigma_px)
    state, sigma_px, second, converged = _descend(trial, state, LOSS, COST_TOLERANCE, progress, shared=False)
    return _Solved(trial, state, sigma_px, swapped, converged, first + second)


def _repeat(trial: Trial, state: State, sigma_px: Float[np.ndarray, " camera"]) -> float:
    """Give by how many frames the residuals repeat each other, once each camera's constant error is taken off."""
    error = residuals_px(trial, state)
    whitened = np.nan_to_num(error) * (trial.confidence / sigma_px[:, None, None])[..., None]
    weight = np.where(trial.confidence > 0, 1.0 / (1.0 + (whitened**2).sum(axis=-1) / LOSS**2), 0.0)[..., None]
    whitened -= (weight * whitened).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    inlier = ((whitened**2).sum(axis=-1) < LOSS**2) & (trial.confidence > 0)
    return repeats(whitened, inlier)


def _least_repeat(trial: Trial, sigma_px: Float[np.ndarray, " camera"]) -> float:
    """Give by how many frames the residuals have to repeat each other to be worth what is believed of the detector."""
    return float((trial.priors.noise_px / sigma_px[: trial.pictures]).max()) ** 2


def _part(trial: Trial, frames: Int[np.ndarray, " chosen"]) -> Trial:
    """Give some frames of a trial as a trial."""
    return replace(
        trial,
        uv_px=trial.uv_px[:, frames],
        confidence=trial.confidence[:, frames],
        consecutive=np.r_[True, np.diff(frames) == 1],
    )


def _sample(frames: int) -> Int[np.ndarray, " chosen"]:
    """Choose all frames of a short trial, else ten stretches of consecutive frames, spread over it."""
    if frames <= MOST_SHARED_FRAMES:
        return np.arange(frames)
    length = MOST_SHARED_FRAMES // 10
    starts = np.linspace(0, frames - length, 10).astype(int)
    return np.unique(np.concatenate([np.arange(first, first + length) for first in starts]))


def _windows(frames: int) -> list[tuple[slice, slice]]:
    """Give the windows of a trial that is too long for one, and which of its own frames each of them keeps."""
    if frames <= MOST_SHARED_FRAMES:
        return []
    edges = np.linspace(0, frames, max(1, round(frames / WINDOW_FRAMES)) + 1).astype(int)
    windows: list[tuple[slice, slice]] = []
    for first, last in pairwise(edges.tolist()):
        begin, end = max(first - OVERLAP_FRAMES, 0), min(last + OVERLAP_FRAMES, frames)
        windows.append((slice(begin, end), slice(first - begin, last - begin)))
    return windows


def _start(trial: Trial, start: Motion, after: PixelFit | None) -> State:
    """Fill the gaps of the starting motion: between known frames by straight lines, else with the default."""
    q = start.values.copy()
    time = np.arange(len(q))
    for column, default in enumerate(trial.model.coordinates.default):
        known = np.isfinite(q[:, column])
        q[:, column] = np.interp(time, time[known], q[known, column]) if known.any() else default
    cameras, _, markers = trial.confidence.shape
    bias_px = np.zeros((cameras, markers, 2))
    if after is None:
        return State(q, np.zeros(len(trial.priors.group_sd)), np.zeros((markers, 3)), bias_px)
    bias_px[: len(after.bias_px)] = after.bias_px
    return State(q, after.log_scale, after.offset_m, bias_px)


def _noise_px(trial: Trial, state: State) -> Float[np.ndarray, " camera"]:
    """Estimate each camera's standard deviation at confidence 1 robustly: half of all |e|² of two normals lie below 1.386."""
    error = residuals_px(trial, state)
    squared = trial.confidence**2 * (error**2).sum(axis=-1)
    seen = np.isfinite(squared) & (trial.confidence > 0)
    pooled = np.median(squared[seen]) if seen.any() else 1.386
    levels = [np.median(s[own]) if own.sum() > 50 else pooled for s, own in zip(squared, seen, strict=True)]
    levels = np.sqrt(np.array(levels) / 1.386)
    return np.maximum(levels, SHARPEST * trial.priors.bias_sd_px)


def _unswap_legs(
    trial: Trial, state: State, sigma_px: Float[np.ndarray, " camera"]
) -> tuple[Trial, Bool[np.ndarray, "camera frame"]]:
    """Swap the legs back in the camera frames where the detector took the left for the right one."""
    names = trial.model.markers.names
    stems = ("hip", "knee", "ankle", "heel", "foot", "toe")
    right = [
        i
        for i, n in enumerate(names)
        if "right" in n and any(s in n for s in stems) and n.replace("right", "left") in names
    ]
    cameras, frames, _ = trial.confidence.shape
    if not right:
        return trial, np.zeros((cameras, frames), dtype=bool)
    left = [names.index(names[i].replace("right", "left")) for i in right]
    order = np.arange(len(names))
    order[right], order[left] = left, right
    crossed = replace(trial, uv_px=trial.uv_px[:, :, order], confidence=trial.confidence[:, :, order])
    legs = right + left

    def cost(of: Trial) -> Float[np.ndarray, "camera frame"]:
        error = residuals_px(of, state)
        squared = (error**2).sum(axis=-1) * (of.confidence / sigma_px[:, None, None]) ** 2
        c2 = LOSS**2
        return np.nansum(0.5 * c2 * np.log1p(squared[..., legs] / c2), axis=-1)

    swapped = cost(trial) - cost(crossed) > SWAP_GAIN
    choose = swapped[:, :, None]
    return (
        replace(
            trial,
            uv_px=np.where(choose[..., None], crossed.uv_px, trial.uv_px),
            confidence=np.where(choose, crossed.confidence, trial.confidence),
        ),
        swapped,
    )


def _linearise(solved: _Solved) -> Equations:
    return linearise(solved.trial, solved.state, solved.sigma_px, LOSS, shared=True)


def _believe(solved: _Solved, equations: Equations) -> tuple[_Belief, BorderedFactor]:
    """Weigh a sample's residuals against each other, and find how well the geometry is known; give how that was found."""
    trial = solved.trial
    whitened = equations.data.error_px * (trial.confidence / solved.sigma_px[:, None, None])[..., None]
    weight = 1.0 / (1.0 + (whitened**2).sum(axis=-1) / LOSS**2)
    seen = trial.confidence > 0
    repeat = repeats(whitened, (weight > 0.5) & seen)
    worth = max(repeat, _least_repeat(trial, solved.sigma_px))
    data_share = 1.0 / (loss_efficiency(whitened[seen], weight[seen]) * worth)
    covariance, factor = shared_covariance(trial, equations, data_share)
    return _Belief(repeat, data_share, covariance), factor


def _describe(
    solved: _Solved,
    equations: Equations,
    belief: _Belief,
    keep: slice,
    covariance: Float[np.ndarray, "frame coordinate coordinate"],
    factor: BorderedFactor | None = None,
) -> _Part:
    """Collect what is reported of the frames that are kept, with a covariance that knows how residuals repeat each other.

    That is filled in; a ``factor`` of the same equations is used up.
    """
    trial = solved.trial
    error = equations.data.error_px
    squared = (error**2).sum(axis=-1) * (trial.confidence / solved.sigma_px[:, None, None]) ** 2
    seen = trial.confidence[:, keep] > 0
    watched = seen[: trial.pictures].sum(axis=2) >= FEWEST_KEYPOINTS
    found = frame_covariance(trial, equations, belief.data_share, belief.shared_covariance, factor)
    covariance[:, trial.free[:, None], trial.free] = found[keep]
    return _Part(
        q=solved.state.q[keep],
        seen=watched.sum(axis=0) >= min(2, len(watched)),
        swapped=solved.swapped[:, keep],
        kept=int(((squared[:, keep] < LOSS**2) & seen).sum()),
        observations=int(seen.sum()),
        converged=solved.converged,
        iterations=solved.iterations,
    )


def _report(
    solved: _Solved,
    belief: _Belief,
    parts: list[_Part],
    covariance: Float[np.ndarray, "frame coordinate coordinate"],
    start: Motion,
) -> PixelFit:
    """Put the parts together."""
    trial, state = solved.trial, solved.state
    model = personalise(trial.model, trial.priors, state)
    blind = _blind(np.concatenate([part.seen for part in parts]), start.times_s)
    covariance[blind] = np.nan
    covariance.setflags(write=False)  # so the record takes it as it is
    converged = solved.converged and all(part.converged for part in parts)
    status = np.where(blind, TOO_FEW_MARKERS, SOLVED if converged else NOT_CONVERGED).astype(np.uint8)
    return PixelFit(
        motion=Motion(
            coordinate_names=trial.model.coordinates.names,
            rotational=trial.model.coordinates.rotational,
            times_s=start.times_s,
            values=np.where(blind[:, None], np.nan, couple(model, np.concatenate([part.q for part in parts]))),
            status=status,
            iterations=np.concatenate([np.full(len(part.q), part.iterations) for part in parts]),
            residual_rms_m=start.residual_rms_m,
            covariance=covariance,
        ),
        model=model,
        log_scale=state.log_scale,
        body_factor=body_factor(trial.priors, state),
        offset_m=state.offset_m,
        bias_px=state.bias_px,
        sigma_px=solved.sigma_px,
        inlier_share=sum(part.kept for part in parts) / max(sum(part.observations for part in parts), 1),
        correlation_frames=belief.repeat,
        swapped=np.concatenate([part.swapped for part in parts], axis=1),
        converged=converged,
        iterations=solved.iterations,
    )


def _blind(seen: Bool[np.ndarray, " frame"], times_s: Float[np.ndarray, " frame"]) -> Bool[np.ndarray, " frame"]:
    """Mark the frames in longer spans between those in which two cameras saw the subject, and beyond their ends."""
    at_s = times_s[seen]
    after = np.searchsorted(at_s, times_s)
    inner = (after > 0) & (after < len(at_s))
    span_s = np.full(len(seen), np.inf)
    span_s[inner] = at_s[after[inner]] - at_s[after[inner] - 1]
    return ~seen & (span_s > LONGEST_BLIND_S + 1e-6)


def loss_efficiency(whitened: Float[np.ndarray, "observation 2"], weight: Float[np.ndarray, " observation"]) -> float:
    """Give κ = E[ψ²] E[w] / E[ψ']²: how the robust loss changes the covariance [Huber 1981, §7.6]."""
    squared = (whitened**2).sum(axis=-1)
    psi2 = np.nanmean(weight**2 * squared) / 2
    slope = np.nanmean(weight * (1.0 - squared / (LOSS**2 + squared)))
    return float(psi2 * np.nanmean(weight) / slope**2)
