"""The whole-trial least-squares problem of the fit to pixels: its state, its normal equations, its steps and covariance."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg.blas import dtrmm

from gonio.kernel.body.scaling import scale_model, scaled_slides
from gonio.kernel.body.tree import Tree, flatten
from gonio.kernel.kinematics.pixel_priors import MIRROR_OFFSET_M, MIRROR_SCALE, TrialPriors
from gonio.kernel.kinematics.pixel_terms import GRADIENT, NORMAL_EQUATIONS, RESIDUALS, Layout, Sight, Sums, sum_frames
from gonio.kernel.optimize.bordered_band import BandFactor, BorderedFactor, factorise, factorise_bordered
from gonio.kernel.parallel import over_blocks
from gonio.records import GROUND, BodyModel

REACH = 3
"""A third difference couples a frame with the three after it."""

THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])

UNSEEN = 1.0
"""The information, 1/rad² or 1/m², that damping takes every coordinate to have; one that is seen has a thousand times that."""

_BLOCK = 128  # frames that one thread takes at a time: each block has a corner of its own


@dataclass(frozen=True)
class State:
    """A point in the space of all unknowns."""

    q: Float[np.ndarray, "frame coordinate"]
    log_scale: Float[np.ndarray, " group"]
    offset_m: Float[np.ndarray, "marker 3"]  # in the marker's node
    bias_px: Float[np.ndarray, "camera marker 2"]


@dataclass(frozen=True)
class Trial:
    """What stays the same while a trial is solved."""

    model: BodyModel
    projections: Float[np.ndarray, "camera 3 4"]
    uv_px: Float[np.ndarray, "camera frame marker 2"]
    confidence: Float[np.ndarray, "camera frame marker"]
    consecutive: Bool[np.ndarray, " frame"]  # whether a frame follows the one before in time
    priors: TrialPriors
    free: Int[np.ndarray, " free"]
    repeat: float = (
        1.0  # how many observations say the same: beliefs that hold for the whole trial weigh that much more
    )
    pictures: int | None = None  # how many of the cameras take pictures; all, unless the last is the floor

    @property
    def shared(self) -> int:
        """The number of shared unknowns."""
        cameras, _, markers = self.confidence.shape
        return len(self.priors.group_sd) + 3 * markers + 2 * cameras * markers

    @cached_property
    def place(self) -> Int[np.ndarray, " coordinate"]:
        """Where each coordinate is among the free ones, −1 where it is not."""
        place = np.full(len(self.model.coordinates.names), -1)
        place[self.free] = np.arange(len(self.free))
        return place

    @cached_property
    def smooth(self) -> Bool[np.ndarray, " start"]:
        """Whether a frame and the three after it are consecutive in time, by frame but for the last three."""
        follows = self.consecutive
        return follows[1:-2] & follows[2:-1] & follows[3:]

    @cached_property
    def jerk_band(self) -> Float[np.ndarray, "frame 4"]:
        """Give the jerk prior's Hessian for a coordinate of precision 1: ``[t, d]`` couples frame t with frame t + d."""
        band = np.zeros((len(self.consecutive), REACH + 1))
        count = len(self.smooth)
        for a, one in enumerate(THIRD_DIFFERENCE):
            for b in range(a, REACH + 1):
                band[a : a + count, b - a] += one * THIRD_DIFFERENCE[b] * self.smooth
        return band

    @cached_property
    def plain(self) -> "_Plain":
        """Give the model as it came, laid out."""
        return _lay_out(self)

    @cached_property
    def shared_precision(self) -> Float[np.ndarray, "shared shared"]:
        """Give the inverse covariance that is believed of scales, offsets and biases."""
        return self.repeat * _shared_precision(self.priors, len(self.priors.offset_sd_m))


@dataclass(frozen=True)
class Equations:
    """The normal equations at a state: data and priors apart, since only the data's information is ever tempered.

    Where only the gradient was asked for, what concerns the Hessian is empty.
    """

    cost: float
    data: Sums
    prior_hessian: Float[np.ndarray, "frame free"]  # the part within a frame; diagonal
    prior_gradient: Float[np.ndarray, "frame free"]
    prior_corner: Float[np.ndarray, "shared shared"]
    prior_shared_gradient: Float[np.ndarray, " shared"]


