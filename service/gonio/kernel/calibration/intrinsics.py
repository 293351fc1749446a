"""A camera's focal length, centre and distortion from pictures of a flat board, with honest error bars.

Zhang's closed form gives the start [Zhang 2000, §3.1], bundle adjustment of the single camera the answer. The lens model is
chosen by the error in views that were held out: more coefficients always fit better and often predict worse.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.errors import CaptureError
from gonio.kernel.calibration.board_terms import ASPECT, CX, CY, DELAY, FOCAL, K1, K2, K3, P1, P2
from gonio.kernel.calibration.boards import Adjusted, Observations, Prior, Scene, adjust
from gonio.kernel.calibration.planar_pose import homographies, locate_board, spans_the_plane
from gonio.records import Board, Camera, Intrinsics
from gonio.records.intrinsics import LensModel, Origin

FREE: dict[LensModel, tuple[int, ...]] = {
    "k1": (FOCAL, CX, CY, K1),
    "k1k2": (FOCAL, CX, CY, K1, K2),
    "k1k2_aspect": (FOCAL, ASPECT, CX, CY, K1, K2),
    "brown": (FOCAL, ASPECT, CX, CY, K1, K2, P1, P2, K3),
}
DEFAULT: LensModel = "k1k2"

MIN_VIEWS = 3
"""Zhang's minimum for a focal length and a centre; a good calibration has twenty or more."""

FOLDS = 4
SMALLEST_GAIN = 0.05
"""A richer lens model must lower the held-out error by this share, have every new coefficient at 3 standard deviations …"""

RICH_RADIUS = 0.8
"""… and corners this far out, as a share of the half diagonal: what bends the edge is not seen in the middle."""

TILT_DEG = 20.0
"""A board that is tilted by less tells depth and focal length apart so badly that its own error bars are wrong."""

WEAK_SD = {FOCAL: 0.5, ASPECT: 0.02, CX: 0.15, CY: 0.15, K1: 1.0, K2: 2.0, P1: 0.02, P2: 0.02, K3: 4.0}
"""What any camera's lens is like before it was seen (focal length and centre against the image's width): it decides
nothing where the corners reach, and keeps a coefficient from running away where they don't."""

OUTLIER_PX, OUTLIER_FACTOR = 1.2, 3.0


@dataclass(frozen=True)
class _Views:
    """The pictures that have a pose: their corners, and the image's size."""

    board: Board
    uv_px: Float[np.ndarray, "frame corner 2"]
    image_size_px: tuple[int, int]

    def some(self, chosen: np.ndarray) -> "_Views":
        return replace(self, uv_px=self.uv_px[chosen])


def solve_intrinsics(
    board: Board,
    uv_px: Float[np.ndarray, "frame corner 2"],
    image_size_px: tuple[int, int],
    *,
    camera_name: str = "",
    origin: Origin = "recording",
    source: str = "",
    model: LensModel | None = None,
) -> Intrinsics:
    """Calibrate one camera from pictures of a board; corners that were not found are NaN.

    Args:
        board: The board.
        uv_px: Its corners in the distorted pictures.
        image_size_px: Width and height.
        camera_name: Goes into the result and the errors.
        origin: Whether the pictures are a recording of their own; decides how far the result is believed.
        source: Where the pictures come from, for the result.
        model: The lens model; chosen by held-out error if None.

    Raises:
        CaptureError: ``intrinsics-too-few-views``: fewer than three usable pictures.
        SolverError: ``calibration-diverged``.
    """
    usable = spans_the_plane(board.corners_board_m, uv_px)
    if usable.sum() < MIN_VIEWS:
        raise CaptureError(
            f"Camera {camera_name}: the board was found in too few pictures to calibrate its lens: {int(usable.sum())}.",
            hint="Film the board close, so that it fills half of the picture, tilted in all directions: 20 pictures or more.",
            code="intrinsics-too-few-views",
            views=int(usable.sum()),
        )
    views = _Views(board, uv_px[usable], image_size_px)
    views = _without_outliers(views, _solve(views, DEFAULT))
    chosen = model or choose_model(views.board, views.uv_px, image_size_px)
    solved = _solve(views, chosen)
    return Intrinsics(
        camera_name=camera_name,
        image_size_px=image_size_px,
        model=chosen,
        parameters=solved.scene.theta[0, :DELAY],
        covariance=solved.covariance[6 : 6 + DELAY, 6 : 6 + DELAY],
        held_out_px=held_out_error_px(views, chosen),
        rms_px=float(np.sqrt(np.nanmean((solved.residual_px[0] ** 2).sum(axis=-1)))),
        views=len(views.uv_px),
        tilted_views=int((tilts_deg(solved.scene.Ts_ref_board) > TILT_DEG).sum()),
        covered=coverage(views.uv_px, image_size_px),
        origin=origin,
        source=source,
    )


