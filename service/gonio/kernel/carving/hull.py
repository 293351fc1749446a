"""The visual hull: all space that no silhouette denies.

From coarse to fine. A box around the hull is found by linear programmes over polygons around the silhouettes, and
tightened by cells whose whole projection is background. Then blocks of voxels that are background in one picture, or shown
in all of them, are decided as one, and only the voxels of the others are looked at. The result is the same, voxel by
voxel, as asking each one alone [Laurentini 1994; Szeliski 1993 for the octree's rectangle test].
"""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numba import njit
from scipy.optimize import linprog

from gonio.errors import CaptureError
from gonio.kernel.carving.views import BACKGROUND, SHOWN, Stack
from gonio.records import Hull

BLOCK = 8
TANGENTS = 12  # pairs of them around a silhouette
COARSE = 32
LEAST_SEEN = 2
"""A voxel counts if no picture denies it and at least as many show the part there: behind other parts nothing is known."""

OUTSIDE, MIXED, INSIDE = 0, 1, 2


def carve(stack: Stack, voxels: int) -> Hull:
    """Carve a part; its longest side gets as many voxels.

    Raises:
        CaptureError: ``hull-unbounded`` or ``hull-empty``.
    """
    low, high = _tightened(stack, *_bounds(stack))
    step = float((high - low).max()) / voxels
    shape = np.maximum(np.ceil((high - low) / step - 1e-9), 1).astype(np.int64)
    corner = (low + high) / 2 - (shape - 1) * (step / 2)
    blocks = -(-shape // BLOCK)
    pitch, span = np.full(3, BLOCK * step), np.full(3, (BLOCK - 1) * step)
    states = _cells(stack.P, stack.sizes, stack.open_sums, stack.shown_sums, corner, pitch, span, blocks)
    occupied = _voxels(stack.P, stack.sizes, stack.codes, corner, step, shape, states)
    if not occupied.any():
        raise _empty()
    return Hull(occupied=occupied, corner_m=corner, step_m=step)


def _empty() -> CaptureError:
    return CaptureError(
        "The silhouettes have no space in common.",
        hint="Check that the masks are of this part and these pictures, and that its motion is right (noise_px, ambiguous).",
        code="hull-empty",
    )


def _bounds(stack: Stack) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Give the box around what the polygons around the silhouettes have in common.

    Where much is hidden they may leave a space without end. Then each two pictures in turn are taken at what they
    show alone: a voxel has to be shown by two.
    """
    views = range(len(stack.P))
    wide = [_planes(stack.P[k], stack.codes[k] != BACKGROUND) for k in views]
    boxes = [_box(np.concatenate(wide))]
    if boxes[0] is not None and not np.isfinite(boxes[0]).all():
        narrow = [_planes(stack.P[k], stack.codes[k] == SHOWN) for k in views]
        boxes = [
            _box(np.concatenate([narrow[k] if k in pair else wide[k] for k in views]))
            for pair in combinations(views, LEAST_SEEN)
        ]
    found = np.array([box for box in boxes if box is not None])
    if not len(found):
        raise _empty()
    if not np.isfinite(found).all():
        raise CaptureError(
            "The silhouettes leave a space without end: all pictures see the part from one side.",
            hint="Add a picture from another direction; zooming is not enough.",
            code="hull-unbounded",
        )
    return found[:, 0].min(axis=0), found[:, 1].max(axis=0)


def _planes(P: Float[np.ndarray, "3 4"], mask: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "plane 4"]:
    """Give half-spaces, negative inside, of all that lies before the camera in the polygon of tangents around a mask."""
    rows = np.flatnonzero(mask.any(axis=1))
    first, last = mask[rows].argmax(axis=1), mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)
    ends = np.concatenate([np.stack([first, rows], axis=1), np.stack([last, rows], axis=1)])
    angle = np.pi * np.arange(TANGENTS) / TANGENTS
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Half a pixel is the most by which a pixel's centre is off in a direction along u or v, and more between.
    reach = np.abs(across).sum(axis=1) / 2
    along = ends @ across.T
    sides = across @ P[:2]
    most, least = (along.max(axis=0) + reach)[:, None], (along.min(axis=0) - reach)[:, None]
    planes = np.concatenate([sides - most * P[2], least * P[2] - sides, -P[2:]])
    return planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)


def _box(planes: Float[np.ndarray, "plane 4"]) -> Float[np.ndarray, "2 3"] | None:
    """Give the box around what half-spaces have in common: None if nothing, infinite where it has no end."""
    box = np.zeros((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            found = linprog(sign * np.eye(3)[axis], A_ub=planes[:, :3], b_ub=-planes[:, 3], bounds=(None, None))
            if found.status == 2:
                return None
            box[side, axis] = -sign * np.inf if found.status != 0 or found.x is None else found.x[axis]
    return box


def _tightened(
    stack: Stack, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    for _ in range(4):
        cell = (high - low) / COARSE
        shape = np.full(3, COARSE)
        states = _cells(stack.P, stack.sizes, stack.open_sums, stack.shown_sums, low, cell, cell, shape)
        kept = [np.flatnonzero((states != OUTSIDE).any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
        if not len(kept[0]):
            raise _empty()
        first, last = (np.array([each[end] for each in kept]) for end in (0, -1))
        before = np.prod(high - low)
        low, high = low + first * cell, low + (last + 1) * cell
        if np.prod(high - low) > 0.5 * before:
            break
    return low, high


@njit(cache=True, nogil=True)
def _count(sums: np.ndarray, view: int, top: int, left: int, bottom: int, right: int) -> int:
    return sums[view, bottom, right] - sums[view, top, right] - sums[view, bottom, left] + sums[view, top, left]


@njit(cache=True, nogil=True)
def _cells(
    P: np.ndarray,
    sizes: np.ndarray,
    open_sums: np.ndarray,
    shown_sums: np.ndarray,
    low: np.ndarray,
    pitch: np.ndarray,
    span: np.ndarray,
    shape: np.ndarray,
) -> UInt8[np.ndarray, "x y z"]:
    """Tell of each cell ``low + index * pitch + [0, span]`` whether its projection is decided as a whole."""
    states = np.zeros((shape[0], shape[1], shape[2]), dtype=np.uint8)
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                states[x, y, z] = _cell(
                    P, sizes, open_sums, shown_sums,
                    low[0] + x * pitch[0], low[1] + y * pitch[1], low[2] + z * pitch[2], span,
                )  # fmt: skip
    return states


@njit(cache=True, nogil=True)
def _cell(
    P: np.ndarray,
    sizes: np.ndarray,
    open_sums: np.ndarray,
    shown_sums: np.ndarray,
    x0: float,
    y0: float,
    z0: float,
    span: np.ndarray,
) -> int:
    seen, whole = 0, True
    for view in range(P.shape[0]):
        M = P[view]
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        behind = 0
        for corner in range(8):
            x = x0 + span[0] * (corner & 1)
            y = y0 + span[1] * ((corner >> 1) & 1)
            z = z0 + span[2] * (corner >> 2)
            depth = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
            if depth <= 1e-9:
                behind += 1
                continue
            u = (M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]) / depth
            v = (M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]) / depth
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if behind == 8:
            return OUTSIDE
        if behind:
            whole = False
            seen += 1
            continue
        height, width = sizes[view, 0], sizes[view, 1]
        # The rectangle of all pixels that a point of the cell may fall into, half-open, before it is cut to the picture.
        a, b = np.floor(left + 0.5), np.floor(right + 0.5) + 1
        c, d = np.floor(top + 0.5), np.floor(bottom + 0.5) + 1
        if b <= 0 or d <= 0 or a >= width or c >= height:
            return OUTSIDE
        l, r = int(max(a, 0.0)), int(min(b, float(width)))  # noqa: E741 - left, right
        t, o = int(max(c, 0.0)), int(min(d, float(height)))
        if _count(open_sums, view, t, l, o, r) == 0:
            return OUTSIDE
        shown = _count(shown_sums, view, t, l, o, r)
        seen += 1 if shown > 0 else 0
        if shown < (d - c) * (b - a):
            whole = False
    if seen < LEAST_SEEN:
        return OUTSIDE
    return INSIDE if whole else MIXED


@njit(cache=True, nogil=True)
def _voxels(
    P: np.ndarray,
    sizes: np.ndarray,
    codes: np.ndarray,
    corner: np.ndarray,
    step: float,
    shape: np.ndarray,
    states: np.ndarray,
) -> Bool[np.ndarray, "x y z"]:
    occupied = np.zeros((shape[0], shape[1], shape[2]), dtype=np.bool_)
    for bx in range(states.shape[0]):
        for by in range(states.shape[1]):
            for bz in range(states.shape[2]):
                if states[bx, by, bz] == OUTSIDE:
                    continue
                decided = states[bx, by, bz] == INSIDE
                for x in range(bx * BLOCK, min((bx + 1) * BLOCK, shape[0])):
                    for y in range(by * BLOCK, min((by + 1) * BLOCK, shape[1])):
                        for z in range(bz * BLOCK, min((bz + 1) * BLOCK, shape[2])):
                            occupied[x, y, z] = decided or _voxel(
                                P, sizes, codes,
                                corner[0] + x * step, corner[1] + y * step, corner[2] + z * step,
                            )  # fmt: skip
    return occupied


@njit(cache=True, nogil=True)
def _voxel(P: np.ndarray, sizes: np.ndarray, codes: np.ndarray, x: float, y: float, z: float) -> bool:
    seen = 0
    for view in range(P.shape[0]):
        M = P[view]
        depth = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
        if depth <= 1e-9:
            return False
        u = np.floor((M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]) / depth + 0.5)
        v = np.floor((M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]) / depth + 0.5)
        if u < 0 or v < 0 or u >= sizes[view, 1] or v >= sizes[view, 0]:
            return False
        code = codes[view, int(v), int(u)]
        if code == 0:
            return False
        seen += 1 if code == SHOWN else 0
    return seen >= LEAST_SEEN
