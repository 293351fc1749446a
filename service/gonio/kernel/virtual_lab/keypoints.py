"""Keypoints as a network would find them: exact projections, spoiled effect by effect."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab.chance import chosen, correlated, spells, stream
from gonio.kernel.virtual_lab.effects import Bursts, Detector, Effects, SelfOcclusion, Swaps
from gonio.records import BURST, DROPPED, HIDDEN, OUTSIDE, PULLED, SWAPPED, Camera, MarkerSet

_LEG_BODIES = ("femur", "tibia", "talus", "calcn", "toes")
_LEG_MARKERS = ("hip", "knee", "ankle", "heel", "big_toe", "small_toe")
_FOOT_MARKERS = ("heel", "big_toe", "small_toe")
_LOWEST = 0.2
"""Below this confidence the scatter grows no more: what a network is that unsure of is a guess in the right region."""


class Anatomy(NamedTuple):
    """What the effects need to know of a set of keypoints."""

    counterpart: Int[np.ndarray, " keypoint"]  # the same keypoint of the other side; itself in the middle
    of_leg: Bool[np.ndarray, " keypoint"]
    of_foot: Bool[np.ndarray, " keypoint"]


class Seen(NamedTuple):
    """What one camera reports, and what was done to it (a sum of the causes that :mod:`gonio.records` names)."""

    uv_px: Float[np.ndarray, "frame keypoint 2"]
    confidence: Float[np.ndarray, "frame keypoint"]
    cause: UInt8[np.ndarray, "frame keypoint"]


def read_anatomy(markerset: MarkerSet) -> Anatomy:
    """Tell sides and limbs from the markers or bodies that a card hangs its keypoints on."""
    # A keypoint without a marker of its own is known by its body and its row: it has no counterpart that could be named.
    rows = zip(markerset.markers, markerset.bodies, strict=True)
    homes = [marker or f"{body}:{row}" for row, (marker, body) in enumerate(rows)]
    swap = {"_r": "_l", "_l": "_r"}
    mirrored = [home[:-2] + swap[home[-2:]] if home[-2:] in swap else home for home in homes]
    return Anatomy(
        counterpart=np.array([homes.index(m) if m in homes else row for row, m in enumerate(mirrored)]),
        of_leg=np.array([home.startswith(_LEG_MARKERS + _LEG_BODIES) for home in homes]),
        of_foot=np.array([home.startswith((*_FOOT_MARKERS, "calcn", "toes")) for home in homes]),
    )


def detect(
    camera: Camera,
    number: int,
    xyz_lab_m: Float[np.ndarray, "frame keypoint 3"],
    behind: Bool[np.ndarray, "frame keypoint"],
    anatomy: Anatomy,
    effects: Effects,
    *,
    rate_hz: float,
    seed: int,
) -> Seen:
    """Give what a camera's keypoint network reports.

    Args:
        camera: The camera as it really is.
        number: Its place in the rig: it has random numbers of its own.
        xyz_lab_m: Where the keypoints are when this camera takes its frames.
        behind: Which of them the body hides from it.
        anatomy: Sides and limbs.
        effects: What goes wrong; with nothing, points are exact and their confidence is 1.
        rate_hz: The frames' rate.
        seed: Of everything random.

    A keypoint outside the picture is NaN: networks put it somewhere at the edge, with next to no confidence.
    """
    exact_px = project(camera, xyz_lab_m)
    depth_m = (xyz_lab_m - camera.centre_lab_m) @ camera.T_lab_cam[:3, 2]
    px_per_m = (camera.intrinsic_px[0, 0] + camera.intrinsic_px[1, 1]) / 2 / depth_m
    shape = depth_m.shape
    seen = Seen(exact_px.copy(), np.ones(shape), np.zeros(shape, dtype=np.uint8))
    if effects.detector is not None:
        seen.confidence[:] = _trust(effects.detector, anatomy, shape, rate_hz, stream(seed, "confidence", number))
    if effects.occlusion is not None:
        seen.confidence[behind] *= effects.occlusion.confidence
        seen.cause[behind] |= HIDDEN
    if effects.detector is not None:
        away_m = _scatter(effects.detector, seen.confidence, rate_hz, stream(seed, "scatter", number))
        seen.uv_px[:] += px_per_m[..., None] * away_m
    if effects.occlusion is not None:
        _pull(seen, effects.occlusion, behind, anatomy, exact_px, rate_hz, stream(seed, "pull", number))
    if effects.bursts is not None:
        _burst(seen, effects.bursts, px_per_m, rate_hz, stream(seed, "bursts", number))
    if effects.swaps is not None:
        _swap(seen, effects.swaps, anatomy, rate_hz, stream(seed, "swaps", number))
    dropped = chosen(stream(seed, "dropouts", number), shape, effects.dropouts)
    inside = (exact_px > -0.5).all(axis=-1) & (exact_px < np.array(camera.image_size_px) - 0.5).all(axis=-1)
    seen.cause[dropped] |= DROPPED
    seen.cause[~inside] |= OUTSIDE
    seen.uv_px[dropped | ~inside], seen.confidence[dropped | ~inside] = np.nan, 0.0
    return seen


def _trust(
    detector: Detector, anatomy: Anatomy, shape: tuple[int, int], rate_hz: float, rng: np.random.Generator
) -> Float[np.ndarray, "frame keypoint"]:
    usual = np.where(anatomy.of_foot, detector.foot_confidence, detector.confidence)
    wander = correlated(rng, shape, rate_hz, detector.correlation_s)
    return np.clip(usual + detector.confidence_sd * wander, 0.05, 0.95)


def _scatter(
    detector: Detector, confidence: Float[np.ndarray, "frame keypoint"], rate_hz: float, rng: np.random.Generator
) -> Float[np.ndarray, "frame keypoint 2"]:
    """Draw displacements in the picture's plane, m at the person."""
    shape = (*confidence.shape, 2)
    bias = detector.bias_m * rng.standard_normal(shape[1:])
    unit = np.sqrt(detector.white) * rng.standard_normal(shape)
    unit += np.sqrt(1.0 - detector.white) * correlated(rng, shape, rate_hz, detector.correlation_s)
    sigma_m = detector.sigma_m * detector.confidence / np.maximum(confidence, _LOWEST)
    return bias + sigma_m[..., None] * unit


