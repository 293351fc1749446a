"""Made-up calibration recordings whose truth is known, good ones and spoiled ones.

The rig is that of the paper which gonio follows: four cameras of 720 × 540 pixels on a ring of 3.5 m radius, 2 m high, that
look at its middle. A board is swept through the volume by hand: it turns, tilts and never stops.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.calibration.intrinsics import coverage
from gonio.kernel.calibration.planar_pose import MIN_CORNERS
from gonio.kernel.geometry.cameras import project, undistort
from gonio.kernel.geometry.transforms import align, apply, transform
from gonio.kernel.triangulation.points import triangulate
from gonio.kernel.virtual_lab import make_rig
from gonio.records import Board, BoardViews, Camera, Intrinsics, Rig
from gonio.vision.board_drawing import render_board
from gonio.vision.render import Print, draw_board, write_video

IMAGE_SIZE_PX = (720, 540)
BOARD = Board(name="virtual 7 × 5", kind="charuco", corners_across=7, corners_down=5, square_m=0.1, marker_m=0.075,
              dictionary="DICT_5X5_100")  # fmt: skip
PRIOR_SD = np.array([0.005, 0.0, 3.0, 3.0, 0.04, 0.07, 0.0, 0.0, 0.0])
"""How far a separate calibration of the lenses is off: focal length (a share), centre (px), k1, k2."""

VOLUME_LAB_M = np.stack(np.meshgrid([-1.5, 0, 1.5], [0.1, 0.9, 1.7], [-1.5, 0, 1.5], indexing="ij"), axis=-1).reshape(
    -1, 3
)
"""27 points in the volume that subjects walk through."""

PX_PER_SQUARE = 80
EDGE_PX = 4
STEEPEST_RAD = np.deg2rad(70.0)
"""Steeper, and no detector reads the squares."""


@dataclass(frozen=True)
class Filming:
    """How a session is filmed, and what goes wrong in it; the defaults are a good session of the paper's rig."""

    cameras: int = 4
    radius_m: float = 3.5
    image_size_px: tuple[int, int] = IMAGE_SIZE_PX
    focal_px: float = 600.0
    board: Board = BOARD
    rate_hz: float = 5.0
    poses: int = 120
    still: bool = False
    """The board is held still at as many places, in no order; else it moves all the time."""
    noise_px: float = 0.3
    delay_s: float = 0.0
    """The last camera runs late by this."""
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
    """A filmed session and its truth: ``rig`` in the lab, the optics, and how the board stood before each camera."""

    filming: Filming
    views: BoardViews
    rig: Rig
    optics: tuple[Intrinsics, ...]
    Ts_cam_board: Float[np.ndarray, "camera frame 4 4"]


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

    def __init__(self, source: np.random.Generator, filming: Filming) -> None:
        self._filming = filming
        self._middle = filming.board.corners_board_m.mean(axis=0)
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
    ring = make_rig(
        filming.cameras if filming.cameras > 3 else 6,
        radius_m=filming.radius_m,
        height_m=2.0,
        image_size_px=filming.image_size_px,
        focal_px=filming.focal_px,
    )
    # Two or three cameras are neighbours on a ring of six: opposite ones never see the same side of a board.
    rig = scatter_lenses(replace(ring, cameras=ring.cameras[: filming.cameras]), source)
    board, sweep = filming.board, Sweep(source, filming)
    times_s = np.arange(filming.poses) * (10.0 if filming.still else 1 / filming.rate_hz)
    stood = [_before(camera, index, times_s, sweep, filming, source) for index, camera in enumerate(rig.cameras)]
    if filming.blind_camera:
        stood[-1][:, 2, 3] = -5.0  # behind it
    Ts_cam_board = np.stack(stood)
    printed = board.corners_board_m * np.array([1 + filming.stretch, 1.0, 1.0])
    uv_px = np.stack([_project(camera, Ts, printed) for camera, Ts in zip(rig.cameras, Ts_cam_board, strict=True)])
    uv_px += source.normal(0, filming.noise_px, uv_px.shape)
    views = BoardViews(
        camera_names=rig.names,
        image_sizes_px=tuple(camera.image_size_px for camera in rig.cameras),
        board=board,
        times_s=times_s,
        uv_px=uv_px,
    )
    optics = tuple(separate_optics(camera, source) for camera in rig.cameras)
    return Session(filming, views, rig, optics, Ts_cam_board)


