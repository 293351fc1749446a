"""From voxels to a coloured surface, and back into the pictures."""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numba import njit
from skimage.measure import marching_cubes

from gonio.kernel.carving.hull import carve
from gonio.kernel.carving.raster import draw, project_vertices
from gonio.kernel.carving.views import HIDDEN, SHOWN, Pinhole, stack_of, view_of
from gonio.kernel.parallel import one_blas_thread
from gonio.records import CarvedPart, Hull, Mesh, Silhouette

VOXELS = 128
UNSEEN = np.uint8(128)
"""The grey of a surface that no picture sees: a colour would be invented."""

SEEN_VOXELS = 2.0
"""A vertex is seen if nothing lies farther before it than so many voxels: the surface itself is that rough."""

LEAST_FACING = 0.1
"""The cosine below which a surface is seen too much from the side to have its colour there."""


def carve_part(silhouettes: tuple[Silhouette, ...], voxels: int = VOXELS) -> CarvedPart:
    """Carve a part from its silhouettes, colour it, and measure how well it covers them again.

    Raises:
        InputError: A silhouette is unusable (see :func:`view_of`).
        CaptureError: ``hull-unbounded`` or ``hull-empty``.
    """
    with one_blas_thread():
        views = tuple(view_of(silhouette) for silhouette in silhouettes)
        hull = carve(stack_of(views), voxels)
        mesh, overlap = _painted(surface_of(hull), views, hull.step_m)
    return CarvedPart(mesh=mesh, volume_m3=hull.volume_m3, step_m=hull.step_m, overlap=overlap)


def surface_of(hull: Hull) -> Mesh:
    """Find the surface by marching cubes [Lorensen 1987; Lewiner 2003].

    The voxels are smoothed by (1 2 1)/4 along each axis first: that removes the stairs and moves no plane.
    """
    inside = np.pad(hull.occupied, 2).view(np.uint8)
    for axis in range(3):
        rolled = np.moveaxis(inside, axis, 0)
        inside = np.zeros_like(inside)
        target = np.moveaxis(inside, axis, 0)
        target[1:-1] = rolled[:-2] + 2 * rolled[1:-1] + rolled[2:]
    xyz, faces, normals, _ = marching_cubes(inside.astype(np.float32), 31.9, gradient_direction="descent")
    corner = hull.corner_m - 2 * hull.step_m
    return Mesh(
        xyz_m=xyz.astype(np.float64) * hull.step_m + corner, normals=normals.astype(np.float64), faces=faces[:, ::-1],
        rgb=np.full(xyz.shape, UNSEEN), coloured=np.zeros(len(xyz), dtype=bool),
    )  # fmt: skip


def _painted(mesh: Mesh, views: tuple[Pinhole, ...], step_m: float) -> tuple[Mesh, Float[np.ndarray, " view"]]:
    """Colour the vertices that a picture sees, and give the overlap of the drawn mesh with each silhouette.

    The colour is the mean over the pictures that see a vertex, weighted by how squarely they do.
    """
    sums, weights = np.zeros((len(mesh.xyz_m), 3)), np.zeros(len(mesh.xyz_m))
    overlap = []
    for view in views:
        uvz = project_vertices(view.P, mesh.xyz_m)
        depth, _ = draw(uvz, mesh.faces, view.codes.shape)
        overlap.append(overlap_of(np.isfinite(depth), view.codes))
        if view.rgb is not None:
            _add_colours(
                uvz, mesh.xyz_m, mesh.normals, view.centre_m, depth, view.codes, view.rgb, SEEN_VOXELS * step_m,
                sums, weights,
            )  # fmt: skip
    coloured = weights > 0
    rgb = np.full(sums.shape, UNSEEN)
    rgb[coloured] = np.clip(np.rint(sums[coloured] / weights[coloured, None]), 0, 255)
    painted = Mesh(xyz_m=mesh.xyz_m, normals=mesh.normals, faces=mesh.faces, rgb=rgb, coloured=coloured)
    return painted, np.array(overlap)


def overlap_of(drawn: Bool[np.ndarray, "height width"], codes: UInt8[np.ndarray, "height width"]) -> float:
    """Give the share that a drawn part and its silhouette have in common of what either covers, hidden pixels left out."""
    shown, known = codes == SHOWN, codes != HIDDEN
    return float(np.count_nonzero(drawn & shown) / max(np.count_nonzero((drawn | shown) & known), 1))


@njit(cache=True, nogil=True)
def _add_colours(  # noqa: PLR0913 - compiled code takes arrays, not objects
    uvz: np.ndarray,
    xyz: np.ndarray,
    normals: np.ndarray,
    centre: np.ndarray,
    depth: np.ndarray,
    codes: np.ndarray,
    rgb: np.ndarray,
    tolerance_m: float,
    sums: np.ndarray,
    weights: np.ndarray,
) -> None:
    height, width = codes.shape
    for vertex in range(len(xyz)):
        u, v, z = uvz[vertex, 0], uvz[vertex, 1], uvz[vertex, 2]
        if z <= 0 or not (0 <= u < width - 1 and 0 <= v < height - 1):
            continue
        if codes[int(v + 0.5), int(u + 0.5)] != SHOWN:
            continue
        if z > depth[int(v + 0.5), int(u + 0.5)] + tolerance_m:
            continue
        out = centre - xyz[vertex]
        facing = (out * normals[vertex]).sum() / np.sqrt((out * out).sum())
        if facing < LEAST_FACING:
            continue
        left, top = int(u), int(v)
        a, b = u - left, v - top
        for c in range(3):
            above = (1 - a) * rgb[top, left, c] + a * rgb[top, left + 1, c]
            below = (1 - a) * rgb[top + 1, left, c] + a * rgb[top + 1, left + 1, c]
            sums[vertex, c] += facing * ((1 - b) * above + b * below)
        weights[vertex] += facing
