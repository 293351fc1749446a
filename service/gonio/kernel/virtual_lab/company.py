"""Several walkers in one recording, who hide each other, and whom each camera reports in an order that means nothing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.chance import stream
from gonio.kernel.virtual_lab.effects import PRESETS, Effects
from gonio.kernel.virtual_lab.film import film
from gonio.records import MarkerSet, Rig, Sightings, Walk, record

BEHIND_M = 0.12
"""A keypoint is hidden where somebody nearer to the camera has one within this distance in the picture: half a trunk."""

LOST = 0.5
"""A person of whom more than this share is hidden is not found at all."""


@record
class Company:
    """What the cameras report of several walkers, and who is who: ``place`` is -1 for somebody who is not found."""

    sightings: Sightings
    place: Int[np.ndarray, "person camera frame"]
    seen_lab_m: Float[np.ndarray, "person frame keypoint 3"]


def film_company(
    walks: Sequence[Walk],
    paths: Sequence[Float[np.ndarray, "4 4"]],
    rig: Rig,
    markerset: MarkerSet,
    *,
    effects: Effects = PRESETS["paper"],
    rate_hz: float = 60.0,
    duration_s: float,
    seed: int = 0,
) -> Company:
    """Film several walkers, each on a path of his own.

    Args:
        walks: Who walks, straight on towards the +X of his own path.
        paths: ``T_lab_path`` of each.
        rig: The cameras.
        markerset: Which keypoints are looked for.
        effects: What goes wrong with each walker's keypoints; see :func:`gonio.kernel.virtual_lab.film.film`.
        rate_hz: Of all cameras.
        duration_s: How long.
        seed: Of everything random, the order of the people in each picture too.
    """
    trials, lab = [], []
    for number, (walk, T_lab_path) in enumerate(zip(walks, paths, strict=True)):
        # Filming somebody on another path is filming the same walk with the cameras moved the other way.
        moved = [replace(c, T_lab_cam=np.linalg.inv(T_lab_path) @ c.T_lab_cam) for c in rig.cameras]
        own = replace(rig, cameras=tuple(moved))
        trial = film(walk, own, markerset, effects=effects, rate_hz=rate_hz, duration_s=duration_s, seed=seed + number)
        trials.append(trial)
        lab.append(trial.seen_lab_m @ T_lab_path[:3, :3].T + T_lab_path[:3, 3])
    truth = np.stack(lab)
    uv_px = np.stack([trial.points.uv_px for trial in trials], axis=2)
    confidence = np.stack([trial.points.confidence for trial in trials], axis=2)
    for number, camera in enumerate(rig.cameras):
        depth_m = (truth - camera.centre_lab_m) @ camera.T_lab_cam[:3, 2]
        behind = _behind(project(camera, truth), depth_m, camera.intrinsic_px[0, 0]).swapaxes(0, 1)
        lost = behind | (behind.mean(axis=-1) > LOST)[..., None]
        uv_px[number][lost], confidence[number][lost] = np.nan, 0.0
    order = stream(seed, "order", 0).permuted(np.broadcast_to(np.arange(len(walks)), uv_px.shape[:3]), axis=-1)
    found = np.isfinite(uv_px[..., 0]).any(axis=-1)
    place = np.where(found, np.argsort(order, axis=-1), -1)
    sightings = Sightings(
        camera_names=rig.names,
        keypoint_names=markerset.keypoint_names,
        timebase=trials[0].timebase,
        uv_px=np.take_along_axis(uv_px, order[..., None, None], axis=2),
        confidence=np.take_along_axis(confidence, order[..., None], axis=2),
    )
    return Company(sightings=sightings, place=np.moveaxis(place, -1, 0), seen_lab_m=truth)


def _behind(
    uv_px: Float[np.ndarray, "person frame keypoint 2"],
    depth_m: Float[np.ndarray, "person frame keypoint"],
    focal_px: float,
) -> Bool[np.ndarray, "person frame keypoint"]:
    """Say which keypoints one of the others hides."""
    hidden = np.zeros(depth_m.shape, dtype=bool)
    for person in range(len(uv_px)):
        for other in set(range(len(uv_px))) - {person}:
            apart_px = np.linalg.norm(uv_px[person][:, :, None] - uv_px[other][:, None], axis=-1)
            near = apart_px * depth_m[other][:, None] / focal_px < BEHIND_M
            hidden[person] |= (near & (depth_m[other][:, None] < depth_m[person][:, :, None] - BEHIND_M)).any(axis=-1)
    return hidden
