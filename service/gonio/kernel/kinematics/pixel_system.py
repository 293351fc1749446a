"""The whole-trial least-squares problem of the fit to pixels: its state, its normal equations, its steps and covariance."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg.blas import dtrmm

from gonio.kernel.body.scaling import scale_model
from gonio.kernel.body.tree import Tree, flatten
from gonio.kernel.kinematics.pixel_priors import MIRROR_OFFSET_M, MIRROR_SCALE, TrialPriors
from gonio.kernel.kinematics.pixel_terms import Layout, Sight, Sums, sum_frames
from gonio.kernel.optimize.block_tridiagonal import BorderedFactor, Factor, factorise, factorise_bordered
from gonio.kernel.parallel import over_blocks
from gonio.records import GROUND, BodyModel

FRAMES_PER_BLOCK = 3
"""A third difference couples a frame with the three after it: blocks of three frames touch only their neighbours."""

_BLOCK = 16  # frames that one thread takes at a time


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

    @property
    def shared(self) -> int:
        """The number of shared unknowns."""
        cameras, _, markers = self.confidence.shape
        return len(self.priors.group_sd) + 3 * markers + 2 * cameras * markers


@dataclass(frozen=True)
class Equations:
    """The normal equations at a state: data and priors apart, since only the data's information is ever tempered."""

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


def linearise(
    trial: Trial, state: State, sigma_px: Float[np.ndarray, " camera"], loss_scale: float, *, shared: bool
) -> Equations:
    """Evaluate the cost and its normal equations at a state; ``sigma_px`` is an observation's of confidence 1."""
    tree = flatten(personalise(trial.model, trial.priors, state))
    sight = Sight(
        trial.projections, trial.uv_px, trial.confidence / sigma_px[:, None, None], state.bias_px.copy(), loss_scale
    )
    node_group, marker_group = _groups(trial)
    body = trial.model.markers.body
    marker_factor = np.where(body != GROUND, body_factor(trial.priors, state)[body], 1.0)
    layout = Layout(trial.free, node_group, marker_group, marker_factor, len(trial.priors.group_sd), shared)
    data, cost = _sum_all(tree, sight, layout, state.q.copy(), trial.shared if shared else 0)
    prior_cost, hessian, gradient = _frame_priors(trial, state)
    shared_cost, corner, shared_gradient = _shared_priors(trial, state)
    return Equations(cost + prior_cost + shared_cost, data, hessian, gradient, corner, shared_gradient)


