"""Find the same person in several cameras by geometry."""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from gonio.kernel.geometry.cameras import focal_lengths_px, projection_matrices
from gonio.kernel.triangulation.points import Method, triangulate
from gonio.records import Rig, record

SAME_PERSON_M = 0.15
"""Two cameras show the same person if its keypoints meet this well (median over the keypoints, at the person's depth).

Generous on purpose: a camera whose calibration has drifted by a degree is off by 70 mm at 4 m and still sees the subject;
two people standing apart miss each other by more than half a metre in some camera.
"""

SOMEBODY_ELSE_M = 2 * SAME_PERSON_M
"""A camera that misses the person by this much follows somebody else: limbs that it confuses for some frames miss less."""

FEWEST_KEYPOINTS = 4
"""Fewer keypoints that two cameras share prove nothing: three rays meet three rays by chance."""


@record
class AssociatedPerson:
    """One person: ``candidate`` is its index in each camera's list (-1: not seen there); ``error_m`` how well they meet."""

    candidate: tuple[int, ...]
    centre_lab_m: Float[np.ndarray, "3"]
    error_m: float

    @property
    def cameras(self) -> int:
        """In how many cameras the person was found."""
        return sum(index >= 0 for index in self.candidate)


def associate_people(
    rig: Rig,
    candidates_px: list[Float[np.ndarray, "candidate keypoint 2"]],
    confidence: list[Float[np.ndarray, "candidate keypoint"]],
) -> list[AssociatedPerson]:
    """Group the people found in each camera at one instant into persons seen by at least two cameras.

    Every pair of candidates in two cameras proposes a person; each other camera adds the candidate that fits the
    proposal best, if it fits. Proposals are taken in order of (cameras, error), and each candidate serves once, so no
    ghost is made of what already belongs to somebody.

    Args:
        rig: The cameras.
        candidates_px: For each camera its candidates' keypoints, undistorted pixels, NaN missing.
        confidence: The same for their confidence.
    """
    proposals = [
        _propose(rig, candidates_px, confidence, {a: i, b: j})
        for a, b in combinations(range(len(candidates_px)), 2)
        for i in range(len(candidates_px[a]))
        for j in range(len(candidates_px[b]))
    ]
    fitting = [person for person in proposals if person is not None]
    people: list[AssociatedPerson] = []
    used: set[tuple[int, int]] = set()
    for person in sorted(fitting, key=lambda p: (-p.cameras, p.error_m)):
        members = {(camera, index) for camera, index in enumerate(person.candidate) if index >= 0}
        if not members & used:
            people.append(person)
            used |= members
    return people


def _propose(
    rig: Rig,
    candidates_px: list[Float[np.ndarray, "candidate keypoint 2"]],
    confidence: list[Float[np.ndarray, "candidate keypoint"]],
    seed: dict[int, int],
) -> AssociatedPerson | None:
    """Triangulate the seed pair and let each other camera add the candidate that fits; None if the seed does not meet."""
    members = dict(seed)
    person = _meet(rig, candidates_px, confidence, members)
    if person is None:
        return None
    for camera in range(len(candidates_px)):
        if camera in seed:
            continue
        trials = [
            (trial.error_m, index)
            for index in range(len(candidates_px[camera]))
            if (trial := _meet(rig, candidates_px, confidence, {**members, camera: index})) is not None
        ]
        if trials:
            members[camera] = min(trials)[1]
    return _meet(rig, candidates_px, confidence, members)


def _meet(
    rig: Rig,
    candidates_px: list[Float[np.ndarray, "candidate keypoint 2"]],
    confidence: list[Float[np.ndarray, "candidate keypoint"]],
    members: dict[int, int],
) -> AssociatedPerson | None:
    """Triangulate the members' keypoints together; None if in any camera they miss each other."""
    keypoints = next(c.shape[1] for c in candidates_px if len(c))
    uv_px = np.full((len(rig.cameras), keypoints, 2), np.nan)
    weight = np.zeros((len(rig.cameras), keypoints))
    for camera, index in members.items():
        uv_px[camera] = candidates_px[camera][index]
        weight[camera] = confidence[camera][index]
    xyz, miss_m = meet(rig, uv_px, weight, method="reprojection")
    if np.isfinite(xyz[:, 0]).sum() < FEWEST_KEYPOINTS:
        return None
    worst_m = max((float(miss_m[camera]) for camera in members if np.isfinite(miss_m[camera])), default=np.inf)
    if worst_m > SAME_PERSON_M:
        return None
    candidate = tuple(members.get(camera, -1) for camera in range(len(rig.cameras)))
    return AssociatedPerson(candidate=candidate, centre_lab_m=np.nanmedian(xyz, axis=0), error_m=worst_m)


def meet(
    rig: Rig,
    uv_px: Float[np.ndarray, "camera keypoint 2"],
    confidence: Float[np.ndarray, "camera keypoint"],
    *,
    method: Method = "robust",
) -> tuple[Float[np.ndarray, "keypoint 3"], Float[np.ndarray, " camera"]]:
    """Triangulate one person's keypoints (undistorted pixels) and say how far each camera misses them.

    The miss is the median over the camera's keypoints of the reprojection error at the point's depth, in metres; NaN for a
    camera that shares no keypoint with another.
    """
    projections, focal_px = projection_matrices(rig), focal_lengths_px(rig)
    solved = triangulate(projections, focal_px, uv_px, confidence, method=method)
    xyz = solved.xyz_lab_m
    depth_m = projections[:, 2, :3] @ xyz.T + projections[:, 2, 3:]
    miss_m = np.linalg.norm(solved.residual_px, axis=-1) * depth_m / focal_px[:, None]
    medians = [float(np.median(m[np.isfinite(m)])) if np.isfinite(m).any() else np.nan for m in miss_m]
    return xyz, np.array(medians)
