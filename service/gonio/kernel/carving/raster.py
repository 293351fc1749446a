"""Draw triangles into a picture: which one each pixel's centre sees, and how far it is."""

import numpy as np
from jaxtyping import Float, Int, Int32
from numba import njit


def project_vertices(
    P: Float[np.ndarray, "3 4"], xyz_m: Float[np.ndarray, "vertex 3"]
) -> Float[np.ndarray, "vertex 3"]:
    """Give each vertex's pixel and its depth: ``(u, v, z)``; pixels of vertices at depth 0 are not finite."""
    image = xyz_m @ P[:, :3].T + P[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        image[:, :2] /= image[:, 2:]
    return image


def draw(
    uvz: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "height width"], Int32[np.ndarray, "height width"]]:
    """Draw triangles.

    Args:
        uvz: Vertices as :func:`project_vertices` gives them.
        faces: Triangles of them, either way round. Those that reach behind the camera are left out.
        size: Height and width of the picture.

    Returns:
        Each pixel's depth, infinite where nothing is, and the number of the triangle there, −1 for none. A pixel whose
        centre lies on an edge belongs to both triangles, so that a closed surface has no gaps.
    """
    depth = np.full(size, np.inf)
    drawn = np.full(size, -1, dtype=np.int32)
    _draw(uvz, faces, depth, drawn)
    return depth, drawn


def weights_at(
    uvz: Float[np.ndarray, "pixel 3 3"], u: Float[np.ndarray, " pixel"], v: Float[np.ndarray, " pixel"]
) -> Float[np.ndarray, "pixel 3"]:
    """Give the perspective-correct weights of a triangle's corners at a pixel inside it."""
    (a, b, c) = (uvz[:, k] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    second = ((u - a[:, 0]) * (c[:, 1] - a[:, 1]) - (v - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    third = ((b[:, 0] - a[:, 0]) * (v - a[:, 1]) - (b[:, 1] - a[:, 1]) * (u - a[:, 0])) / area
    weights = np.stack([1 - second - third, second, third], axis=1) / uvz[:, :, 2]
    return weights / weights.sum(axis=1, keepdims=True)


@njit(cache=True, nogil=True)
def _draw(uvz: np.ndarray, faces: np.ndarray, depth: np.ndarray, drawn: np.ndarray) -> None:
    height, width = depth.shape
    for face in range(len(faces)):
        a, b, c = uvz[faces[face, 0]], uvz[faces[face, 1]], uvz[faces[face, 2]]
        if a[2] <= 1e-9 or b[2] <= 1e-9 or c[2] <= 1e-9:
            continue
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        left = max(int(np.ceil(min(a[0], b[0], c[0]))), 0)
        right = min(int(np.floor(max(a[0], b[0], c[0]))), width - 1)
        top = max(int(np.ceil(min(a[1], b[1], c[1]))), 0)
        bottom = min(int(np.floor(max(a[1], b[1], c[1]))), height - 1)
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                second = ((u - a[0]) * (c[1] - a[1]) - (v - a[1]) * (c[0] - a[0])) / area
                third = ((b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])) / area
                first = 1 - second - third
                if first < -1e-9 or second < -1e-9 or third < -1e-9:
                    continue
                z = 1 / (first / a[2] + second / b[2] + third / c[2])
                if z < depth[v, u]:
                    depth[v, u] = z
                    drawn[v, u] = face
