"""Draw what the virtual laboratory's cameras would show: a calibration board, a walker.

Deterministic: the same arguments give the same picture, noise included.
"""

# OpenCV's stubs type pictures too narrowly.
# pyright: standard
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gonio.kernel.geometry.cameras import normalize, project
from gonio.kernel.virtual_lab.harmonics import coordinates_at
from gonio.kernel.virtual_lab.shape import Placed, capsules_of, place
from gonio.records import Camera, Walk

GREY, FLOOR_GREY, LINE_GREY = 96, 132, 104  # wall, floor, and the lines on it
SKIN = np.array([196.0, 150.0, 122.0])
CLOTHES = {"trunk": (70, 96, 140), "shoulders": (70, 96, 140), "pelvis": (52, 56, 66), "thigh": (52, 56, 66)}
SHADES = 7  # of a limb, from its dark edge to its light
_FLOOR_M = 3.5
_SHOES = np.array([235.0, 235.0, 230.0])


class Print(NamedTuple):
    """A board's front as a picture, margin included.

    ``m_per_px`` is the size of its pixels, ``origin_px`` where the board's origin lies in it, (0, 0) being the centre of
    the first pixel.
    """

    picture: UInt8[np.ndarray, "height width"]
    m_per_px: float
    origin_px: tuple[float, float]


def draw_board(
    camera: Camera,
    T_lab_board: Float[np.ndarray, "4 4"],
    board: Print,
    *,
    blur_px: float = 0.7,
    noise: float = 2.0,
    fineness: int = 3,
    seed: int = 0,
) -> UInt8[np.ndarray, "rows columns"]:
    """Draw a flat board as a camera would see it, with the lens' distortion, blur and noise.

    Each point of the picture is traced back through the lens to the board's plane.

    Args:
        camera: The camera.
        T_lab_board: The board's pose; Z into the paper as seen from the front.
        board: What is printed on it.
        blur_px: Standard deviation of a Gaussian blur.
        noise: Standard deviation of the sensor's noise, in grey levels.
        fineness: Points per pixel and axis: fewer make stairs of edges.
        seed: Of the noise.
    """
    width, height = camera.image_size_px
    picture = np.full((height, width), GREY, np.uint8)
    T_cam_board = camera.T_cam_lab @ T_lab_board
    window = _window(camera, T_lab_board, board)
    if window is not None and T_cam_board[:3, 2] @ T_cam_board[:3, 3] > 0:  # from behind there is nothing to see
        rows, columns = (
            (np.arange((part.stop - part.start) * fineness) + 0.5) / fineness - 0.5 + part.start for part in window
        )
        rays = normalize(camera, np.stack(np.meshgrid(columns, rows), axis=-1))
        rays = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
        # A point x X + y Y + t of the board's plane is on the ray: the inverse of (X, Y, t) maps rays to (x, y, 1).
        onto_plane = np.linalg.inv(T_cam_board[:3, [0, 1, 3]])
        x, y, scale = np.moveaxis(rays @ onto_plane.T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = [c / scale / board.m_per_px + o for c, o in zip((x, y), board.origin_px, strict=True)]
        u, v = (np.where((scale > 0) & np.isfinite(c), c, -10.0).astype(np.float32) for c in at)
        fine = cv2.remap(board.picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=GREY)
        size = (window[1].stop - window[1].start, window[0].stop - window[0].start)
        picture[window] = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    return _develop(picture, blur_px, noise, seed)


def _window(camera: Camera, T_lab_board: np.ndarray, board: Print) -> tuple[slice, slice] | None:
    """Give the rows and columns that a board can fill; None if it is out of sight, or partly behind the camera."""
    sides = [
        np.linspace(-1, size, 9) - origin
        for size, origin in zip(board.picture.shape[::-1], board.origin_px, strict=True)
    ]
    x, y = (board.m_per_px * grid.ravel() for grid in np.meshgrid(*sides))
    corners = project(camera, np.stack([x, y, np.zeros_like(x)], axis=-1) @ T_lab_board[:3, :3].T + T_lab_board[:3, 3])
    if np.isnan(corners).any():
        return None
    size = np.array(camera.image_size_px)
    first = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, size)
    last = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, size)
    return None if np.any(first >= last) else (slice(first[1], last[1]), slice(first[0], last[0]))


