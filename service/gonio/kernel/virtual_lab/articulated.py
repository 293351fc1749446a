"""Virtual articulated bodies before one moving, zooming camera: truth for the joint solver.

The five bodies are those of the paper: a mannequin that walks and turns on the floor with a shoulder on it, a head on its
neck, a lid on its hinge, an arm of shoulder and elbow, and an excavator's cab and boom. Shapes are boxes of random points.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import inverse, transform
from gonio.records import Background, Camera, CameraHeight, Floor, JointKind, KnownLength, Lens, Part


@dataclass(frozen=True)
class Shape:
    """One part to be: its box, its number of points, its joint's place, and its axis if it has one."""

    name: str
    parent: str | None
    kind: JointKind
    points: int
    middle_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    joint_m: tuple[float, float, float]
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)


BODIES: dict[str, tuple[Shape, ...]] = {
    "mannequin": (
        Shape("base", None, "free", 26, (0, 0.25, 0), (0.25, 0.5, 0.25), (0, 0, 0)),
        Shape("shoulder", "base", "spherical", 20, (0, 0.4, 0.3), (0.12, 0.12, 0.35), (0, 0.45, 0.13)),
    ),
    "head": (Shape("head", None, "spherical", 14, (0, 0.45, 0), (0.2, 0.28, 0.2), (0, 0.3, 0)),),
    "lid": (Shape("lid", None, "hinge", 12, (0, 0.3, 0.15), (0.4, 0.12, 0.3), (0, 0.25, 0), (1, 0, 0)),),
    "arm": (
        Shape("upper arm", None, "spherical", 12, (0, 0.5, 0.2), (0.12, 0.12, 0.35), (0, 0.5, 0)),
        Shape("forearm", "upper arm", "spherical", 10, (0, 0.5, 0.55), (0.1, 0.1, 0.3), (0, 0.5, 0.38)),
    ),
    "excavator": (
        Shape("cab", None, "hinge", 15, (0, 0.3, 0), (0.35, 0.3, 0.35), (0, 0.1, 0), (0, 1, 0)),
        Shape("boom", "cab", "hinge", 10, (0.4, 0.4, 0), (0.5, 0.25, 0.12), (0.15, 0.25, 0), (0, 0, 1)),
    ),
}


@dataclass(frozen=True)
class VirtualBody:
    """A body in pictures: what the solver may see, and the truth."""

    cameras: tuple[Camera, ...]
    floor: Floor
    parts: tuple[Part, ...]
    Ts_world_part: dict[str, Float[np.ndarray, "picture 4 4"]]
    Ts_parent_part: dict[str, Float[np.ndarray, "picture 4 4"]]
    xyz_m: dict[str, Float[np.ndarray, "point 3"]]


def virtual_cameras(rng: np.random.Generator, pictures: int) -> tuple[Camera, ...]:
    """Walk around with a zooming camera: ±45° of azimuth, height, distance and focal length all vary."""
    cameras = []
    for i in range(pictures):
        azimuth, distance = rng.uniform(-0.785, 0.785), rng.uniform(0.9, 2.4)
        eye = np.array([distance * np.cos(azimuth), rng.uniform(0.4, 1.3), distance * np.sin(azimuth)])
        ahead = np.array([0, 0.35, 0]) + rng.normal(0, 0.03, 3) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 1.0, 0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        f = rng.uniform(0.8, 1.1) * distance * 450
        K = np.array([[f, 0, 359.5], [0, f, 269.5], [0, 0, 1.0]])
        cameras.append(
            Camera(
                name=f"picture {i + 1}",
                image_size_px=(720, 540),
                intrinsic_px=K,
                distortion=np.zeros(5),
                T_lab_cam=transform(R, eye),
            )
        )
    return tuple(cameras)


def virtual_body(
    shapes: tuple[Shape, ...],
    seed: int,
    *,
    pictures: int = 4,
    noise_px: float = 0.3,
    turn_rad: tuple[float, float] = (0.17, 1.05),
    wrong: float = 0.0,
    cameras: tuple[Camera, ...] | None = None,
    turns_rad: tuple[float, ...] | None = None,
) -> VirtualBody:
    """Make a body of the shapes, move it, photograph it with normal noise; a share ``wrong`` of the marks is 30 px off.

    Turns are of any size in ``turn_rad``, to either side, or ``turns_rad``, one a picture.
    """
    rng = np.random.default_rng(seed)
    cameras = cameras or virtual_cameras(rng, pictures)
    world: dict[str, np.ndarray] = {}
    local: dict[str, np.ndarray] = {}
    points: dict[str, np.ndarray] = {}
    parts = []
    for shape in shapes:
        X = np.array(shape.middle_m) + (rng.random((shape.points, 3)) - 0.5) * shape.size_m
        on_floor = np.zeros((len(cameras), shape.points), dtype=bool)
        if shape.kind == "free":
            X[:4, 1], on_floor[:, :4] = 0.0, True
        L = np.stack(
            [
                _motion(rng, shape, turns_rad[i] if turns_rad else rng.uniform(*turn_rad) * rng.choice([-1.0, 1.0]))
                if i
                else np.eye(4)
                for i in range(len(cameras))
            ]
        )
        G = (world[shape.parent] if shape.parent else np.eye(4)) @ L
        world[shape.name], local[shape.name], points[shape.name] = G, L, X
        uv = np.stack([project(c, X @ T[:3, :3].T + T[:3, 3]) for c, T in zip(cameras, G, strict=True)])
        uv += rng.normal(0, noise_px, uv.shape) if noise_px else 0.0
        bad = rng.random(uv.shape[:2]) < wrong
        direction = rng.normal(size=uv.shape)
        uv[bad] += 30.0 * (direction / np.linalg.norm(direction, axis=-1, keepdims=True))[bad]
        parts.append(Part(name=shape.name, parent=shape.parent, kind=shape.kind, uv_px=uv, on_floor=on_floor))
    floor = Floor(normal=np.array([0.0, 1.0, 0.0]), offset_m=0.0)
    return VirtualBody(cameras, floor, tuple(parts), world, local, points)


