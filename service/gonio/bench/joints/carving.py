"""Carving of a box: its volume against the exact visual hull, and the time for a part.

The box is seen by 4 or 9 cameras of 1280 × 720 all around it, or by 4 of a camera that walks and zooms. The exact hull is the
polyhedron that the cones over the outlines have in common; the silhouettes are the pixels that the outlines touch.
Time is CPU on one core for four pictures, surface and colours included.
"""

import time

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, HalfspaceIntersection

from gonio.bench import Bench
from gonio.kernel.carving.surface import carve_part
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.articulated import virtual_cameras
from gonio.kernel.virtual_lab.rig import make_rig
from gonio.records import Camera, Silhouette

MIDDLE_M, HALF_M = np.array([0.0, 0.35, 0.0]), np.array([0.15, 0.2, 0.1])
CORNERS_M = MIDDLE_M + HALF_M * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
REPEATS = 5


def measure_carving(bench: Bench) -> None:
    """Add the metrics of carving."""
    bench.explain(__doc__)
    rigs = (around(4), around(9), virtual_cameras(np.random.default_rng(1), 4))
    errors = [carve_part(silhouettes(rig), 128).volume_m3 / exact_hull_m3(rig) - 1 for rig in rigs]
    bench.add("hull_volume_error_pct", 100 * max(map(abs, errors)), "%", at_most=5.0)
    seen = silhouettes(rigs[0])
    for voxels in (128, 256):
        seconds: list[float] = []
        for _ in range(REPEATS):
            begun = time.process_time()
            carve_part(seen, voxels)
            seconds.append(time.process_time() - begun)
        bench.add(f"carve_ms_{voxels}", 1e3 * float(np.median(seconds)), "ms")


def around(pictures: int, distortion: float = 0.0) -> tuple[Camera, ...]:
    """Give cameras all around, some of them high: the hull of a box is then near the box itself."""
    rings = [
        make_rig(
            pictures, radius_m=2.0, height_m=0.3 + 0.8 * (i % 3), image_size_px=(1280, 720), focal_px=1000.0,
            distortion=(distortion, 0.0, 0.0, 0.0, 0.0), target_m=(0.0, 0.35, 0.0),
        )
        for i in range(pictures)
    ]  # fmt: skip
    return tuple(ring.cameras[i] for i, ring in enumerate(rings))


def silhouettes(cameras: tuple[Camera, ...]) -> tuple[Silhouette, ...]:
    """Give the box's silhouettes, of one colour."""
    shown = [_shown_box(camera) for camera in cameras]
    return tuple(
        Silhouette(camera=c, shown=m, hidden=np.zeros_like(m), rgb=np.full((*m.shape, 3), (200, 90, 30), np.uint8))
        for c, m in zip(cameras, shown, strict=True)
    )


def exact_hull_m3(cameras: tuple[Camera, ...]) -> float:
    """Give the volume of the polyhedron: half-spaces through a centre and an outline's edge. Cameras without distortion."""
    spaces: list[Float[np.ndarray, 4]] = []
    for camera in cameras:
        P = camera.intrinsic_px @ camera.T_cam_lab[:3]
        corners = _outline(camera)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            plane = np.cross([*a, 1.0], [*b, 1.0]) @ P
            spaces.append(-plane * np.sign(plane @ [*MIDDLE_M, 1.0]))
    return float(ConvexHull(HalfspaceIntersection(np.array(spaces), MIDDLE_M).intersections).volume)


def _outline(camera: Camera) -> Float[np.ndarray, "corner 2"]:
    return cv2.convexHull(project(camera, CORNERS_M).astype(np.float32))[:, 0].astype(float)


def _shown_box(camera: Camera) -> Bool[np.ndarray, "row column"]:
    """Give the pixels that the box covers; edges are short enough that a lens bends none of them by a tenth of a pixel."""
    width, height = camera.image_size_px
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(_outline(camera) * 256).astype(np.int32), 1, shift=8)
    return mask > 0
