"""Bundle adjustment of cameras and board poses: intrinsics with a prior, a delay per camera, a robust loss.

Each frame's board pose is eliminated (Schur's complement), so the cost is linear in the number of frames [Triggs et al.
2000, §6.1]. One camera alone is the same problem without a rig: the refinement of its intrinsics.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.errors import SolverError
from gonio.kernel.calibration.board_terms import BOARD_UNKNOWNS, CAMERA_UNKNOWNS, measure_frames, sum_frames
from gonio.kernel.parallel import one_blas_thread, over_blocks
from gonio.records import record

SIGMA_PX = 0.3
"""Standard deviation of a good corner, per axis; where the residuals say otherwise, they are believed."""

CAUCHY_SIGMAS = 3.0
"""Cauchy's loss turns from square to logarithm at this many standard deviations: clean corners keep 0.8 of their weight."""

ROUNDS = 4
"""So often the level of noise is estimated anew, which weighs the corners against the prior and sets the loss's scale."""

STEP_TOLERANCE = 0.01
"""A step that changes no parameter by more than this part of its standard deviation is the last."""

NEAR = 3.0
"""Steps smaller than this, in standard deviations, are Newton's; farther out reweighted least squares is the safer one."""

MOST_BEND = 0.9
"""Beyond its scale the loss is concave along the residual: there it is taken as nearly flat, or Newton's step turns back."""

HUGE_PX2 = 1e8
MAX_ITERATIONS = 60
BLOCK_FRAMES = 128


@record
class Observations:
    """What all cameras saw of the board, ready to be explained; ``ref`` is the frame of the first camera.

    ``uv_px`` are pixels of the distorted image, ``velocity_px_s`` how fast each corner moves there (0 where unknown).
    ``weight`` is the inverse variance of an observation against that of a good one: 0 is missing, 1 a corner at rest.
    """

    corners_board_m: Float[np.ndarray, "corner 3"]
    uv_px: Float[np.ndarray, "camera frame corner 2"]
    velocity_px_s: Float[np.ndarray, "camera frame corner 2"]
    weight: Float[np.ndarray, "camera frame corner"]


@record
class Scene:
    """Cameras and boards: ``theta`` holds each camera's focal_px, aspect, cx_px, cy_px, k1, k2, p1, p2, k3 and delay_s."""

    theta: Float[np.ndarray, "camera 10"]
    Ts_cam_ref: Float[np.ndarray, "camera 4 4"]
    Ts_ref_board: Float[np.ndarray, "frame 4 4"]


@record
class Prior:
    """What is known of ``theta`` beforehand (inverse covariance about ``mean``), and which unknowns may move at all.

    ``free`` is in the order of :mod:`gonio.kernel.calibration.board_terms`: pose first, then ``theta``.
    """

    mean: Float[np.ndarray, "camera 10"]
    information: Float[np.ndarray, "camera 10 10"]
    free: Bool[np.ndarray, "camera 16"]


@record
class Adjusted:
    """The outcome of a bundle adjustment.

    ``covariance`` is that of all cameras' unknowns, in the order camera, unknown (0 for those that are held).
    ``sigma_px`` is the noise that the residuals show, per axis, of an observation of weight 1; ``inflation`` by how much
    the corners of one picture err together, so that they count for that many times fewer. ``residual_px`` is observed
    minus predicted, NaN where nothing was observed; ``share`` is what the robust loss left to each observation.
    """

    scene: Scene
    covariance: Float[np.ndarray, "unknown unknown"]
    sigma_px: float
    inflation: float
    residual_px: Float[np.ndarray, "camera frame corner 2"]
    share: Float[np.ndarray, "camera frame corner"]
    converged: bool
    iterations: int

    def sd(self, camera: int) -> Float[np.ndarray, "16"]:
        """Give the standard deviations of a camera's unknowns."""
        first = camera * CAMERA_UNKNOWNS
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0)[first : first + CAMERA_UNKNOWNS])


@dataclass(frozen=True)
class _Normal:
    """The reduced normal equations of the cameras' free unknowns, each frame's part of the right side, and the way back."""

    matrix: Float[np.ndarray, "free free"]
    right: Float[np.ndarray, " free"]
    frame_right: Float[np.ndarray, "frame free"]
    cross: Float[np.ndarray, "frame 6 free"]
    g_board: Float[np.ndarray, "frame 6"]
    inverse_board: Float[np.ndarray, "frame 6 6"]


