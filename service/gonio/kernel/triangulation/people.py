"""Tell several people apart: across cameras by geometry, over time by motion.

Frame by frame each known person's skeleton is foretold in the lab, and each camera's sightings are shared out among the
persons at the least total distance (optimal assignment). Whom two cameras then agree on is there; sightings that are left
over may be somebody new (:func:`gonio.kernel.triangulation.association.associate_people`). Because every camera is compared
with what all cameras together foretell, two people who cross in one picture keep their names. Stretches of one person's track
are joined over a gap that could be walked.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices, undistort_rig
from gonio.kernel.triangulation.association import (
    FEWEST_KEYPOINTS,
    SAME_PERSON_M,
    SOMEBODY_ELSE_M,
    AssociatedPerson,
    associate_people,
)
from gonio.kernel.triangulation.points import triangulate
from gonio.records import ImagePoints, Person, Rig, Sightings

PATIENCE_S = 0.5
"""A person whom no two cameras agree on for longer has to be found anew: a walker is then half a metre from where foretold."""

PRESENT_S = 0.2
"""Somebody who is there for less is nobody: sightings that meet by chance part again within a few frames."""

APART_M = 0.3
"""Nobody stands within this distance of somebody else, hip to hip: that is the same person, found twice in some cameras."""

FASTEST_M_S = 2.5
"""Walking speed that nobody exceeds: a person can't have gone farther than this while unseen."""

VELOCITY_S = 0.1
"""Time constant of the velocity that foretells: a detector's errors last as long."""

Skeleton = Float[np.ndarray, "keypoint 3"]


@dataclass(eq=False)
class _Track:
    """A person while being followed: the last known skeleton, how it moves, and what was seen of it in which frame."""

    skeleton: Skeleton
    velocity_m_s: Float[np.ndarray, "3"]
    last: int
    places: dict[int, Int[np.ndarray, " camera"]] = field(default_factory=dict)
    centres: dict[int, Float[np.ndarray, "3"]] = field(default_factory=dict)

    def foretell(self, frame: int, rate_hz: float) -> Skeleton:
        return self.skeleton + self.velocity_m_s * (frame - self.last) / rate_hz

    def meet(self, frame: int, xyz: Skeleton, rate_hz: float) -> None:
        """Take in where the cameras agree that the person is; keypoints that they don't see move along."""
        foretold = self.foretell(frame, rate_hz)
        known = np.isfinite(xyz[:, 0])
        moved = np.median((xyz - foretold)[known], axis=0)
        dt_s = (frame - self.last) / rate_hz
        self.velocity_m_s = self.velocity_m_s + moved / (dt_s + VELOCITY_S)
        self.skeleton = np.where(known[:, None], xyz, foretold + moved)
        self.centres[frame] = np.nanmedian(self.skeleton, axis=0)
        self.last = frame