def _pull(
    seen: Seen,
    occlusion: SelfOcclusion,
    behind: Bool[np.ndarray, "frame keypoint"],
    anatomy: Anatomy,
    exact_px: Float[np.ndarray, "frame keypoint 2"],
    rate_hz: float,
    rng: np.random.Generator,
) -> None:
    """Draw hidden keypoints towards the same keypoint of the near limb, for stretches of 0.1 to 0.5 s."""
    for keypoint, other in enumerate(anatomy.counterpart):
        for stretch in spells(rng, len(exact_px), rate_hz, occlusion.pulled, (0.1, 0.5)):
            way = rng.uniform(*occlusion.pull)
            drawn = behind[stretch, keypoint] & (other != keypoint)
            towards = exact_px[stretch, other] - exact_px[stretch, keypoint]
            seen.uv_px[stretch, keypoint] += np.where(drawn[:, None], way * towards, 0.0)
            seen.confidence[stretch, keypoint] *= np.where(drawn, occlusion.pulled_confidence, 1.0)
            seen.cause[stretch, keypoint] |= np.where(drawn, PULLED, 0).astype(np.uint8)


def _burst(
    seen: Seen,
    bursts: Bursts,
    px_per_m: Float[np.ndarray, "frame keypoint"],
    rate_hz: float,
    rng: np.random.Generator,
) -> None:
    """Put keypoints elsewhere for stretches of time, each in one direction; mostly the network is less sure then."""
    for keypoint in range(px_per_m.shape[1]):
        for stretch in spells(rng, len(px_per_m), rate_hz, bursts.share, bursts.length_s):
            angle, size_m = rng.uniform(0, 2 * np.pi), rng.uniform(*bursts.size_m)
            unsure, confident = rng.uniform(0.1, 0.6), rng.random() < bursts.confident
            away = size_m * np.array([np.cos(angle), np.sin(angle)])
            seen.uv_px[stretch, keypoint] += px_per_m[stretch, keypoint, None] * away
            seen.cause[stretch, keypoint] |= BURST
            if not confident:
                seen.confidence[stretch, keypoint] *= unsure


def _swap(seen: Seen, swaps: Swaps, anatomy: Anatomy, rate_hz: float, rng: np.random.Generator) -> None:
    """Exchange the keypoints of both legs for stretches of time."""
    legs = np.flatnonzero(anatomy.of_leg)
    others = anatomy.counterpart[legs]
    for stretch in spells(rng, len(seen.uv_px), rate_hz, swaps.share, swaps.length_s):
        seen.uv_px[stretch, legs] = seen.uv_px[stretch, others]
        seen.confidence[stretch, legs] = seen.confidence[stretch, others]
        seen.cause[stretch, legs] |= SWAPPED
