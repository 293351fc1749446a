"""Film a walk: cameras, clocks, calibration and keypoints, with their truth."""

from dataclasses import replace

import numpy as np

from gonio.errors import InputError
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.effects import PRESETS, Effects
from gonio.kernel.virtual_lab.harmonics import coordinates_at
from gonio.kernel.virtual_lab.keypoints import detect, read_anatomy
from gonio.kernel.virtual_lab.person import keypoints_on_person
from gonio.kernel.virtual_lab.rig import camera_times_s, miscalibrate
from gonio.kernel.virtual_lab.shape import capsules_of, hidden, place
from gonio.kernel.virtual_lab.walker import truth_at
from gonio.records import ImagePoints, MarkerSet, Rig, Timebase, VirtualTrial, Walk


def film(
    walk: Walk,
    rig: Rig,
    markerset: MarkerSet,
    *,
    effects: Effects = PRESETS["paper"],
    rate_hz: float = 120.0,
    duration_s: float | None = None,
    seed: int = 0,
) -> VirtualTrial:
    """Let the cameras of a rig film a walk, and a network find its keypoints.

    Args:
        walk: What is filmed, from its time 0 on.
        rig: The cameras as they really are; their calibration may say otherwise.
        markerset: Which keypoints are looked for.
        effects: What goes wrong: one of :data:`gonio.kernel.virtual_lab.effects.PRESETS`, or your own.
        rate_hz: Of all cameras, nominally.
        duration_s: How long; None until the walker is as far beyond the middle of the lab as he began before it.
        seed: Of everything random. The same arguments give the same recording.

    Raises:
        InputError: a recording of no length, or a marker set for another body.
    """
    if duration_s is None:
        duration_s = -2.0 * walk.start_m / walk.steps.speed_m_s
    frames = round(duration_s * rate_hz)
    if frames < 2:
        raise InputError(
            f"A recording of {duration_s:.3f} s has no two frames.", hint="Give a duration, or start before the middle."
        )
    timebase = Timebase(rate_hz=rate_hz)
    body, anatomy, capsules = attach(walk.body, markerset), read_anatomy(markerset), capsules_of(walk.body)
    marked = replace(body, markers=replace(body.markers, names=_marker_names(markerset)))
    taken_s = camera_times_s(timebase, frames, len(rig.cameras), effects.clocks, seed)
    seen, exact = [], []
    for number, (camera, times_s) in enumerate(zip(rig.cameras, taken_s, strict=True)):
        q = coordinates_at(walk, times_s).q
        xyz = keypoints_on_person(marked, q, effects.mismatch)
        behind = hidden(camera.centre_lab_m, xyz, place(walk.body, capsules, q))
        seen.append(detect(camera, number, xyz, behind, anatomy, effects, rate_hz=rate_hz, seed=seed))
        exact.append(project(camera, xyz))
    truth = truth_at(walk, timebase.times_s(frames))
    return VirtualTrial(
        walk=walk,
        seed=seed,
        rig=miscalibrate(rig, effects.calibration, seed),
        points=ImagePoints(
            camera_names=rig.names,
            keypoint_names=markerset.keypoint_names,
            timebase=timebase,
            uv_px=np.stack([one.uv_px for one in seen]),
            confidence=np.stack([one.confidence for one in seen]),
        ),
        truth=truth,
        xyz_lab_m=marker_positions(body, truth.q),
        seen_lab_m=keypoints_on_person(marked, truth.q, effects.mismatch),
        rig_true=rig,
        camera_times_s=taken_s,
        exact_px=np.stack(exact),
        cause=np.stack([one.cause for one in seen]),
    )


def _marker_names(markerset: MarkerSet) -> tuple[str, ...]:
    """Name each keypoint by the model's marker that it stands for, so that effects know hips from knees."""
    return tuple(marker or name for marker, name in zip(markerset.markers, markerset.keypoint_names, strict=True))