def personalise(model: BodyModel, priors: TrialPriors, state: State) -> BodyModel:
    """Give the model the state's keypoint offsets and then its segment lengths."""
    on_body = model.markers.body != GROUND
    R_node_body = model.bodies.T_node_body[model.markers.body[on_body], :3, :3]
    location = model.markers.location_body_m.copy()
    location[on_body] += np.einsum("mji,mj->mi", R_node_body, state.offset_m[on_body])
    fitted = replace(model, markers=replace(model.markers, location_body_m=location))
    return scale_model(fitted, np.repeat(body_factor(priors, state)[:, None], 3, axis=1))


def body_factor(priors: TrialPriors, state: State) -> Float[np.ndarray, " body"]:
    """Give the factor by which the state lengthens each body."""
    return np.where(priors.body_group >= 0, np.exp(state.log_scale)[priors.body_group], 1.0)


class _Plain(NamedTuple):
    """A model laid out, and the scale group that each of its lengths belongs to, −1 for none."""

    tree: Tree
    node_group: Int[np.ndarray, " node"]  # of a node's placement
    slide_group: Int[np.ndarray, " node"]  # of its slide
    piece_group: Int[np.ndarray, " piece"]
    marker_group: Int[np.ndarray, " marker"]


def _lay_out(trial: Trial) -> _Plain:
    model, body_group = trial.model, trial.priors.body_group
    parent, body = model.joints.parent_body, model.markers.body
    node_group = np.where(parent >= 0, body_group[parent], -1)
    slide_group, piece_group = np.full(len(parent), -1), np.full(len(model.functions.origin), -1)
    for node in scaled_slides(model):
        slide_group[node] = piece_group[model.functions.pieces_of(model.joints.function[node])] = node_group[node]
    return _Plain(flatten(model), node_group, slide_group, piece_group, np.where(body >= 0, body_group[body], -1))


def shape_body(trial: Trial, state: State) -> Tree:
    """Give the laid out model in the shape that a state gives it: what :func:`personalise` does, without its records.

    Motion alone does not change it.
    """
    plain, factor = trial.plain, np.append(np.exp(state.log_scale), 1.0)  # the last for what is not scaled
    tree, nodes, markers = plain.tree, plain.tree.nodes.copy(), plain.tree.markers.copy()
    nodes["p_parent_node"] *= factor[plain.node_group, None]
    nodes["offset"] *= factor[plain.slide_group]
    nodes["slope"] *= factor[plain.slide_group]
    on_body = markers["node"] != GROUND
    markers["location_m"][on_body] += state.offset_m[on_body]
    markers["location_m"] *= factor[plain.marker_group, None]
    return tree._replace(nodes=nodes, markers=markers, coefficients=tree.coefficients * factor[plain.piece_group, None])


def residuals_px(trial: Trial, state: State) -> Float[np.ndarray, "camera frame marker 2"]:
    """Give what each keypoint is off by in each camera, biases taken off; NaN where it was not seen."""
    layout = _layout(trial, state, RESIDUALS, shared=False)
    sight = Sight(trial.projections, trial.uv_px, trial.confidence, state.bias_px.copy(), 1.0)
    return _sum_all(shape_body(trial, state), sight, layout, state.q.copy(), 0)[0].error_px


