"""Made-up calibration recordings whose truth is known, good ones and spoiled ones.

The rig is that of the paper which gonio follows: four cameras of 720 × 540 pixels on a ring of 3.5 m radius, 2 m high, that
look at its middle. A board is swept through the volume by hand: it turns, tilts and never stops.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.calibration.intrinsics import coverage
from gonio.kernel.geometry.cameras import distort, undistort
from gonio.kernel.geometry.transforms import apply, transform
from gonio.kernel.triangulation.points import triangulate
from gonio.kernel.virtual_lab import make_rig
from gonio.records import Board, BoardViews, Camera, Intrinsics, Rig

IMAGE_SIZE_PX = (720, 540)
PAPER_RIG = make_rig(4, radius_m=3.5, height_m=2.0, image_size_px=IMAGE_SIZE_PX, focal_px=600.0)
BOARD = Board(name="virtual 7 × 5", kind="charuco", corners_across=7, corners_down=5, square_m=0.1, marker_m=0.075,
              dictionary="DICT_5X5_100")  # fmt: skip
RATE_HZ = 5.0
PRIOR_SD = np.array([0.005, 0.0, 3.0, 3.0, 0.04, 0.07, 0.0, 0.0, 0.0])
"""How far a separate calibration of the lenses is off: focal length (a share), centre (px), k1, k2."""


@dataclass(frozen=True)
class Filming:
    """How a session is filmed, and what goes wrong in it; the defaults are a good session."""

    still: bool = False
    """The board is held still at as many places, in no order; else it moves all the time."""
    poses: int = 120
    noise_px: float = 0.3
    delays_s: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    bump_deg: float = 0.0
    """The second camera is turned by this half-way."""
    blur_s: float = 0.0
    """Every picture shows its own instant, off by this standard deviation."""
    stretch: float = 0.0
    """The board was printed longer by this share across."""
    upright: bool = False
    """The board is held parallel to the first camera's picture all the time."""
    blind_camera: bool = False
    """The last camera never sees the board."""


@dataclass(frozen=True)
class Session:
    """A filmed session and its truth: ``rig`` in the lab, the optics, and where the board was."""

    views: BoardViews
    rig: Rig
    Ts_lab_board: Float[np.ndarray, "frame 4 4"]
    delays_s: Float[np.ndarray, " camera"]
    optics: tuple[Intrinsics, ...] = field(default=())


def scatter_lenses(rig: Rig, source: np.random.Generator) -> Rig:
    """Make the lenses of a rig differ: by 2 % in focal length, some pixels in their centre, 0.02 in their distortion."""
    cameras: list[Camera] = []
    for camera in rig.cameras:
        intrinsic_px = camera.intrinsic_px.copy()
        intrinsic_px[[0, 1], [0, 1]] *= 1 + 0.02 * source.normal()
        intrinsic_px[:2, 2] += camera.image_size_px[0] / 144 * source.normal(size=2)
        distortion = np.array([-0.05, 0.1, 0.0, 0.0, 0.0])
        distortion[:2] += 0.02 * source.normal(size=2)
        cameras.append(replace(camera, intrinsic_px=intrinsic_px, distortion=distortion))
    return replace(rig, cameras=tuple(cameras))