def print_checkerboard(corners_across: int, corners_down: int, square_m: float, square_px: int = 40) -> Print:
    """Make the print of a checkerboard with a white margin of one square, its origin in the first inner corner."""
    rows, columns = (np.arange((count + 3) * square_px) // square_px for count in (corners_down, corners_across))
    black = (rows[:, None] + columns) % 2 == 0
    inside = (rows[:, None] > 0) & (rows[:, None] < corners_down + 2) & (columns > 0) & (columns < corners_across + 2)
    first = 2 * square_px - 0.5
    return Print(np.where(black & inside, 0, 255).astype(np.uint8), square_m / square_px, (first, first))


def draw_walk(
    camera: Camera, walk: Walk, times_s: Float[np.ndarray, " frame"], *, noise: float = 2.0, seed: int = 0
) -> Iterator[UInt8[np.ndarray, "rows columns 3"]]:
    """Draw a walk frame by frame, RGB: a person of shaded capsules on a floor with a line every half metre."""
    capsules = capsules_of(walk.body)
    placed = place(walk.body, capsules, coordinates_at(walk, times_s).q)
    room = _draw_room(camera)
    for frame in range(len(times_s)):
        picture = room.copy()
        _draw_body(picture, camera, capsules.names, placed, frame)
        yield _develop(picture, 0.6, noise, seed + frame)


def write_video(path: Path, pictures: Iterator[UInt8[np.ndarray, "rows columns 3"]], rate_hz: float) -> None:
    """Write RGB pictures as H.264 in an MP4 file, with nothing lost that a keypoint network would miss."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate_hz).limit_denominator(1000))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18", "preset": "veryfast"}
        for number, picture in enumerate(pictures):
            if number == 0:
                stream.height, stream.width = picture.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _develop(picture: np.ndarray, blur_px: float, noise: float, seed: int) -> np.ndarray:
    blurred = cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px > 0 else picture
    grain = noise * np.random.default_rng(seed).standard_normal(picture.shape, dtype=np.float32)
    return np.clip(blurred + grain, 0, 255).astype(np.uint8)


def _draw_room(camera: Camera) -> np.ndarray:
    width, height = camera.image_size_px
    room = np.full((height, width, 3), GREY, np.uint8)
    edge = np.linspace(-_FLOOR_M, _FLOOR_M, 60)
    far = np.full_like(edge, _FLOOR_M)
    rim = np.concatenate([np.stack(side, axis=-1) for side in ((edge, -far), (far, edge), (-edge, far), (-far, -edge))])
    _fill(room, camera, rim, FLOOR_GREY)
    for at in np.arange(-_FLOOR_M, _FLOOR_M + 0.1, 0.5):
        for line in (np.stack([np.full_like(edge, at), edge], -1), np.stack([edge, np.full_like(edge, at)], -1)):
            points = _on_floor(camera, line)
            seen = points[np.isfinite(points).all(axis=-1)]
            cv2.polylines(room, [np.round(16 * seen).astype(np.int32)], False, (LINE_GREY,) * 3, 1, cv2.LINE_AA, 4)
    return room


def _fill(picture: np.ndarray, camera: Camera, xz_m: np.ndarray, grey: int) -> None:
    points = _on_floor(camera, xz_m)
    seen = points[np.isfinite(points).all(axis=-1)]
    if len(seen) > 2:
        cv2.fillPoly(picture, [np.round(16 * seen).astype(np.int32)], (grey,) * 3, cv2.LINE_AA, 4)


def _on_floor(camera: Camera, xz_m: np.ndarray) -> np.ndarray:
    points = project(camera, np.stack([xz_m[:, 0], np.zeros(len(xz_m)), xz_m[:, 1]], axis=-1))
    far = np.abs(points).max(axis=-1) > 10 * max(camera.image_size_px)  # beside the camera, where projections run away
    return np.where(far[:, None], np.nan, points)


def _draw_body(picture: np.ndarray, camera: Camera, names: Sequence[str], placed: Placed, frame: int) -> None:
    """Draw the capsules from far to near, each from its dark rim to its light middle."""
    middle = (placed.start_m[frame] + placed.end_m[frame]) / 2
    depth_m = (middle - camera.centre_lab_m) @ camera.T_lab_cam[:3, 2]
    for number in map(int, np.argsort(-depth_m)):
        if depth_m[number] < 0.3:
            continue  # within arm's reach of the lens
        part = names[number].removesuffix(" r").removesuffix(" l")
        colour = _SHOES if part == "foot" else np.array(CLOTHES.get(part, SKIN), dtype=float)
        along = np.linspace(0.0, 1.0, 9)[:, None]
        spine = (1 - along) * placed.start_m[frame, number] + along * placed.end_m[frame, number]
        for shade in range(SHADES):
            radius_m = float(placed.radius_m[number]) * (1.0 - shade / SHADES)
            light = 0.55 + 0.5 * np.sqrt(1.0 - (1.0 - shade / SHADES) ** 2)
            hull = cv2.convexHull(_outline(camera, spine, radius_m))
            cv2.fillConvexPoly(picture, hull, tuple(np.minimum(light * colour, 255.0)), cv2.LINE_AA, 4)


def _outline(camera: Camera, spine_m: np.ndarray, radius_m: float) -> np.ndarray:
    """Give points around balls along a spine, in sixteenths of a pixel, for OpenCV's fine drawing."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = radius_m * (
        np.outer(np.cos(angle), camera.T_lab_cam[:3, 0]) + np.outer(np.sin(angle), camera.T_lab_cam[:3, 1])
    )
    points = project(camera, spine_m[:, None] + ring)
    return np.round(16 * points.reshape(-1, 2)).astype(np.int32)