def find_people(rig: Rig, sightings: Sightings, min_confidence: float) -> tuple[Person, ...]:
    """Find out who is who among all cameras' sightings, over the whole trial.

    Args:
        rig: The calibrated cameras.
        sightings: Everybody whom each camera reports.
        min_confidence: Keypoints that are trusted less prove nothing about who it is.

    Returns:
        Everybody on whom at least two cameras agree for a while, in the order of the first meeting. No sighting belongs to
        two persons.
    """
    scene = _Scene(rig, sightings, min_confidence)
    ended: list[_Track] = []
    live: list[_Track] = []
    for frame in sightings.looks:
        lost = [track for track in live if frame - track.last > max(PATIENCE_S * scene.rate_hz, 2 * sightings.stride)]
        ended += lost
        live = [track for track in live if track not in lost]
        scene.follow(live, int(frame))
        live += scene.newcomers(live, int(frame))
    fewest = min(max(2, round(PRESENT_S * scene.rate_hz / sightings.stride)), (len(sightings.looks) + 1) // 2)
    tracks = [track for track in (*ended, *live) if len(track.centres) >= fewest]
    joined = join_tracks(sorted(tracks, key=lambda t: min(t.centres)), scene.rate_hz)
    people = [_person(sightings, track) for track in joined]
    return tuple(person for person in people if not _is_ghost(rig, person, people))


class _Scene:
    """The sightings of a trial, undistorted, and the cameras that they are compared in."""

    def __init__(self, rig: Rig, sightings: Sightings, min_confidence: float) -> None:
        self._rig = rig
        self._projections, self._focal_px = projection_matrices(rig), focal_lengths_px(rig)
        trusted = sightings.confidence >= max(min_confidence, 1e-9)
        self._uv_px = undistort_rig(rig, np.where(trusted[..., None], sightings.uv_px, np.nan))
        self._weight = np.where(np.isfinite(self._uv_px[..., 0]), sightings.confidence, 0.0)
        self.rate_hz = sightings.timebase.rate_hz

    def follow(self, tracks: Sequence[_Track], frame: int) -> None:
        """Share out a frame's sightings among the persons whom we know."""
        if not tracks:
            return
        cameras = len(self._rig.cameras)
        places = np.full((len(tracks), cameras), -1)
        foretold = np.stack([track.foretell(frame, self.rate_hz) for track in tracks])
        held = np.stack([next(reversed(track.places.values())) for track in tracks]) >= 0
        for camera in range(cameras):
            away_m = self._distances_m(camera, frame, foretold)
            # A camera that had lost the person must fit as well as one that finds it for the first time.
            limit_m = np.where(held[:, camera, None], SOMEBODY_ELSE_M, SAME_PERSON_M)
            cost = np.where(away_m < limit_m, away_m, 1e3)
            for person, place in zip(*linear_sum_assignment(cost), strict=True):
                if cost[person, place] < 1e3:
                    places[person, camera] = place
        xyz, miss_m = self._meet(frame, places)
        many = (places >= 0).sum(axis=1, keepdims=True) > 2
        places[many & (miss_m > SOMEBODY_ELSE_M)] = -1
        for track, own, met in zip(tracks, places, xyz, strict=True):
            track.places[frame] = own
            if np.isfinite(met[:, 0]).sum() >= FEWEST_KEYPOINTS and (own >= 0).sum() >= 2:
                track.meet(frame, met, self.rate_hz)

    def newcomers(self, tracks: Sequence[_Track], frame: int) -> list[_Track]:
        """Find new persons among the sightings that belong to nobody."""
        taken = np.zeros(self._weight.shape[:1] + self._weight.shape[2:3], dtype=bool)
        for track in tracks:
            cameras = np.flatnonzero(track.places[frame] >= 0)
            taken[cameras, track.places[frame][cameras]] = True
        enough = (self._weight[:, frame] > 0).sum(axis=-1) >= FEWEST_KEYPOINTS
        free = [np.flatnonzero(row) for row in enough & ~taken]
        if sum(len(places) > 0 for places in free) < 2:
            return []
        uv_px = [self._uv_px[camera, frame, places] for camera, places in enumerate(free)]
        weight = [self._weight[camera, frame, places] for camera, places in enumerate(free)]
        here = [np.median(track.foretell(frame, self.rate_hz), axis=0) for track in tracks]
        found: list[_Track] = []
        for person in associate_people(self._rig, uv_px, weight):
            if any(np.linalg.norm((person.centre_lab_m - other)[[0, 2]]) < APART_M for other in here):
                continue
            found.append(self._start(frame, person, free))
            here.append(person.centre_lab_m)
        return found

    def _start(self, frame: int, person: AssociatedPerson, free: Sequence[Int[np.ndarray, " place"]]) -> _Track:
        own = np.array([free[camera][i] if i >= 0 else -1 for camera, i in enumerate(person.candidate)])
        xyz = self._meet(frame, own[None])[0][0]
        skeleton = np.where(np.isfinite(xyz), xyz, person.centre_lab_m)
        return _Track(skeleton, np.zeros(3), frame, {frame: own}, {frame: person.centre_lab_m})

    def _distances_m(
        self, camera: int, frame: int, skeletons: Float[np.ndarray, "person keypoint 3"]
    ) -> Float[np.ndarray, "person place"]:
        """Give how far a camera's sightings are from skeletons: the median over their keypoints, at the skeleton's depth."""
        image = skeletons @ self._projections[camera, :, :3].T + self._projections[camera, :, 3]
        depth_m = image[..., 2]
        ahead = np.where(depth_m > 0, depth_m, np.nan)
        apart = self._uv_px[camera, frame] - (image[..., :2] / ahead[..., None])[:, None]
        away_m = np.linalg.norm(apart, axis=-1) * ahead[:, None] / self._focal_px[camera]
        return _median(away_m)

    def _meet(
        self, frame: int, places: Int[np.ndarray, "person camera"]
    ) -> tuple[Float[np.ndarray, "person keypoint 3"], Float[np.ndarray, "person camera"]]:
        """Triangulate all persons' keypoints, and say how far each camera misses each person."""
        persons, cameras = places.shape
        of = np.arange(cameras)
        uv_px = self._uv_px[of, frame, places].transpose(1, 0, 2, 3)  # camera, person, keypoint, 2
        weight = np.where(places[..., None] >= 0, self._weight[of, frame, places], 0.0).transpose(1, 0, 2)
        solved = triangulate(
            self._projections, self._focal_px, uv_px.reshape(cameras, -1, 2), weight.reshape(cameras, -1)
        )
        xyz = solved.xyz_lab_m
        depth_m = self._projections[:, 2, :3] @ xyz.T + self._projections[:, 2, 3:]
        miss_m = np.linalg.norm(solved.residual_px, axis=-1) * depth_m / self._focal_px[:, None]
        return xyz.reshape(persons, -1, 3), _median(miss_m.reshape(cameras, persons, -1), fewest=1).T


def _median(
    away_m: Float[np.ndarray, "*batch keypoint"], fewest: int = FEWEST_KEYPOINTS
) -> Float[np.ndarray, "*batch"]:
    """Give the median of what is known; infinite where that is too little."""
    known = np.isfinite(away_m).sum(axis=-1)
    ordered = np.sort(away_m, axis=-1)  # NaN last
    low, high = (np.maximum(known - 1, 0) // 2)[..., None], (known // 2)[..., None]
    high = np.minimum(high, np.maximum(known - 1, 0)[..., None])
    middle = (np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1))[..., 0] / 2
    return np.where(known >= fewest, middle, np.inf)


def join_tracks(tracks: Sequence[_Track], rate_hz: float) -> list[_Track]:
    """Join the stretches of one person over gaps that could be walked, at the least total distance from where foretold."""
    if not tracks:
        return []
    cost = np.full((len(tracks), len(tracks)), 1e6)
    for i, before in enumerate(tracks):
        for j, after in enumerate(tracks):
            start = min(after.centres)
            gap_s = (start - before.last) / rate_hz
            way_m = float(np.linalg.norm((after.centres[start] - before.centres[before.last])[[0, 2]]))
            if gap_s > 0 and way_m < APART_M + FASTEST_M_S * gap_s:
                foretold = before.centres[before.last] + before.velocity_m_s * min(gap_s, PATIENCE_S)
                cost[i, j] = np.linalg.norm((after.centres[start] - foretold)[[0, 2]])
    follower = {int(i): int(j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 1e6}
    firsts = [i for i in range(len(tracks)) if i not in follower.values()]
    joined: list[_Track] = []
    for first in firsts:
        whole, at = tracks[first], first
        while at in follower:
            at = follower[at]
            own = {frame: row for frame, row in whole.places.items() if frame <= whole.last}
            whole = _Track(
                tracks[at].skeleton,
                tracks[at].velocity_m_s,
                tracks[at].last,
                own | tracks[at].places,
                whole.centres | tracks[at].centres,
            )
        joined.append(whole)
    return joined


def _person(sightings: Sightings, track: _Track) -> Person:
    cameras, frames = sightings.uv_px.shape[:2]
    place, centre = np.full((cameras, frames), -1), np.full((frames, 3), np.nan)
    for frame, own in track.places.items():
        if frame <= track.last:  # later ones were taken on a prediction that nothing confirmed
            place[:, frame] = own
    for frame, at in track.centres.items():
        centre[frame] = at
    seen = place >= 0
    camera, frame = np.nonzero(seen)
    uv_px = np.full((cameras, frames, *sightings.uv_px.shape[3:]), np.nan)
    confidence = np.zeros(uv_px.shape[:3])
    uv_px[seen] = sightings.uv_px[camera, frame, place[seen]]
    confidence[seen] = sightings.confidence[camera, frame, place[seen]]
    points = ImagePoints(
        camera_names=sightings.camera_names,
        keypoint_names=sightings.keypoint_names,
        timebase=sightings.timebase,
        uv_px=uv_px,
        confidence=confidence,
        stride=sightings.stride,
    )
    return Person(place=place, points=points, centre_lab_m=centre)


def _is_ghost(rig: Rig, person: Person, people: Sequence[Person]) -> bool:
    """Say whether only two cameras vouch for a person whom two more would have to see.

    In company only: rays of two persons may meet where nobody stands. Somebody alone is believed with two cameras.
    """
    met = person.met
    cameras = (person.place[:, met] >= 0).sum(axis=0)
    better = [p for p in people if np.mean((p.place[:, p.met] >= 0).sum(axis=0) > 2) > 0.5 and (p.met & met).any()]
    if not better or np.mean(cameras > 2) > 0.1:
        return False
    return float(np.mean(_in_view(rig, person.centre_lab_m[met]).sum(axis=0) >= cameras + 2)) > 0.5


def _in_view(rig: Rig, xyz_lab_m: Float[np.ndarray, "frame 3"]) -> Bool[np.ndarray, "camera frame"]:
    image = np.einsum("cij,fj->cfi", projection_matrices(rig)[..., :3], xyz_lab_m)
    image += projection_matrices(rig)[:, None, :, 3]
    uv_px = image[..., :2] / image[..., 2:]
    size_px = np.array([camera.image_size_px for camera in rig.cameras])[:, None]
    return (image[..., 2] > 0) & ((uv_px > 0) & (uv_px < size_px)).all(axis=-1)