def adjust(
    observations: Observations, start: Scene, prior: Prior, *, sigma_px: float = SIGMA_PX, inflation: float = 1.0
) -> Adjusted:
    """Find the cameras and board poses that explain the corners best.

    The level of noise is estimated along the way, and so is how far the corners of a picture err together (blur, a bent
    board, a picture taken at another instant): a prior counts against as many independent corners as there really are.

    Args:
        observations: The corners.
        start: Where to start from.
        prior: What is known beforehand, and what may move.
        sigma_px: What the noise is taken to be at first.
        inflation: What the corners' erring together is taken to be at first.

    Raises:
        SolverError: ``calibration-diverged``: the normal equations are singular, so something is not determined at all.
    """
    with one_blas_thread():
        adjusted = _round(observations, start, prior, sigma_px, inflation)
        for _ in range(ROUNDS - 1):
            if abs(adjusted.sigma_px / sigma_px - 1) < 0.1 and abs(adjusted.inflation / inflation - 1) < 0.3:
                break
            sigma_px, inflation = adjusted.sigma_px, adjusted.inflation
            adjusted = _round(observations, adjusted.scene, prior, sigma_px, inflation)
    return adjusted


def pose_boards(observations: Observations, scene: Scene) -> Scene:
    """Find the boards' poses alone, the cameras being held."""
    count = len(scene.theta)
    held = Prior(
        mean=scene.theta,
        information=np.zeros((count, 10, 10)),
        free=np.zeros((count, CAMERA_UNKNOWNS), dtype=bool),
    )
    return _minimise(observations, scene, held, SIGMA_PX)[0]


def _round(observations: Observations, start: Scene, prior: Prior, sigma_px: float, inflation: float) -> Adjusted:
    """Minimise at a given level of noise, and estimate it anew."""
    tempered = replace(prior, information=inflation * prior.information)
    scene, converged, iterations = _minimise(observations, start, tempered, sigma_px)
    residual = _residuals(observations, scene)
    sigma_px = _robust_sigma(residual, observations.weight)
    covariance, inflation = _covariance(observations, scene, tempered, residual, sigma_px)
    return Adjusted(
        scene=scene,
        covariance=covariance,
        sigma_px=sigma_px,
        inflation=inflation,
        residual_px=residual,
        share=_share(residual, observations.weight, sigma_px),
        converged=converged,
        iterations=iterations,
    )


def _minimise(observations: Observations, scene: Scene, prior: Prior, sigma_px: float) -> tuple[Scene, bool, int]:
    """Run Levenberg-Marquardt at a given level of noise: the scene, whether it converged, and the iterations."""
    residual = _residuals(observations, scene)
    cost, damping = _cost(residual, observations.weight, sigma_px, scene, prior), 1e-3
    size = np.inf
    for iteration in range(1, MAX_ITERATIONS + 1):
        share = _share(residual, observations.weight, sigma_px)
        weight = observations.weight * share / sigma_px**2
        bend = np.minimum(2 * (1 - share), MOST_BEND) if size < NEAR else None
        trial, size = _step(scene, prior, _normal(observations, scene, prior, weight, bend, damping))
        trial_residual = _residuals(observations, trial)
        trial_cost = _cost(trial_residual, observations.weight, sigma_px, trial, prior)
        if trial_cost <= cost:
            scene, residual, cost = trial, trial_residual, trial_cost
            damping = max(damping / 10, 1e-9)
        else:
            damping *= 10
        if size < STEP_TOLERANCE:
            return scene, True, iteration
    return scene, False, MAX_ITERATIONS


def _residuals(observations: Observations, scene: Scene) -> Float[np.ndarray, "camera frame corner 2"]:
    residual = np.full(observations.uv_px.shape, np.nan)

    def measure(start: int, stop: int) -> None:
        measure_frames(
            scene.theta, scene.Ts_cam_ref, scene.Ts_ref_board, observations.corners_board_m, observations.uv_px,
            observations.velocity_px_s, observations.weight, start, stop, residual,
        )  # fmt: skip

    over_blocks(measure, observations.uv_px.shape[1], BLOCK_FRAMES)
    return residual


