"""Draw articulated bodies of boxes as a camera would show them, each face papered with markers that can be found again.

The pixel side of the virtual laboratory's bodies: pictures to track, to mask and to carve. Deterministic.
"""

# OpenCV's stubs type pictures too narrowly.
# pyright: standard
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gonio.kernel.carving.raster import draw, project_vertices, weights_at
from gonio.kernel.geometry.transforms import apply
from gonio.records import Camera
from gonio.vision.board_finders import find_dictionary

DICTIONARY = "DICT_4X4_250"
TAG_M, GAP = 0.06, 0.35
"""A marker's side at most, and the light gap around it as a share of it."""

TEXEL_M = 0.001
DARK = 0.22
MAT_M, MAT_RGB, WALL_RGB = 1.1, (150, 148, 140), (112, 116, 124)
LIGHT = np.array([0.75, 0.6, 0.28])
FINENESS = 2
HUES = ((236, 160, 60), (90, 190, 232), (130, 210, 120), (226, 120, 170))


@dataclass(frozen=True)
class Box:
    """An upright box of a part, in the part's frame; ``tagged`` says whether its faces carry markers."""

    middle_m: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    tagged: bool = True


@dataclass(frozen=True)
class Face:
    """One face: its corner, its two edges (right and down as seen from outside), and what is printed on it, 1 = light."""

    corner_m: Float[np.ndarray, "3"]
    edges_m: Float[np.ndarray, "2 3"]
    print: Float[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class PaperedPart:
    """A part ready to be drawn; ``marks_m`` are its markers' corners, four for each of ``tags``."""

    faces: tuple[Face, ...]
    rgb: tuple[int, int, int]
    tags: Int[np.ndarray, " tag"]
    marks_m: Float[np.ndarray, "tag 4 3"]


@dataclass(frozen=True)
class Photo:
    """A picture, and which part each pixel shows (−1: none)."""

    rgb: UInt8[np.ndarray, "height width 3"]
    part: Int[np.ndarray, "height width"]

    def shown(self, part: int) -> Bool[np.ndarray, "height width"]:
        """Give the true mask of a part."""
        return self.part == part


def paper(boxes: tuple[Box, ...], first_tag: int, rgb: tuple[int, int, int]) -> PaperedPart:
    """Put markers on all faces of a part, numbered from ``first_tag``; a face that is too small stays plain."""
    faces, marks, tag = [], [], first_tag
    for box in boxes:
        for axis in range(3):
            for sign in (-1.0, 1.0):
                across, down = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
                edges = np.stack([down, across] if sign > 0 else [across, down]) * box.size_m
                corner = box.middle_m + sign * np.eye(3)[axis] * box.size_m / 2 - edges.sum(axis=0) / 2
                printed, at = _printed(np.linalg.norm(edges, axis=1), tag, box.tagged)
                faces.append(Face(corner, edges, printed))
                marks += list(corner + at @ (edges / np.linalg.norm(edges, axis=1, keepdims=True)))
                tag += len(at)
    return PaperedPart(tuple(faces), rgb, np.arange(first_tag, tag), np.array(marks).reshape(-1, 4, 3))


def _printed(
    size_m: Float[np.ndarray, "2"], tag: int, tagged: bool
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "tag 4 2"]]:
    """Print a face; gives the picture, and the markers' corners in metres along its edges."""
    width, height = (max(round(float(size) / TEXEL_M), 2) for size in size_m)
    printed = np.ones((height, width), dtype=np.float32)
    side = min(round(TAG_M / TEXEL_M), int(min(width, height) / (1 + 2 * GAP)))
    corners = []
    if tagged and side >= 24:
        pitch = side * (1 + GAP)
        columns, rows = (int((length - GAP * side) / pitch) for length in (width, height))
        for row in range(rows):
            for column in range(columns):
                left = round((width - columns * pitch + GAP * side) / 2 + column * pitch)
                top = round((height - rows * pitch + GAP * side) / 2 + row * pitch)
                marker = cv2.aruco.generateImageMarker(find_dictionary(DICTIONARY), tag + len(corners), side)
                printed[top : top + side, left : left + side] = np.where(marker > 0, 1.0, DARK)
                square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side + [left, top]
                corners.append(square * size_m / [width, height])
    return printed, np.array(corners).reshape(-1, 4, 2)