def step(trial: Trial, equations: Equations, damping: float, *, shared: bool) -> State:
    """Solve the damped normal equations for the change of the state.

    Raises:
        numpy.linalg.LinAlgError: they are not positive definite at this damping.
    """
    frames, size = equations.prior_gradient.shape
    gradient = _in_blocks(equations.data.gradient + equations.prior_gradient)
    factor = _factorise(trial, equations, 1.0, damping, shared=shared)
    theta = np.zeros(trial.shared)
    if isinstance(factor, BorderedFactor):
        moved, theta = factor.solve(gradient, equations.data.shared_gradient + equations.prior_shared_gradient)
    else:
        moved = factor.solve(gradient[..., None])[..., 0]
    change = np.zeros((frames, len(trial.model.coordinates.names)))
    change[:, trial.free] = moved.reshape(-1, size)[:frames]
    groups, (cameras, _, markers) = len(trial.priors.group_sd), trial.confidence.shape
    return State(
        q=change,
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


def shared_covariance(trial: Trial, equations: Equations, data_share: float) -> Float[np.ndarray, "shared shared"]:
    """Give the covariance of what all frames share, their motion being unknown too.

    ``data_share`` is what a residual's information is worth, since residuals of neighbouring frames repeat each other.
    """
    factor = _factorise(trial, equations, data_share, 0.0, shared=True)
    assert isinstance(factor, BorderedFactor)
    return factor.border_inverse()


def frame_covariance(
    trial: Trial, equations: Equations, data_share: float, shared: Float[np.ndarray, "shared shared"]
) -> Float[np.ndarray, "frame free free"]:
    """Give the covariance of each frame's coordinates, where what the frames share has the covariance ``shared``.

    With the motion q, the shared s, Hessian H of the one and B of both: cov q = H⁻¹ + H⁻¹ B cov(s) Bᵀ H⁻¹.
    """
    frames, size = equations.prior_gradient.shape
    factor = _factorise(trial, equations, data_share, 0.0, shared=False)
    assert isinstance(factor, Factor)
    carried = factor.solve(_border_blocks(equations, data_share)).reshape(-1, len(shared))
    # Times the root of the shared covariance, in place: row-major, so that BLAS sees both transposed.
    spread = dtrmm(1.0, np.linalg.cholesky(shared).T, carried.T, lower=0, overwrite_b=1).T.reshape(
        -1, size, len(shared)
    )
    by_frame = factor.inverse_diagonal().reshape(-1, FRAMES_PER_BLOCK, size, FRAMES_PER_BLOCK, size)
    own = np.stack([by_frame[:, i, :, i] for i in range(FRAMES_PER_BLOCK)], axis=1).reshape(-1, size, size)
    return (own + spread @ spread.transpose(0, 2, 1))[:frames]


def _border_blocks(equations: Equations, data_share: float) -> Float[np.ndarray, "block size shared"]:
    """Pad the border to whole blocks of frames."""
    frames, size, shared = equations.data.border.shape
    blocks = -(-frames // FRAMES_PER_BLOCK)
    border = np.empty((blocks * FRAMES_PER_BLOCK, size, shared))
    np.multiply(equations.data.border, data_share, out=border[:frames])
    border[frames:] = 0.0
    return border.reshape(blocks, FRAMES_PER_BLOCK * size, shared)


def _sum_all(tree: Tree, sight: Sight, layout: Layout, q: np.ndarray, shared: int) -> tuple[Sums, float]:
    """Sum all frames on all cores; each block of frames has a corner of its own until the end."""
    cameras, frames, markers = sight.precision.shape
    size = len(layout.free)
    hessian, gradient = np.empty((frames, size, size)), np.empty((frames, size))
    border, error = np.empty((frames, size, shared)), np.empty((cameras, frames, markers, 2))
    starts = range(0, frames, _BLOCK)
    corners, shared_gradients = np.zeros((len(starts), shared, shared)), np.zeros((len(starts), shared))
    costs = np.zeros(len(starts))

    def work(start: int, stop: int) -> None:
        # ``over_blocks`` hands over everything at once where there is but one block.
        number = start // _BLOCK
        sums = Sums(hessian, gradient, border, corners[number], shared_gradients[number], error)
        costs[number] = sum_frames(tree, sight, layout, start, stop, q, sums)

    over_blocks(work, frames, _BLOCK)
    return Sums(hessian, gradient, border, corners.sum(axis=0), shared_gradients.sum(axis=0), error), float(costs.sum())


def _groups(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Give the scale group of each node's placement and of each marker's location."""
    body_group = trial.priors.body_group
    parent, body = trial.model.joints.parent_body, trial.model.markers.body
    return np.where(parent >= 0, body_group[parent], -1), np.where(body >= 0, body_group[body], -1)


def _frame_priors(trial: Trial, state: State) -> tuple[float, np.ndarray, np.ndarray]:
    """Jerk, posture and ranges: cost, diagonal Hessian within frames, gradient (downhill)."""
    priors, q = trial.priors, state.q[:, trial.free]
    jerk_precision = priors.jerk_sd[trial.free] ** -2.0
    rows = jerk_rows(trial.consecutive)
    jerk = _third_difference(q)[rows]
    cost = 0.5 * float((jerk**2 * jerk_precision).sum())
    gradient = np.zeros_like(q)
    starts = np.flatnonzero(rows)
    for ahead, factor in enumerate((-1.0, 3.0, -3.0, 1.0)):
        np.add.at(gradient, starts + ahead, -factor * jerk * jerk_precision)
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


def _shared_priors(trial: Trial, state: State) -> tuple[float, np.ndarray, np.ndarray]:
    """Scales, offsets, biases and the mirror: cost, corner, gradient (downhill)."""
    priors = trial.priors
    theta = np.concatenate([state.log_scale, state.offset_m.ravel(), state.bias_px.ravel()])
    sd = np.concatenate(
        [
            priors.group_sd,
            np.repeat(priors.offset_sd_m, 3),
            np.repeat(priors.bias_sd_px, 2 * state.bias_px.shape[1]),
        ]
    )
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
    corner *= trial.repeat
    downhill = -corner @ theta
    return -0.5 * float(theta @ downhill), corner, downhill


def jerk_rows(consecutive: Bool[np.ndarray, " frame"]) -> Bool[np.ndarray, " frame"]:
    """Mark the frames that, with the three after them, are consecutive in time."""
    rows = np.zeros(len(consecutive), dtype=bool)
    if len(consecutive) > 3:
        rows[:-3] = consecutive[1:-2] & consecutive[2:-1] & consecutive[3:]
    return rows


def _third_difference(q: Float[np.ndarray, "frame free"]) -> Float[np.ndarray, "frame free"]:
    """Give q[t+3] − 3 q[t+2] + 3 q[t+1] − q[t]; the last three are 0."""
    jerk = np.zeros_like(q)
    if len(q) > 3:
        jerk[:-3] = np.diff(q, n=3, axis=0)
    return jerk


def _in_blocks(values: Float[np.ndarray, "frame free"]) -> Float[np.ndarray, "block size"]:
    """Pad the frames to whole blocks and put each block's frames side by side."""
    frames, size = values.shape
    blocks = -(-frames // FRAMES_PER_BLOCK)
    padded = np.zeros((blocks * FRAMES_PER_BLOCK, size))
    padded[:frames] = values
    return padded.reshape(blocks, FRAMES_PER_BLOCK * size)


def _factorise(
    trial: Trial, equations: Equations, data_share: float, damping: float, *, shared: bool
) -> Factor | BorderedFactor:
    """Assemble the blocks and factorise them.

    The damping is relative to the diagonal without the jerk prior's: that one is large in every frame but says nothing of
    slow movements, and a damping that knew it would hold those back.
    """
    frames, size = equations.prior_gradient.shape
    own = data_share * equations.data.hessian
    index = np.arange(size)
    own[:, index, index] = (own[:, index, index] + equations.prior_hessian) * (1.0 + damping)
    diagonal, below = _jerk_blocks(trial, frames, size)
    blocks = len(diagonal)
    padded = np.zeros((blocks * FRAMES_PER_BLOCK, size, size))
    padded[:frames] = own
    padded[frames:, index, index] = 1.0  # frames that only fill the last block
    by_frame = diagonal.reshape(blocks, FRAMES_PER_BLOCK, size, FRAMES_PER_BLOCK, size)
    for i in range(FRAMES_PER_BLOCK):
        by_frame[:, i, :, i] += padded[i::FRAMES_PER_BLOCK]
    whole = np.arange(FRAMES_PER_BLOCK * size)
    diagonal[:, whole, whole] += 1e-9
    if not shared:
        return factorise(diagonal, below)
    corner = data_share * equations.data.corner + equations.prior_corner
    corner[np.diag_indices_from(corner)] *= 1.0 + damping
    return factorise_bordered(diagonal, below, _border_blocks(equations, data_share), corner)


def _jerk_blocks(trial: Trial, frames: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Lay the jerk prior's Hessian out in blocks: the same band for every coordinate, times its precision."""
    precision = trial.priors.jerk_sd[trial.free] ** -2.0
    blocks = -(-frames // FRAMES_PER_BLOCK)
    band = np.zeros((blocks * FRAMES_PER_BLOCK + 3, 4))  # band[t, d] couples frame t with frame t + d
    factors = np.array([-1.0, 3.0, -3.0, 1.0])
    starts = np.flatnonzero(jerk_rows(trial.consecutive))
    for a in range(4):
        for b in range(a, 4):
            np.add.at(band[:, b - a], starts + a, factors[a] * factors[b])
    diagonal = np.zeros((blocks, FRAMES_PER_BLOCK, size, FRAMES_PER_BLOCK, size))
    below = np.zeros((max(blocks - 1, 0), FRAMES_PER_BLOCK, size, FRAMES_PER_BLOCK, size))
    index, first = np.arange(size), FRAMES_PER_BLOCK * np.arange(blocks)
    for a in range(FRAMES_PER_BLOCK):
        for b in range(FRAMES_PER_BLOCK):
            within = band[first + min(a, b), abs(a - b)]
            diagonal[:, a, index, b, index] += within[:, None] * precision
            apart = FRAMES_PER_BLOCK + a - b
            if apart <= 3 and blocks > 1:
                across = band[first[:-1] + b, apart]
                below[:, a, index, b, index] += across[:, None] * precision
    width = FRAMES_PER_BLOCK * size
    return diagonal.reshape(blocks, width, width), below.reshape(-1, width, width)