def choose_model(board: Board, uv_px: Float[np.ndarray, "frame corner 2"], image_size_px: tuple[int, int]) -> LensModel:
    """Choose the lens model: a richer one than k1, k2 only if held-out views, its own error bars and coverage agree."""
    views = _Views(board, uv_px, image_size_px)
    middle = (np.array(image_size_px) - 1) / 2
    radius = np.nanmax(np.linalg.norm(uv_px - middle, axis=-1)) / np.linalg.norm(middle)
    best, error = DEFAULT, held_out_error_px(views, DEFAULT)
    if radius < RICH_RADIUS or not np.isfinite(error):
        return best
    for richer in ("k1k2_aspect", "brown"):
        trial = held_out_error_px(views, richer)
        if trial < (1 - SMALLEST_GAIN) * error and _is_significant(_solve(views, richer), richer):
            best, error = richer, trial
    return best


def _is_significant(solved: Adjusted, model: LensModel) -> bool:
    extra = [place for place in FREE[model] if place not in FREE[DEFAULT]]
    neutral = np.where(np.array(extra) == ASPECT, 1.0, 0.0)
    return bool(np.any(np.abs(solved.scene.theta[0, extra] - neutral) > 3 * solved.sd(0)[6:][extra]))


def held_out_error_px(views: _Views, model: LensModel) -> float:
    """Give the root mean square error per corner in views that the lens was not solved from, their poses fitted anew."""
    count = len(views.uv_px)
    if count < FOLDS + MIN_VIEWS - 1:
        return np.nan
    squared, corners = 0.0, 0
    for fold in range(FOLDS):
        held_out = np.arange(count) % FOLDS == fold
        lens = camera_of(_solve(views.some(~held_out), model).scene.theta[0], views.image_size_px)
        rms = locate_board(lens, views.board.corners_board_m, views.uv_px[held_out]).rms_px[:, 0]
        seen = np.isfinite(views.uv_px[held_out, :, 0]).sum(axis=1)
        squared += float(np.nansum(rms**2 * seen))
        corners += int(seen[np.isfinite(rms)].sum())
    return float(np.sqrt(squared / corners)) if corners else np.nan


def _without_outliers(views: _Views, solved: Adjusted) -> _Views:
    """Drop corners that lie far off under a first solution, and then pictures that fit badly as a whole."""
    error = np.linalg.norm(solved.residual_px[0], axis=-1)
    scale = views.image_size_px[0] / 1280
    limit = max(OUTLIER_FACTOR * float(np.nanmedian(error)), OUTLIER_PX * max(scale, 0.5))
    kept = np.where((error <= limit)[..., None], views.uv_px, np.nan)
    good = spans_the_plane(views.board.corners_board_m, kept)
    return replace(views, uv_px=kept[good]) if good.sum() >= MIN_VIEWS else views


def _solve(views: _Views, model: LensModel) -> Adjusted:
    theta = _start(views)
    lens = camera_of(theta, views.image_size_px)
    poses = locate_board(lens, views.board.corners_board_m, views.uv_px).T_cam_board[:, 0]
    posed = np.isfinite(poses[:, 0, 0])
    uv_px = views.uv_px[posed]
    seen = np.isfinite(uv_px[..., 0])
    free = np.zeros((1, 16), dtype=bool)
    free[0, [6 + place for place in FREE[model]]] = True
    width = views.image_size_px[0]
    sd = np.array([WEAK_SD[place] * (width if place in (FOCAL, CX, CY) else 1.0) for place in range(DELAY)] + [1.0])
    middle = theta.copy()
    middle[CX], middle[CY] = (np.array(views.image_size_px) - 1) / 2
    return adjust(
        Observations(
            corners_board_m=views.board.corners_board_m,
            uv_px=np.where(seen[..., None], uv_px, 0.0)[None],
            velocity_px_s=np.zeros((1, *uv_px.shape)),
            weight=seen.astype(float)[None],
        ),
        Scene(theta=theta[None], Ts_cam_ref=np.eye(4)[None], Ts_ref_board=poses[posed]),
        Prior(mean=middle[None], information=np.diag(sd**-2.0)[None], free=free),
    )


def _start(views: _Views) -> Float[np.ndarray, "10"]:
    """Give Zhang's closed form for square pixels, without distortion; the centre in the middle where that is sounder."""
    width, height = views.image_size_px
    seen = np.isfinite(views.uv_px[..., 0])
    plane = np.broadcast_to(views.board.corners_board_m[:, :2], views.uv_px.shape)
    middle = np.array([width - 1, height - 1]) / 2
    scaled = (views.uv_px - middle) / width  # of order 1, or the equations are badly scaled
    focal, centre = zhang_focal(homographies(plane, scaled, seen))
    theta = np.zeros(10)
    theta[FOCAL], theta[ASPECT] = focal * width, 1.0
    theta[[CX, CY]] = middle + centre * width
    return theta