def linearise(
    trial: Trial,
    state: State,
    sigma_px: Float[np.ndarray, " camera"],
    loss_scale: float,
    *,
    shared: bool,
    tree: Tree | None = None,
    order: int = NORMAL_EQUATIONS,
) -> Equations:
    """Evaluate the cost and its normal equations at a state.

    Args:
        trial: What was seen, and what is believed.
        state: Where.
        sigma_px: An observation's standard deviation at confidence 1, by camera.
        loss_scale: Cauchy's scale, in standard deviations.
        shared: Whether what the frames share is unknown, too.
        tree: The body in the state's shape, where it is at hand.
        order: ``GRADIENT`` leaves the Hessian out, which takes most of the time.
    """
    tree = shape_body(trial, state) if tree is None else tree
    sight = Sight(
        trial.projections, trial.uv_px, trial.confidence / sigma_px[:, None, None], state.bias_px.copy(), loss_scale
    )
    layout = _layout(trial, state, order, shared=shared)
    data, cost = _sum_all(tree, sight, layout, state.q.copy(), trial.shared if shared else 0)
    prior_cost, hessian, gradient = _frame_priors(trial, state)
    theta = np.concatenate([state.log_scale, state.offset_m.ravel(), state.bias_px.ravel()])
    downhill = -trial.shared_precision @ theta
    return Equations(
        cost + prior_cost - 0.5 * float(theta @ downhill), data, hessian, gradient, trial.shared_precision, downhill
    )


@dataclass(frozen=True)
class Step:
    """The factorised, damped normal equations at some state: what turns a gradient into a step."""

    trial: Trial
    factor: BandFactor | BorderedFactor

    def of(self, gradient: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " unknown"]:
        """Give the step for a gradient, both as :func:`gradient_of` orders the unknowns."""
        inner = self.factor.inner if isinstance(self.factor, BorderedFactor) else self.factor
        size = len(self.trial.consecutive) * len(self.trial.free)
        frames = np.zeros(len(inner.rows))
        frames[:size] = gradient[:size]
        if isinstance(self.factor, BandFactor):
            return self.factor.solve(frames)[:size]
        moved, theta = self.factor.solve(frames, gradient[size:])
        return np.concatenate([moved[:size], theta])


def prepare_step(trial: Trial, equations: Equations, damping: float, *, shared: bool) -> Step:
    """Factorise the damped normal equations.

    Raises:
        numpy.linalg.LinAlgError: they are not positive definite at this damping.
    """
    return Step(trial, _factorise(trial, equations, 1.0, damping, shared=shared, precision=np.float32))


def gradient_of(equations: Equations, *, shared: bool) -> Float[np.ndarray, " unknown"]:
    """Give the downhill gradient as one vector: the free coordinates frame by frame, then what the frames share."""
    own = (equations.data.gradient + equations.prior_gradient).ravel()
    if not shared:
        return own
    return np.concatenate([own, equations.data.shared_gradient + equations.prior_shared_gradient])


def as_change(trial: Trial, step: Float[np.ndarray, " unknown"]) -> State:
    """Give a step as a change of the state."""
    frames, size = len(trial.consecutive), len(trial.free)
    q = np.zeros((frames, len(trial.model.coordinates.names)))
    q[:, trial.free] = step[: frames * size].reshape(frames, size)
    theta = step[frames * size :] if len(step) > frames * size else np.zeros(trial.shared)
    groups, (cameras, _, markers) = len(trial.priors.group_sd), trial.confidence.shape
    return State(
        q=q,
        log_scale=theta[:groups],
        offset_m=theta[groups : groups + 3 * markers].reshape(markers, 3),
        bias_px=theta[groups + 3 * markers :].reshape(cameras, markers, 2),
    )


def moved(state: State, change: State) -> State:
    """Add a change to a state."""
    return State(
        q=state.q + change.q,
        log_scale=state.log_scale + change.log_scale,
        offset_m=state.offset_m + change.offset_m,
        bias_px=state.bias_px + change.bias_px,
    )


def shared_covariance(
    trial: Trial, equations: Equations, data_share: float
) -> tuple[Float[np.ndarray, "shared shared"], BorderedFactor]:
    """Give the covariance of what all frames share, their motion being unknown too, and what it was computed with.

    ``data_share`` is what a residual's information is worth, since residuals of neighbouring frames repeat each other.
    """
    factor = _factorise(trial, equations, data_share, 0.0, shared=True)
    assert isinstance(factor, BorderedFactor)
    return factor.border_inverse(), factor