class Sweep:
    """Where the board is: anywhere in 3 × 1.5 × 3 m, its front turned to the side and upwards, rolled by any angle.

    Held still, each pose is a new one; moving, all of it changes smoothly, by some 0.4 m/s and 40° a second.
    """

    def __init__(self, source: np.random.Generator, board: Board, filming: Filming) -> None:
        self._source = source
        self._filming = filming
        self._middle = board.corners_board_m.mean(axis=0)
        self._phases = source.uniform(0, 2 * np.pi, 6)
        self._rates = source.uniform(0.05, 0.09, 6) * 2 * np.pi

    def poses(self, times_s: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 4 4"]:
        """Give ``T_lab_board`` at each time."""
        if self._filming.still:
            # The same poses, whoever asks: the generator is spawned from the phases.
            x, y, z, turn, tilt, roll = np.random.default_rng(int(1e6 * self._phases[0])).uniform(
                -1, 1, (6, len(times_s))
            )
        else:
            # A triangle wave fills its range evenly; its arc sine does not turn back abruptly.
            waves = np.sin(np.outer(self._rates, times_s) + self._phases[:, None])
            x, y, z, turn, tilt, roll = np.arcsin(0.98 * waves) / np.arcsin(0.98)
            turn = turn + 0.08 * times_s
        azimuth, elevation = np.pi * turn, 0.7 + 0.5 * tilt
        if self._filming.upright:
            azimuth, elevation, roll = 0 * azimuth, 0 * elevation + 0.3, 0 * roll
        return _facing(
            azimuth, elevation, np.pi * roll, np.stack([1.5 * x, 1.05 + 0.75 * y, 1.5 * z], -1), self._middle
        )


def _facing(
    azimuth_rad: np.ndarray, elevation_rad: np.ndarray, roll_rad: np.ndarray, centre_m: np.ndarray, middle_m: np.ndarray
) -> Float[np.ndarray, "time 4 4"]:
    """Pose boards so that their middle is at the centre and the printed side, board −Z, looks where it is told."""
    level = np.cos(elevation_rad)
    z = -np.stack([level * np.cos(azimuth_rad), np.sin(elevation_rad), level * np.sin(azimuth_rad)], axis=-1)
    x = np.cross(np.broadcast_to([0.0, 1.0, 0.0], z.shape), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rolled = Rotation.from_rotvec(np.outer(roll_rad, [0.0, 0.0, 1.0])).as_matrix()
    T = np.zeros((len(z), 4, 4))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1) @ rolled
    T[:, :3, 3], T[:, 3, 3] = centre_m - T[:, :3, :3] @ middle_m, 1.0
    return T


def film(seed: int, filming: Filming = Filming()) -> Session:
    """Film a session: the corners that each camera sees from the front and inside its picture."""
    source = np.random.default_rng(seed)
    rig = scatter_lenses(PAPER_RIG, source)
    sweep = Sweep(source, BOARD, filming)
    times_s = np.arange(filming.poses) * (10.0 if filming.still else 1 / RATE_HZ)
    printed = BOARD.corners_board_m * np.array([1 + filming.stretch, 1.0, 1.0])
    uv_px = np.full((len(rig.cameras), filming.poses, BOARD.corner_count, 2), np.nan)
    for index, camera in enumerate(rig.cameras):
        if filming.blind_camera and index == len(rig.cameras) - 1:
            continue
        seen_s = times_s - filming.delays_s[index] - source.normal(0, filming.blur_s or 1e-12, filming.poses)
        standing = np.repeat(camera.T_cam_lab[None], filming.poses, axis=0)
        if index == 1:
            knock = Rotation.from_rotvec(np.deg2rad(filming.bump_deg) * np.array([0.6, 0.8, 0.0])).as_matrix()
            standing[filming.poses // 2 :] = transform(knock, np.zeros(3)) @ standing[0]
        uv_px[index] = _project(camera, standing @ sweep.poses(seen_s), printed)
    uv_px += source.normal(0, filming.noise_px, uv_px.shape)
    views = BoardViews(
        camera_names=rig.names,
        image_sizes_px=tuple(camera.image_size_px for camera in rig.cameras),
        board=BOARD,
        times_s=times_s,
        uv_px=uv_px,
    )
    session = Session(views, rig, sweep.poses(times_s), np.array(filming.delays_s))
    return replace(session, optics=tuple(separate_optics(camera, source) for camera in rig.cameras))


def _project(
    camera: Camera, T_cam_board: Float[np.ndarray, "frame 4 4"], corners: Float[np.ndarray, "corner 3"]
) -> Float[np.ndarray, "frame corner 2"]:
    xyz = np.stack([apply(T, corners) for T in T_cam_board])
    facing = -np.einsum("fi,fi->f", T_cam_board[:, :3, 2], xyz.mean(axis=1)) / np.linalg.norm(xyz.mean(axis=1), axis=1)
    distorted, _ = distort(xyz[..., :2] / xyz[..., 2:], camera.distortion)
    uv = distorted @ camera.intrinsic_px[:2, :2].T + camera.intrinsic_px[:2, 2]
    inside = np.all((uv > 4) & (uv < np.array(camera.image_size_px) - 5), axis=-1) & (xyz[..., 2] > 0.3)
    inside &= (-facing > np.cos(np.deg2rad(70)))[:, None]  # steeper, and no detector reads the squares
    inside &= (inside.sum(axis=1) >= 6)[:, None]
    return np.where(inside[..., None], uv, np.nan)


def separate_optics(camera: Camera, source: np.random.Generator) -> Intrinsics:
    """Give a camera's optics as a recording of their own would have found them: off by :data:`PRIOR_SD`."""
    K = camera.intrinsic_px
    truth = np.array([K[0, 0], K[1, 1] / K[0, 0], K[0, 2], K[1, 2], *camera.distortion])
    sd = PRIOR_SD * np.array([truth[0], *np.ones(8)])
    return Intrinsics(
        camera_name=camera.name,
        image_size_px=camera.image_size_px,
        model="k1k2",
        parameters=truth + sd * source.normal(size=9),
        # The rest of PRIOR_SD is the floor that a recording's optics are given anyway (gonio.kernel.calibration.rig).
        covariance=np.diag(np.maximum(sd**2 - _floor(truth[0]) ** 2, 0.0)),
        held_out_px=0.4,
        rms_px=0.4,
        views=25,
        tilted_views=20,
        covered=coverage(np.full((1, 1, 2), np.nan), camera.image_size_px) | True,
        origin="recording",
        source="virtual lab",
    )


def _floor(focal_px: float) -> Float[np.ndarray, "9"]:
    centre = 3.0 * IMAGE_SIZE_PX[0] / 1280
    return np.array([0.003 * focal_px, 0.0, centre, centre, 0.03, 0.05, 0.0, 0.0, 0.0])


def volume_error_mm(cameras: tuple[Camera, ...], truth: Rig) -> float:
    """Give the rms error of 27 points in 3 × 1.6 × 3 m that the true cameras see and the found ones triangulate.

    After the best rigid alignment, without scale: the frame is a matter of its own.
    """
    grid = np.stack(np.meshgrid([-1.5, 0, 1.5], [0.1, 0.9, 1.7], [-1.5, 0, 1.5], indexing="ij"), -1).reshape(-1, 3)
    uv_px, projections = [], []
    for found, true in zip(cameras, truth.cameras, strict=True):
        xyz = apply(true.T_cam_lab, grid)
        distorted, _ = distort(xyz[:, :2] / xyz[:, 2:], true.distortion)
        pixels = distorted @ true.intrinsic_px[:2, :2].T + true.intrinsic_px[:2, 2]
        inside = np.all((pixels > 0) & (pixels < np.array(true.image_size_px) - 1), axis=1)
        uv_px.append(np.where(inside[:, None], undistort(found, pixels), np.nan))
        projections.append(found.intrinsic_px @ found.T_cam_lab[:3])
    focal_px = np.array([camera.intrinsic_px[0, 0] for camera in cameras])
    weight = np.ones((len(cameras), len(grid)))
    solved = triangulate(np.stack(projections), focal_px, np.stack(uv_px), weight, method="reprojection").xyz_lab_m
    seen = np.isfinite(solved[:, 0])
    grid, solved = grid[seen], solved[seen]
    here, there = grid - grid.mean(axis=0), solved - solved.mean(axis=0)
    turned = Rotation.align_vectors(here, there)[0].apply(there)
    return 1e3 * float(np.sqrt(((turned - here) ** 2).sum(axis=1).mean()))