def zhang_focal(H_image_plane: Float[np.ndarray, "frame 3 3"]) -> tuple[float, Float[np.ndarray, "2"]]:
    """Solve for focal length and centre from homographies, for square pixels [Zhang 2000, eqs. 3 and 4].

    Image coordinates must be of order 1 about the picture's middle. With the centre on the wrong side of reason (noise,
    few or upright views) it is taken as 0, and a focal length that no view determines as 1.
    """
    H = H_image_plane / np.linalg.norm(H_image_plane[:, :, :2], axis=(1, 2))[:, None, None]
    h, g = H[:, :, 0], H[:, :, 1]

    def row(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "frame 4"]:
        # aᵀ B b with B = [[b0, 0, b1], [0, b0, b2], [b1, b2, b3]], the image of the absolute conic.
        return np.stack(
            [
                a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1],
                a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
                a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1],
                a[:, 2] * b[:, 2],
            ],
            axis=-1,
        )

    equations = np.concatenate([row(h, g), row(h, h) - row(g, g)])
    solution = np.linalg.svd(equations)[2][-1]
    if abs(solution[0]) > 1e-12:
        centre = -solution[1:3] / solution[0]
        squared = solution[3] / solution[0] - centre @ centre
        if np.abs(centre).max() < 0.15 and 0.04 < squared < 100:
            return float(np.sqrt(squared)), centre
    # The centre in the middle: b0 (first) + b3 (last) = 0, so f² = −Σ last² / Σ first · last.
    first, last = equations[:, 0], equations[:, 3]
    squared = -float(last @ last) / float(first @ last) if abs(float(first @ last)) > 1e-15 else 1.0
    return (float(np.sqrt(squared)) if 0.04 < squared < 100 else 1.0), np.zeros(2)


def camera_of(theta: Float[np.ndarray, "10"], image_size_px: tuple[int, int], name: str = "") -> Camera:
    """Make a camera of a row of ``theta``, standing at the origin."""
    focal = theta[FOCAL]
    return Camera(
        name=name,
        image_size_px=image_size_px,
        intrinsic_px=np.array([[focal, 0.0, theta[CX]], [0.0, focal * theta[ASPECT], theta[CY]], [0.0, 0.0, 1.0]]),
        distortion=theta[K1 : K3 + 1],
        T_lab_cam=np.eye(4),
    )


def tilts_deg(T_cam_board: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, " frame"]:
    """Give the angle between each board and the image plane, in degrees.

    Not against the line of sight: a board parallel to the picture tells nothing of the focal length wherever it is in it.
    """
    return np.rad2deg(np.arccos(np.clip(np.abs(T_cam_board[:, 2, 2]), 0.0, 1.0)))


def coverage(uv_px: Float[np.ndarray, "frame corner 2"], image_size_px: tuple[int, int]) -> Bool[np.ndarray, "4 6"]:
    """Say in which cells of a grid of 6 × 4 over the picture corners were seen."""
    seen = uv_px[np.isfinite(uv_px[..., 0])]
    covered = np.zeros((4, 6), dtype=bool)
    cell = np.floor((seen + 0.5) / np.array(image_size_px) * (6, 4)).astype(int)
    inside = np.all((cell >= 0) & (cell < (6, 4)), axis=1)
    covered[cell[inside, 1], cell[inside, 0]] = True
    return covered


def choose_views(
    board: Board,
    uv_px: Float[np.ndarray, "frame corner 2"],
    sharpness: Float[np.ndarray, " frame"],
    image_size_px: tuple[int, int],
    count: int = 30,
) -> Int[np.ndarray, " chosen"]:
    """Choose pictures that differ most: farthest-point sampling over place, distance and tilt, the sharper half first.

    Pictures in which the board has no pose are never chosen. The result is in the order of time.
    """
    width, height = image_size_px
    rough = np.array(
        [width, 1.0, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0, 0]
    )  # good enough to tell views apart
    poses = locate_board(camera_of(rough, image_size_px), board.corners_board_m, uv_px)
    posed = np.flatnonzero(poses.known)
    if len(posed) <= count:
        return posed
    sharp = posed[sharpness[posed] >= np.median(sharpness[posed])]
    pool = sharp if len(sharp) >= count else posed
    T_cam_board = poses.T_cam_board[pool, 0]
    centre = np.stack([np.nanmean(uv_px[frame], axis=0) for frame in pool]) / width
    distance = np.log(np.linalg.norm(T_cam_board[:, :3, 3], axis=1))
    normal = T_cam_board[:, :2, 2]
    features = np.column_stack([centre, distance, normal])
    chosen = [int(np.argmax(np.abs(normal).sum(axis=1)))]
    nearest = np.full(len(pool), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(nearest)))
    return np.sort(pool[chosen])
