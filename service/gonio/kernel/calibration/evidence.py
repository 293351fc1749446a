"""Everything that a verdict on a calibration rests on, gathered in one place."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import CaptureError, SolverError
from gonio.kernel.calibration.board_terms import FOCAL
from gonio.kernel.calibration.bump import Bump, find_bumps
from gonio.kernel.calibration.held_out import Halves, solve_halves, some_cameras
from gonio.kernel.calibration.intrinsics import coverage
from gonio.kernel.calibration.rig import RigSolution, focal_variance_px2, solve_rig
from gonio.records import BoardViews, Intrinsics


@dataclass(frozen=True)
class KnownLength:
    """A length that was measured by hand, and what the calibration makes of it, metres."""

    name: str
    true_m: float
    found_m: float


@dataclass(frozen=True)
class Evidence:
    """What is known of a calibration beyond its fit; tuples and arrays run over the cameras that are connected.

    ``focal_shift`` is by how many standard deviations of both the focal length from this session alone differs from the
    given one (NaN where none was given). ``covered`` are the cells of a 6 × 4 grid in which corners were seen, in this
    recording or in the lens's own. ``frame_period_s`` is that of the videos, whatever part of their frames was used.
    """

    names: tuple[str, ...]
    unconnected: tuple[str, ...]
    image_widths_px: tuple[int, ...]
    intrinsics: tuple[Intrinsics, ...]
    solution: RigSolution
    halves: Halves | None
    bumps: tuple[Bump, ...]
    focal_shift: Float[np.ndarray, " camera"]
    covered: Bool[np.ndarray, "camera 4 6"]
    frame_period_s: float
    known_lengths: tuple[KnownLength, ...]


def gather_evidence(
    views: BoardViews,
    intrinsics: Sequence[Intrinsics],
    solution: RigSolution,
    frame_period_s: float,
    known_lengths: Sequence[KnownLength] = (),
) -> Evidence:
    """Solve the halves, the session without its prior and the split cameras, and look at the coverage."""
    optics = tuple(intrinsics[c] for c in solution.cameras)
    connected = some_cameras(views, solution.cameras)
    return Evidence(
        names=connected.camera_names,
        unconnected=tuple(name for c, name in enumerate(views.camera_names) if c not in solution.cameras),
        image_widths_px=tuple(size[0] for size in connected.image_sizes_px),
        intrinsics=optics,
        solution=solution,
        halves=solve_halves(views, solution),
        bumps=find_bumps(views, solution),
        focal_shift=_focal_shift(connected, optics),
        covered=np.stack(
            [
                coverage(uv_px, size) | lens.covered
                for uv_px, size, lens in zip(connected.uv_px, connected.image_sizes_px, optics, strict=True)
            ]
        ),
        frame_period_s=frame_period_s,
        known_lengths=tuple(known_lengths),
    )


def _focal_shift(views: BoardViews, optics: Sequence[Intrinsics]) -> Float[np.ndarray, " camera"]:
    shift = np.full(len(optics), np.nan)
    try:
        free = solve_rig(views, optics, ignore_prior=True)
    except (CaptureError, SolverError):
        return shift
    for place, camera in enumerate(free.cameras):
        if optics[camera].origin != "session":
            variance = free.adjusted.sd(place)[6 + FOCAL] ** 2 + focal_variance_px2(optics[camera])
            moved = free.scene.theta[place, FOCAL] - optics[camera].parameters[FOCAL]
            shift[camera] = abs(moved) / np.sqrt(variance)
    return shift