def _before(
    camera: Camera, index: int, times_s: np.ndarray, sweep: Sweep, filming: Filming, source: np.random.Generator
) -> Float[np.ndarray, "frame 4 4"]:
    """Give the board's pose before a camera at the instants of its own pictures."""
    late_s = filming.delay_s if index == filming.cameras - 1 else 0.0
    seen_s = times_s - late_s - source.normal(0, filming.blur_s or 1e-12, len(times_s))
    standing = np.repeat(camera.T_cam_lab[None], len(times_s), axis=0)
    if index == 1:
        knock = Rotation.from_rotvec(np.deg2rad(filming.bump_deg) * np.array([0.6, 0.8, 0.0])).as_matrix()
        standing[len(times_s) // 2 :] = transform(knock, np.zeros(3)) @ standing[0]
    return standing @ sweep.poses(seen_s)


def _project(
    camera: Camera, T_cam_board: Float[np.ndarray, "frame 4 4"], corners_m: Float[np.ndarray, "corner 3"]
) -> Float[np.ndarray, "frame corner 2"]:
    xyz = np.stack([apply(T, corners_m) for T in T_cam_board])
    middle = xyz.mean(axis=1)
    facing = np.einsum("fi,fi->f", T_cam_board[:, :3, 2], middle) / np.linalg.norm(middle, axis=1)
    uv = project(replace(camera, T_lab_cam=np.eye(4)), xyz)
    inside = np.all((uv > EDGE_PX) & (uv < np.array(camera.image_size_px) - 1 - EDGE_PX), axis=-1) & (xyz[..., 2] > 0.3)
    inside &= (facing > np.cos(STEEPEST_RAD))[:, None]
    inside &= (inside.sum(axis=1) >= MIN_CORNERS)[:, None]
    return np.where(inside[..., None], uv, np.nan)


def face_on(camera: Camera, board: Board, count: int, seed: int = 0) -> Float[np.ndarray, "frame corner 2"]:
    """Film a board close to one camera, all over its picture, and always parallel to it within 2°: a bad lens recording."""
    source = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.deg2rad(1.0) * source.normal(size=(count, 3))).as_matrix()
    distance_m = source.uniform(1.2, 2.0, count)
    across, down = (distance_m * source.uniform(-reach, reach, count) for reach in (0.4, 0.3))
    T[:, :3, 3] = np.stack([across, down, distance_m], axis=-1) - T[:, :3, :3] @ board.corners_board_m.mean(axis=0)
    uv_px = _project(camera, T, board.corners_board_m)
    return uv_px + source.normal(0, 0.3, uv_px.shape)


def write_films(session: Session, folder: Path, *, blur_px: float = 0.7, seed: int = 0) -> list[Path]:
    """Render what each camera shows, stretched print and all, as a video in ``folder``; named after its camera."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = render_board(session.filming.board, PX_PER_SQUARE)
    wide = round(picture.shape[1] * (1 + session.filming.stretch))
    first = 1.5 * PX_PER_SQUARE - 0.5
    printed = Print(
        np.ascontiguousarray(picture[:, np.arange(wide) * picture.shape[1] // wide]),
        session.filming.board.square_m / PX_PER_SQUARE,
        ((first + 0.5) * wide / picture.shape[1] - 0.5, first),
    )
    paths: list[Path] = []
    for camera, Ts in zip(session.rig.cameras, session.Ts_cam_board, strict=True):
        standing = replace(camera, T_lab_cam=np.eye(4))
        pictures = (draw_board(standing, T, printed, blur_px=blur_px, seed=seed + n) for n, T in enumerate(Ts))
        paths.append(folder / f"{camera.name}.mp4")
        write_video(paths[-1], (np.repeat(grey[..., None], 3, axis=2) for grey in pictures), session.filming.rate_hz)
    return paths


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
    grid = VOLUME_LAB_M
    uv_px, projections = [], []
    for found, true in zip(cameras, truth.cameras, strict=True):
        pixels = project(true, grid)
        inside = np.all((pixels > 0) & (pixels < np.array(true.image_size_px) - 1), axis=1)
        uv_px.append(np.where(inside[:, None], undistort(found, pixels), np.nan))
        projections.append(found.intrinsic_px @ found.T_cam_lab[:3])
    focal_px = np.array([camera.intrinsic_px[0, 0] for camera in cameras])
    weight = np.ones((len(cameras), len(grid)))
    solved = triangulate(np.stack(projections), focal_px, np.stack(uv_px), weight, method="reprojection").xyz_lab_m
    seen = np.isfinite(solved[:, 0])
    grid, solved = grid[seen], solved[seen]
    turned = apply(align(solved, grid), solved)
    return 1e3 * float(np.sqrt(((turned - grid) ** 2).sum(axis=1).mean()))
