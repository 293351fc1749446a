"""Silhouettes as a carver wants them: ideal pinhole pictures, cut to what matters, with tables that count in rectangles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32, UInt8
from scipy.ndimage import map_coordinates

from gonio.errors import InputError
from gonio.kernel.geometry.cameras import distort, undistort
from gonio.records import Camera, Silhouette

BACKGROUND, SHOWN, HIDDEN = 0, 1, 2

MARGIN_PX = 2
"""Kept around what a picture shows, so that a surface that is smoothed by a voxel stays inside."""

WIDEST = 2.0
"""A picture is straightened within this many times its own width and height: a lens that folds over has no end."""


@dataclass(frozen=True)
class Pinhole:
    """One picture without lens distortion: its projection ``P`` from the part's frame, and what each pixel shows."""

    P: Float[np.ndarray, "3 4"]
    centre_m: Float[np.ndarray, "3"]
    codes: UInt8[np.ndarray, "height width"]
    rgb: UInt8[np.ndarray, "height width 3"] | None


@dataclass(frozen=True)
class Stack:
    """All views in arrays of one size, and tables of sums: how many pixels left of and above are no background, or shown."""

    P: Float[np.ndarray, "view 3 4"]
    sizes: Int32[np.ndarray, "view 2"]
    codes: UInt8[np.ndarray, "view height width"]
    open_sums: Int32[np.ndarray, "view row column"]
    shown_sums: Int32[np.ndarray, "view row column"]


def view_of(silhouette: Silhouette) -> Pinhole:
    """Straighten a picture and cut it to the pixels that are no background.

    Raises:
        InputError: ``mask-wrong-size`` or ``mask-empty``.
    """
    camera = silhouette.camera
    width, height = camera.image_size_px
    if silhouette.shown.shape != (height, width):
        rows, columns = silhouette.shown.shape
        raise InputError(
            f"The mask of picture {camera.name} has {columns} × {rows} pixels, the picture {width} × {height}.",
            hint="Draw the mask over the photograph itself, without cutting or scaling it.",
            code="mask-wrong-size",
        )
    if not silhouette.shown.any():
        raise InputError(
            f"The mask of picture {camera.name} is empty.",
            hint="Leave out the masks of pictures that don't show the part.",
            code="mask-empty",
        )
    codes = np.where(silhouette.hidden, np.uint8(HIDDEN), np.uint8(BACKGROUND))
    codes[silhouette.shown] = SHOWN
    straight = camera.intrinsic_px, codes, silhouette.rgb
    if camera.distortion.any():
        straight = _straightened(camera, codes, silhouette.rgb)
    K, codes, rgb = straight
    rows, columns = (np.flatnonzero(codes.any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - MARGIN_PX, 0), max(columns[0] - MARGIN_PX, 0)
    window = np.s_[top : rows[-1] + MARGIN_PX + 1, left : columns[-1] + MARGIN_PX + 1]
    shift = np.array([[1.0, 0, -left], [0, 1.0, -top], [0, 0, 1.0]])
    return Pinhole(
        shift @ K @ camera.T_cam_lab[:3], camera.centre_lab_m, codes[window], None if rgb is None else rgb[window]
    )


def _straightened(
    camera: Camera, codes: UInt8[np.ndarray, "height width"], rgb: UInt8[np.ndarray, "height width 3"] | None
) -> tuple[Float[np.ndarray, "3 3"], UInt8[np.ndarray, "rows columns"], UInt8[np.ndarray, "rows columns 3"] | None]:
    height, width = codes.shape
    across, down = np.arange(-0.5, width), np.arange(-0.5, height)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(across, y), axis=-1) for y in (-0.5, height - 0.5)]
        + [np.stack(np.broadcast_arrays(x, down), axis=-1) for x in (-0.5, width - 0.5)]
    )
    straight = undistort(camera, border)
    size = np.array([width, height], dtype=float)
    room = (WIDEST - 1) / 2 * size
    low = np.floor(np.maximum(np.nanmin(straight, axis=0), -room)).astype(int)
    high = np.ceil(np.minimum(np.nanmax(straight, axis=0), size + room)).astype(int)
    K = camera.intrinsic_px
    u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    back = np.linalg.inv(K)[:2]
    xy, _ = distort(u[..., None] * back[:, 0] + v[..., None] * back[:, 1] + back[:, 2], camera.distortion)
    source = (xy @ K[:2, :2].T + K[:2, 2])[..., ::-1]
    at = np.moveaxis(source, -1, 0)
    flat = map_coordinates(codes, at, order=0, cval=BACKGROUND)
    colours = rgb if rgb is None else np.stack([map_coordinates(rgb[..., c], at, order=1) for c in range(3)], axis=-1)
    shift = np.array([[1.0, 0, -low[0]], [0, 1.0, -low[1]], [0, 0, 1.0]])
    return shift @ K, flat, colours


def stack_of(views: tuple[Pinhole, ...]) -> Stack:
    """Put views of different sizes into one array each; what is added is background."""
    sizes = np.array([view.codes.shape for view in views], dtype=np.int32)
    height, width = sizes.max(axis=0)
    codes = np.zeros((len(views), height, width), dtype=np.uint8)
    for code, view in zip(codes, views, strict=True):
        code[: view.codes.shape[0], : view.codes.shape[1]] = view.codes
    return Stack(np.stack([view.P for view in views]), sizes, codes, _sums(codes != BACKGROUND), _sums(codes == SHOWN))


def _sums(where: np.ndarray) -> Int32[np.ndarray, "view row column"]:
    sums = np.zeros((where.shape[0], where.shape[1] + 1, where.shape[2] + 1), dtype=np.int32)
    np.cumsum(where, axis=1, dtype=np.int32, out=sums[:, 1:, 1:])
    np.cumsum(sums[:, 1:, 1:], axis=2, out=sums[:, 1:, 1:])
    return sums