def frame_covariance(
    trial: Trial,
    equations: Equations,
    data_share: float,
    shared: Float[np.ndarray, "shared shared"],
    factor: BorderedFactor | None = None,
) -> Float[np.ndarray, "frame free free"]:
    """Give the covariance of each frame's coordinates, where what the frames share has the covariance ``shared``.

    With the motion q, the shared s, Hessian H of the one and B of both: cov q = H⁻¹ + H⁻¹ B cov(s) Bᵀ H⁻¹. A ``factor``
    that :func:`shared_covariance` gave for the same equations saves the half of the work; it is used up.
    """
    frames, size = equations.prior_gradient.shape
    if factor is None:
        inner = _factorise(trial, equations, data_share, 0.0, shared=False)
        assert isinstance(inner, BandFactor)
        carried = _border_rows(equations, data_share)
        inner.overwrite_lower(carried)
    else:
        inner, carried = factor.inner, factor.carried
    inner.overwrite_upper(carried)
    # Times the root of the shared covariance, in place: row-major, so that BLAS sees both transposed.
    root = np.linalg.cholesky(shared)
    spread = dtrmm(1.0, root.T, carried.T, lower=0, overwrite_b=1).T.reshape(-1, size, len(shared))
    by_frame = inner.inverse_blocks().reshape(-1, REACH, size, REACH, size)
    own = np.stack([by_frame[:, i, :, i] for i in range(REACH)], axis=1).reshape(-1, size, size)
    own += spread @ spread.transpose(0, 2, 1)
    return own[:frames]


def _border_rows(
    equations: Equations, data_share: float, precision: type[np.floating] = np.float64
) -> Float[np.ndarray, "unknown shared"]:
    """Pad the border to whole blocks of frames."""
    frames, size, shared = equations.data.border.shape
    border = np.empty((_padded(frames), size, shared), dtype=precision)
    np.multiply(equations.data.border, data_share, out=border[:frames], casting="same_kind")
    border[frames:] = 0.0
    return border.reshape(-1, shared)