def photograph(
    camera: Camera,
    parts: tuple[PaperedPart, ...],
    Ts_world_part: tuple[Float[np.ndarray, "4 4"], ...],
    *,
    noise: float = 2.0,
    seed: int = 0,
) -> Photo:
    """Take a picture of all parts on their mat, each where its pose says; a camera without lens distortion.

    Args:
        camera: The camera.
        parts: The parts.
        Ts_world_part: Where each one is.
        noise: Standard deviation of each pixel's values.
        seed: Of the noise and the mat's stains.
    """
    rng = np.random.default_rng(seed)
    stains = cv2.resize(rng.normal(0, 0.05, (24, 24)).astype(np.float32), (550, 550), interpolation=cv2.INTER_CUBIC)
    half = MAT_M / 2
    mat = Face(np.array([-half, -0.002, -half]), np.array([[MAT_M, 0, 0], [0, 0, MAT_M]]), 0.85 + stains)
    placed = [(-1, np.eye(4), mat, MAT_RGB)]
    placed += [
        (k, T, face, p.rgb) for k, (p, T) in enumerate(zip(parts, Ts_world_part, strict=True)) for face in p.faces
    ]
    vertices = [
        apply(T, face.corner_m + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ face.edges_m) for _, T, face, _ in placed
    ]
    # Pixel (0, 0) of the fine picture is the first of FINENESS² in the coarse one's pixel (0, 0).
    finer = np.array([[FINENESS, 0, (FINENESS - 1) / 2], [0, FINENESS, (FINENESS - 1) / 2], [0, 0, 1.0]])
    uvz = project_vertices(finer @ camera.intrinsic_px @ camera.T_cam_lab[:3], np.concatenate(vertices))
    quads = 4 * np.arange(len(placed))[:, None]
    triangles = (quads + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    width, height = (FINENESS * size for size in camera.image_size_px)
    _, drawn = draw(uvz, triangles, (height, width))
    rgb = np.broadcast_to(np.array(WALL_RGB, dtype=np.float32), (height, width, 3)).copy()
    part = np.full((height, width), -1, dtype=np.int32)
    seen = np.flatnonzero(drawn >= 0)
    seen = seen[np.argsort(drawn.flat[seen] // 2, kind="stable")]
    ends = np.searchsorted(drawn.flat[seen] // 2, np.arange(len(placed) + 1))
    for (number, T, face, colour), first, last in zip(placed, ends[:-1], ends[1:], strict=True):
        rows, columns = np.divmod(seen[first:last], width)
        if len(rows):
            triangle = drawn[rows, columns]
            weights = weights_at(uvz[triangles[triangle]], columns.astype(float), rows.astype(float))
            second = triangle % 2 == 1
            along = np.where(second, weights[:, 1], weights[:, 1] + weights[:, 2])
            down = np.where(second, weights[:, 1] + weights[:, 2], weights[:, 2])
            rgb[rows, columns] = _lit(T, face) * _read(face.print, along, down)[:, None] * np.array(colour)
            part[rows, columns] = number
    soft = cv2.GaussianBlur(cv2.resize(rgb, camera.image_size_px, interpolation=cv2.INTER_AREA), (0, 0), 0.5)
    middle = part[FINENESS // 2 :: FINENESS, FINENESS // 2 :: FINENESS]
    return Photo(np.clip(soft + rng.normal(0, noise, soft.shape), 0, 255).astype(np.uint8), middle)


def _lit(T: Float[np.ndarray, "4 4"], face: Face) -> float:
    normal = -T[:3, :3] @ np.cross(*face.edges_m)
    return 0.62 + 0.38 * max(float(normal @ LIGHT / np.linalg.norm(normal) / np.linalg.norm(LIGHT)), 0.0)


def _read(
    printed: Float[np.ndarray, "rows columns"], along: Float[np.ndarray, " pixel"], down: Float[np.ndarray, " pixel"]
) -> Float[np.ndarray, " pixel"]:
    rows, columns = printed.shape
    # OpenCV reads at most 32767 places in one row.
    x, y = ((share * size - 0.5).astype(np.float32) for share, size in ((along, columns), (down, rows)))
    pad = -len(x) % 1024
    x, y = (np.pad(each, (0, pad)).reshape(-1, 1024) for each in (x, y))
    values = cv2.remap(printed.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.ravel()[: len(along)]


def find_marks(photo: Photo, tags: Int[np.ndarray, " tag"]) -> Float[np.ndarray, "tag 4 2"]:
    """Find markers' corners in the picture, NaN where one is not found."""
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    options.cornerRefinementWinSize = 4
    options.relativeCornerRefinmentWinSize = 0.4
    detector = cv2.aruco.ArucoDetector(find_dictionary(DICTIONARY), options)
    corners, found, _ = detector.detectMarkers(cv2.cvtColor(photo.rgb, cv2.COLOR_RGB2GRAY))
    marks = np.full((len(tags), 4, 2), np.nan)
    for quad, tag in zip(corners, [] if found is None else np.ravel(found), strict=True):
        if tags[0] <= tag <= tags[-1]:
            marks[tag - tags[0]] = quad[0]
    return marks