def virtual_turntable(
    seed: int, *, pictures: int = 8, step_rad: float = np.pi / 12, noise_px: float = 0.5
) -> VirtualBody:
    """Photograph a thing on a turntable from one place, turned on by the same step each time.

    The distance of its first two points is known to a millimetre.
    """
    camera = virtual_cameras(np.random.default_rng(seed), 1)[0]
    shape = Shape("thing", None, "hinge", 20, (0, 0.3, 0), (0.3, 0.3, 0.3), (0.03, 0.2, 0.02))
    body = virtual_body(
        (shape,), seed, noise_px=noise_px, turns_rad=tuple(step_rad * np.arange(pictures)),
        cameras=tuple(replace(camera, name=f"picture {i + 1}") for i in range(pictures)),
    )  # fmt: skip
    apart = float(np.linalg.norm(body.xyz_m["thing"][0] - body.xyz_m["thing"][1]))
    length = KnownLength(first=0, second=1, length_m=apart, sd_m=0.001)
    return replace(body, parts=(replace(body.parts[0], length=length),))


def _motion(rng: np.random.Generator, shape: Shape, angle: float) -> Float[np.ndarray, "4 4"]:
    axis, joint = np.array(shape.axis, dtype=float), np.array(shape.joint_m, dtype=float)
    if shape.kind == "spherical":
        axis = rng.normal(size=3)
    if shape.kind == "prismatic":
        return transform(np.eye(3), axis * rng.uniform(0.05, 0.3))
    R = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    if shape.kind in ("free", "planar"):
        shift = rng.uniform(-0.2, 0.2, 3) * (1, 0, 1)
        return transform(R, shift)
    return transform(R, joint - R @ joint)


def relative_to(Ts: Float[np.ndarray, "picture 4 4"], reference: int) -> Float[np.ndarray, "picture 4 4"]:
    """Express motions against another reference picture."""
    return Ts @ inverse(Ts[reference])


def virtual_background(
    cameras: tuple[Camera, ...],
    seed: int,
    *,
    points: int = 40,
    noise_px: float = 0.3,
    wrong: float = 0.0,
    principal_sd_px: float = 0.0,
    focal_known: bool = False,
    tallest_m: float = 1.3,
) -> tuple[Background, Float[np.ndarray, "point 3"]]:
    """Mark what stands still around a virtual body: four points of the floor, the others anywhere around; gives the truth too.

    The first two points of the floor are the origin and a place along X; the first camera's height is the measure. A share
    ``wrong`` of the marks is 30 px off. What lies outside the picture or behind the camera is not seen. Nothing is higher than
    ``tallest_m``: with 0 there is but the floor.
    """
    rng = np.random.default_rng(seed + 100_000)
    X = rng.uniform([-1.5, 0.0, -1.2], [0.5, tallest_m, 1.2], (points, 3))
    X[:4] = [[0, 0, 0], [0.5, 0, 0], [0.1, 0, 0.5], [0.1, 0, -0.4]]
    size = cameras[0].image_size_px
    uv = np.stack([project(camera, X) for camera in cameras])
    uv += rng.normal(0, noise_px, uv.shape) if noise_px else 0.0
    bad = rng.random(uv.shape[:2]) < wrong
    bad[:, :4] = False
    uv[bad] += 30.0 * rng.choice([-1.0, 1.0], uv.shape)[bad]
    uv[~((uv > -0.5) & (uv < np.array(size) - 0.5)).all(axis=-1)] = np.nan
    lens = Lens(
        image_size_px=size,
        focal_px=np.array([c.intrinsic_px[0, 0] if focal_known else np.nan for c in cameras]),
        focal_sd_px=0.0,
        principal_px=(np.array(size) - 1) / 2,
        principal_sd_px=principal_sd_px,
        distortion=np.zeros(5),
        k1_sd=0.0,
    )
    height = CameraHeight(picture=0, height_m=float(cameras[0].centre_lab_m[1]), sd_m=1e-3)
    names = tuple(camera.name for camera in cameras)
    return Background(pictures=names, uv_px=uv, lens=lens, floor_points=(0, 1, 2, 3), heights=(height,)), X