def _padded(frames: int) -> int:
    """Give the number of frames, filled up to whole blocks."""
    return -(-frames // REACH) * REACH


def _layout(trial: Trial, state: State, order: int, *, shared: bool) -> Layout:
    plain = trial.plain
    return Layout(
        free=trial.free,
        place=trial.place,
        node_group=plain.node_group,
        marker_group=plain.marker_group,
        marker_factor=np.append(np.exp(state.log_scale), 1.0)[plain.marker_group],
        scales=len(trial.priors.group_sd),
        shared=shared,
        order=order,
    )


def _sum_all(tree: Tree, sight: Sight, layout: Layout, q: np.ndarray, shared: int) -> tuple[Sums, float]:
    """Sum all frames on all cores; each block of frames has a corner of its own until the end."""
    cameras, frames, markers = sight.precision.shape
    size, starts = len(layout.free), range(0, frames, _BLOCK)
    curved, sloping = frames if layout.order == NORMAL_EQUATIONS else 0, frames if layout.order >= GRADIENT else 0
    hessian, gradient = np.empty((curved, size, size)), np.empty((sloping, size))
    border, error = np.empty((curved, size, shared)), np.empty((cameras, frames, markers, 2))
    corner_size = shared if curved else 0
    corners, shared_gradients = np.zeros((len(starts), corner_size, corner_size)), np.zeros((len(starts), shared))
    costs = np.zeros(len(starts))

    def work(start: int, stop: int) -> None:
        # ``over_blocks`` hands over everything at once where there is but one block.
        number = start // _BLOCK
        sums = Sums(hessian, gradient, border, corners[number], shared_gradients[number], error)
        costs[number] = sum_frames(tree, sight, layout, start, stop, q, sums)

    over_blocks(work, frames, _BLOCK)
    corner = corners.sum(axis=0)
    if curved:
        corner += np.tril(corner, -1).T
    return Sums(hessian, gradient, border, corner, shared_gradients.sum(axis=0), error), float(costs.sum())


def _frame_priors(trial: Trial, state: State) -> tuple[float, np.ndarray, np.ndarray]:
    """Jerk, posture and ranges: cost, diagonal Hessian within frames, gradient (downhill)."""
    priors, q = trial.priors, state.q[:, trial.free]
    cost, gradient = 0.0, np.zeros_like(q)
    if len(q) > REACH:
        jerk = np.diff(q, n=3, axis=0) * trial.smooth[:, None]
        pull = jerk * priors.jerk_sd[trial.free] ** -2.0
        cost = 0.5 * float((jerk * pull).sum())
        for ahead, factor in enumerate(THIRD_DIFFERENCE):
            gradient[ahead : ahead + len(pull)] -= factor * pull
    # The mean over the trial is believed, so each frame gets 1/N of the information.
    posture_precision = trial.repeat / len(q) * priors.posture_sd[trial.free] ** -2.0
    posture_precision += priors.moment_sd[trial.free] ** -2.0
    away = q - priors.posture[trial.free]
    cost += 0.5 * float((away**2 * posture_precision).sum())
    gradient -= away * posture_precision
    beyond = np.minimum(q - priors.lower[trial.free], 0.0) + np.maximum(q - priors.upper[trial.free], 0.0)
    limit_precision = priors.limit_sd**-2.0
    cost += 0.5 * float((beyond**2).sum()) * limit_precision
    gradient -= beyond * limit_precision
    return cost, posture_precision + np.where(beyond != 0.0, limit_precision, 0.0), gradient


def _shared_precision(priors: TrialPriors, markers: int) -> Float[np.ndarray, "shared shared"]:
    """Scales, offsets, biases and the mirror."""
    sd = np.concatenate([priors.group_sd, np.repeat(priors.offset_sd_m, 3), np.repeat(priors.bias_sd_px, 2 * markers)])
    corner = np.diag(sd**-2.0)
    groups = len(priors.group_sd)
    mirror = [(right, left, 1.0, MIRROR_SCALE) for right, left in priors.mirrored_groups]
    for right, left in priors.mirrored_markers:
        # Mirroring changes the sign of Z, to the right in every segment.
        mirror += [
            (groups + 3 * right + axis, groups + 3 * left + axis, sign, MIRROR_OFFSET_M)
            for axis, sign in enumerate((1.0, 1.0, -1.0))
        ]
    for right, left, sign, mirror_sd in mirror:
        corner[right, right] += mirror_sd**-2.0
        corner[left, left] += mirror_sd**-2.0
        corner[right, left] -= sign * mirror_sd**-2.0
        corner[left, right] -= sign * mirror_sd**-2.0
    return corner


def _factorise(
    trial: Trial,
    equations: Equations,
    data_share: float,
    damping: float,
    *,
    shared: bool,
    precision: type[np.floating] = np.float64,
) -> BandFactor | BorderedFactor:
    """Assemble the band and factorise it.

    The damping is relative to the diagonal without the jerk prior's: that one is large in every frame but says nothing of
    slow movements, and a damping that knew it would hold those back. What no pixel tells of in a frame is damped a little, too
    (:data:`UNSEEN`): else no damping would keep it within its range.
    """
    frames, size = equations.prior_gradient.shape
    rows = np.zeros((_padded(frames), size, REACH * size + 1))
    for column in range(size):
        np.multiply(equations.data.hessian[:, column:, column], data_share, out=rows[:frames, column, : size - column])
    rows[:frames, :, 0] = (rows[:frames, :, 0] + equations.prior_hessian) * (1.0 + damping)
    smoothness = trial.priors.jerk_sd[trial.free] ** -2.0
    rows[:frames, :, ::size] += trial.jerk_band[:, None, :] * smoothness[:, None]
    rows[:frames, :, 0] += 1e-9 + damping * UNSEEN
    rows[frames:, :, 0] = 1.0  # frames that only fill the last block
    band = rows.reshape(-1, REACH * size + 1)
    if not shared:
        return factorise(band)
    corner = data_share * equations.data.corner + equations.prior_corner
    corner[np.diag_indices_from(corner)] *= 1.0 + damping
    return factorise_bordered(band, _border_rows(equations, data_share, precision), corner)