def _squared(residual: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "camera frame corner"]:
    """Give the weighted squared length of each residual, 0 where nothing was observed; behind a camera it is just huge."""
    return np.where(weight > 0, weight * np.minimum((residual**2).sum(axis=-1), HUGE_PX2), 0.0)


def _share(residual: np.ndarray, weight: np.ndarray, sigma_px: float) -> Float[np.ndarray, "camera frame corner"]:
    return 1.0 / (1.0 + _squared(residual, weight) / (CAUCHY_SIGMAS * sigma_px) ** 2)


def _cost(residual: np.ndarray, weight: np.ndarray, sigma_px: float, scene: Scene, prior: Prior) -> float:
    squared = _squared(residual, weight) / (CAUCHY_SIGMAS * sigma_px) ** 2
    off = scene.theta - prior.mean
    return float(CAUCHY_SIGMAS**2 * np.log1p(squared).sum() + np.einsum("ci,cij,cj->", off, prior.information, off))


def _robust_sigma(residual: np.ndarray, weight: np.ndarray) -> float:
    """Give the standard deviation per axis from the median length: 1.1774 σ for a normal distribution in the plane."""
    lengths = np.sqrt(_squared(residual, weight)[weight > 0])
    return max(float(np.median(lengths)) / 1.1774, 1e-3) if lengths.size else SIGMA_PX


def _normal(
    observations: Observations,
    scene: Scene,
    prior: Prior,
    weight: np.ndarray,
    bend: np.ndarray | None = None,
    damping: float = 0.0,
) -> _Normal:
    """Sum up the damped normal equations and eliminate the boards.

    ``bend`` makes them those of Newton's method for Cauchy's loss, whose curvature along a residual is less than the
    weight [Triggs et al. 2000, §4.3]: reweighted least squares without it takes four times as many steps.
    """
    cameras, frames = weight.shape[:2]
    bends = np.zeros_like(weight) if bend is None else bend
    H_camera = np.zeros((frames, cameras, CAMERA_UNKNOWNS, CAMERA_UNKNOWNS))
    H_cross = np.zeros((frames, cameras, CAMERA_UNKNOWNS, BOARD_UNKNOWNS))
    H_board, g_board = np.zeros((frames, BOARD_UNKNOWNS, BOARD_UNKNOWNS)), np.zeros((frames, BOARD_UNKNOWNS))
    g_camera = np.zeros((frames, cameras, CAMERA_UNKNOWNS))

    def accumulate(start: int, stop: int) -> None:
        sum_frames(
            scene.theta, scene.Ts_cam_ref, scene.Ts_ref_board, observations.corners_board_m, observations.uv_px,
            observations.velocity_px_s, weight, bends, start, stop, H_camera, H_cross, H_board, g_camera, g_board,
        )  # fmt: skip

    over_blocks(accumulate, frames, BLOCK_FRAMES)
    free = prior.free.ravel()
    blocks = H_camera.sum(axis=0)
    blocks[:, 6:, 6:] += prior.information
    matrix = _from_blocks(blocks)[np.ix_(free, free)]
    matrix[np.diag_indices_from(matrix)] *= 1 + damping
    # A board that only one camera sees from afar may leave a direction open: a trace of its own size keeps it solvable.
    least = 1e-12 * np.trace(H_board, axis1=1, axis2=2)[:, None, None] + 1e-300
    inverse_board = np.linalg.inv(H_board + (damping * H_board + least) * np.eye(BOARD_UNKNOWNS))
    cross = H_cross.transpose(0, 3, 1, 2).reshape(frames, BOARD_UNKNOWNS, -1)[..., free]
    carried = inverse_board @ cross
    matrix -= cross.reshape(frames * BOARD_UNKNOWNS, -1).T @ carried.reshape(frames * BOARD_UNKNOWNS, -1)
    frame_right = g_camera.reshape(frames, -1)[:, free] - np.einsum("fbi,fb->fi", carried, g_board)
    pull = np.zeros((cameras, CAMERA_UNKNOWNS))
    pull[:, 6:] = np.einsum("cij,cj->ci", prior.information, prior.mean - scene.theta)
    return _Normal(
        matrix=matrix,
        right=frame_right.sum(axis=0) + pull.ravel()[free],
        frame_right=frame_right,
        cross=cross,
        g_board=g_board,
        inverse_board=inverse_board,
    )


