"""Tell several people apart in a single camera: by where they are in the picture, from look to look."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from gonio.records import ImagePoints, Sightings

FEWEST_KEYPOINTS = 6
"""A sighting with fewer trusted keypoints is nobody."""

PATIENCE_S = 0.5
"""Who is not seen for longer has to be found anew."""

FARTHEST = 0.25
"""Of a person's height in the picture: nobody moves by more from one look to the next; two people are farther apart."""


@dataclass(eq=False)
class _Track:
    uv_px: Float[np.ndarray, "keypoint 2"]
    last: int
    places: dict[int, int] = field(default_factory=dict)
    heights_px: list[float] = field(default_factory=list)

    @property
    def presence(self) -> float:
        """How much of the pictures the person takes up over time: the sum of heights."""
        return sum(self.heights_px)


def follow_people(sightings: Sightings, min_confidence: float) -> tuple[ImagePoints, ...]:
    """Follow everybody through one camera's pictures.

    Args:
        sightings: Everybody whom the one camera reports.
        min_confidence: Keypoints that are trusted less don't tell who it is.

    Returns:
        Each person's keypoints: who is seen the longest and the largest comes first.
    """
    uv_px, confidence = sightings.uv_px[0], sightings.confidence[0]
    trusted = np.isfinite(uv_px).all(axis=-1) & (confidence >= max(min_confidence, 1e-9))
    patience = max(PATIENCE_S * sightings.timebase.rate_hz, 2 * sightings.stride)
    tracks: list[_Track] = []
    for frame in sightings.looks.tolist():
        _continue(tracks, frame, np.where(trusted[frame][..., None], uv_px[frame], np.nan), patience)
    ordered = sorted(tracks, key=lambda track: -track.presence)
    return tuple(_points(sightings, track) for track in ordered)


def _continue(tracks: list[_Track], frame: int, seen: Float[np.ndarray, "place keypoint 2"], patience: float) -> None:
    """Give each sighting to the nearest track of somebody near, the nearest pair first; the rest begin tracks."""
    places = [p for p, own in enumerate(seen) if np.isfinite(own[:, 0]).sum() >= FEWEST_KEYPOINTS]
    live = [track for track in tracks if frame - track.last <= patience]
    pairs: list[tuple[float, int, int]] = []
    for number, track in enumerate(live):
        for place in places:
            apart_px = np.linalg.norm(track.uv_px - seen[place], axis=-1)
            if np.isfinite(apart_px).any():
                share = float(np.nanmedian(apart_px)) / max(_height_px(seen[place]), 1.0)
                pairs.append((share / max(1.0, np.sqrt(frame - track.last)), number, place))
    taken_tracks: set[int] = set()
    taken_places: set[int] = set()
    for share, number, place in sorted(pairs):
        if share > FARTHEST or number in taken_tracks or place in taken_places:
            continue
        taken_tracks.add(number)
        taken_places.add(place)
        _meet(live[number], frame, place, seen[place])
    for place in places:
        if place not in taken_places:
            track = _Track(seen[place], frame)
            _meet(track, frame, place, seen[place])
            tracks.append(track)


def _meet(track: _Track, frame: int, place: int, uv_px: Float[np.ndarray, "keypoint 2"]) -> None:
    known = np.isfinite(uv_px[:, 0])
    track.uv_px = np.where(known[:, None], uv_px, track.uv_px)
    track.last = frame
    track.places[frame] = place
    track.heights_px.append(_height_px(uv_px))


def _height_px(uv_px: Float[np.ndarray, "keypoint 2"]) -> float:
    return float(np.nanmax(uv_px[:, 1]) - np.nanmin(uv_px[:, 1]))


def _points(sightings: Sightings, track: _Track) -> ImagePoints:
    uv_px = np.full((1, *sightings.uv_px.shape[1:2], *sightings.uv_px.shape[3:]), np.nan)
    confidence = np.zeros(uv_px.shape[:3])
    for frame, place in track.places.items():
        uv_px[0, frame], confidence[0, frame] = sightings.uv_px[0, frame, place], sightings.confidence[0, frame, place]
    confidence[np.isnan(uv_px).any(axis=-1)] = 0.0
    return ImagePoints(
        camera_names=sightings.camera_names,
        keypoint_names=sightings.keypoint_names,
        timebase=sightings.timebase,
        uv_px=uv_px,
        confidence=confidence,
        stride=sightings.stride,
    )