def _from_blocks(blocks: Float[np.ndarray, "camera 16 16"]) -> Float[np.ndarray, "unknown unknown"]:
    """Put each camera's block on the diagonal of one matrix."""
    count = len(blocks)
    matrix = np.zeros((count, CAMERA_UNKNOWNS, count, CAMERA_UNKNOWNS))
    matrix[np.arange(count), :, np.arange(count)] = blocks
    return matrix.reshape(count * CAMERA_UNKNOWNS, -1)


def _step(scene: Scene, prior: Prior, normal: _Normal) -> tuple[Scene, float]:
    """Move the scene by the solution of the normal equations; also give the step's size in standard deviations."""
    try:
        solved = np.linalg.solve(normal.matrix, normal.right)
    except np.linalg.LinAlgError as error:
        raise _singular() from error
    board_step = np.einsum("fij,fj->fi", normal.inverse_board, normal.g_board - normal.cross @ solved)
    own = np.einsum("fi,fi->f", board_step, normal.g_board)
    size = float(np.sqrt(max(solved @ normal.right, own.max(initial=0.0), 0.0)))
    camera_step = np.zeros(prior.free.size)
    camera_step[prior.free.ravel()] = solved
    camera_step = camera_step.reshape(-1, CAMERA_UNKNOWNS)
    moved = np.zeros_like(scene.Ts_cam_ref)
    moved[:, :3, :3] = Rotation.from_rotvec(camera_step[:, :3]).as_matrix()
    moved[:, :3, 3], moved[:, 3, 3] = camera_step[:, 3:6], 1.0
    boards = scene.Ts_ref_board.copy()
    boards[:, :3, :3] = Rotation.from_rotvec(board_step[:, :3]).as_matrix() @ boards[:, :3, :3]
    boards[:, :3, 3] += board_step[:, 3:]
    return Scene(theta=scene.theta + camera_step[:, 6:], Ts_cam_ref=moved @ scene.Ts_cam_ref, Ts_ref_board=boards), size


def _covariance(
    observations: Observations, scene: Scene, prior: Prior, residual: np.ndarray, sigma_px: float
) -> tuple[Float[np.ndarray, "unknown unknown"], float]:
    """Give the covariance of the cameras' unknowns, and by how much the pictures' own scatter widens it.

    An M-estimator's information is ``(E ψ')² / E ψ²`` of least squares' [Huber & Ronchetti 2009, §7.6]. That counts all
    corners as independent. The sum over the pictures of the squared gradients, against its expectation, says how much
    wider the truth scatters [Liang & Zeger 1986]. A single factor for all unknowns: forty pictures can't tell forty.
    """
    squared, observed = _squared(residual, observations.weight), observations.weight > 0
    share = _share(residual, observations.weight, sigma_px)
    freedom = max(2 * int(observed.sum()) - BOARD_UNKNOWNS * residual.shape[1] - int(prior.free.sum()), 1)
    spread = float((share**2 * squared).sum()) / freedom
    slope = float((share - share**2 * squared / (CAUCHY_SIGMAS * sigma_px) ** 2)[observed].mean())
    information = _normal(observations, scene, prior, observations.weight * slope**2 / spread).matrix
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError as error:
        raise _singular() from error
    scores = _normal(observations, scene, prior, observations.weight * share * slope / spread).frame_right
    scores = scores - scores.mean(axis=0)
    scatter = np.einsum("fi,ij,fj->", scores, inverse, scores) * len(scores) / max(len(scores) - 1, 1)
    free = prior.free.ravel()
    blocks = np.zeros((len(prior.free), CAMERA_UNKNOWNS, CAMERA_UNKNOWNS))
    blocks[:, 6:, 6:] = prior.information
    expected = np.einsum("ij,ji->", information - _from_blocks(blocks)[np.ix_(free, free)], inverse)
    inflation = max(float(scatter / expected), 1.0)
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = inverse * inflation
    return covariance, inflation


def _singular() -> SolverError:
    return SolverError(
        "The cameras can't be determined from these pictures of the board.",
        hint="Film the board again: closer, tilted in all directions, and seen by two cameras at a time.",
        code="calibration-diverged",
    )
