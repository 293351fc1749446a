"""Search for a part's motion: starts in waves, and a choice among the answers they lead to that wrong marks can't turn.

A wrong mark pulls every answer, and an answer with large errors everywhere can cost less than the right one with a few huge
ones. So each distinct answer throws out its own wrong marks first, and then they are compared by what they explain:
each freedom that is left (a mark's coordinate, less the unknowns it takes) is explained to the noise ``sigma`` instead of to
the scatter of the marks themselves, which is worth ``log(scatter / sigma)``. A mark that is thrown out is not explained.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gonio.kernel.articulated.bundle import Sights, adjust, whitened
from gonio.kernel.articulated.motion import Motions, unknowns
from gonio.kernel.articulated.observability import refuse
from gonio.kernel.articulated.small_sets import answers_of_sets
from gonio.kernel.articulated.starts import LOOSE, places, random_starts
from gonio.kernel.articulated.twins import twin_starts
from gonio.records import JointKind

WAVES = (12, 30, 30)
"""So many starts at first; more follow until two agree on an answer whose noise is plausible."""

SCREENED, KEPT = 8, 5
"""All starts get so many steps; so many of them are then followed to the end."""

SETTLED = 1e-4
"""A descent whose loss falls by less than this share is at its answer, as far as answers are told from each other."""

PLAUSIBLE = 1.3
"""An answer whose noise is beyond this multiple of the expected one may be a wrong one: 1.3 is 2.7 standard deviations of what
ten points in four pictures tell of their noise."""

BELIEVED = 0.8
"""An answer that throws out more than the rest of the marks may be a wrong one, too."""

ENOUGH = 2
"""So many sets of points whose answers explain the marks do."""

MIN_POINTS = 6
"""Fewer points can have several exact solutions."""

REJECT = 4.5
"""A mark that is off by more standard deviations is wrong: one good mark in 25 000 is."""

FINEST_PX = 1e-3
"""No mark is taken to be better than this: what stands on the floor would count for nothing beside it."""

RIVAL = 2.0
"""An answer whose loss, wrong marks and all, is beyond this multiple of the best is not looked at."""

TWIN = 1.2
"""A second answer whose loss is below this multiple of the best can't be told from it."""

TWIN_RAD = 0.1
"""Answers that differ by less than this turn in all pictures are the same."""


@dataclass(frozen=True)
class Answer:
    """One way to explain the marks; arrays have one start. ``sights`` holds the marks that it believes and their noise."""

    motions: Motions
    x_m: Float[np.ndarray, "1 point 3"]
    sights: Sights
    sigma_px: float
    freedom: int
    evidence: float


def search(kind: JointKind, sights: Sights, seed: int, part: str) -> tuple[Answer, Answer | None]:
    """Find the answer that explains most, and another one that explains nearly as much, if there is one.

    Raises:
        CaptureError: ``not-observable``: no start has all points before the cameras.
    """
    at_m = places(sights, kind, None)
    pool: list[tuple[Motions, np.ndarray, float]] = []
    answers: list[Answer] = []
    for wave, count in enumerate(WAVES):
        motions, x_m = random_starts(sights, kind, at_m, count, seed + wave)
        motions, x_m, cost = adjust(kind, sights, motions, x_m, iterations=SCREENED)
        best = np.argsort(cost)[: min(KEPT, np.isfinite(cost).sum())]
        if not len(best):
            continue
        motions, x_m, cost = adjust(kind, sights, motions.pick(best), x_m[best], iterations=80, settled=SETTLED)
        pool += [(motions.pick(np.array([s])), x_m[s : s + 1], float(cost[s])) for s in range(len(best))]
        answers, agreed = _answers(kind, sights, pool)
        if agreed and _explains(answers[0], sights, 1.0):
            break
        explaining = 0
        for few in answers_of_sets(kind, sights, at_m, seed + wave):
            answers.append(believe(kind, sights, *few))
            explaining += _explains(answers[-1], sights, BELIEVED)
            if explaining == ENOUGH:
                break
        answers.sort(key=lambda each: -each.evidence)
        if _explains(answers[0], sights, BELIEVED):
            break
    if not answers:
        raise refuse("not-observable", part)
    answers = _with_twins(kind, sights, answers)
    best, *others = answers
    near = best.evidence - 0.5 * best.freedom * np.log(TWIN)
    twins = [other for other in others if other.evidence > near and _apart(best.motions, other.motions)]
    return best, twins[0] if twins else None


def _answers(
    kind: JointKind, sights: Sights, pool: list[tuple[Motions, np.ndarray, float]]
) -> tuple[list[Answer], bool]:
    """Give the distinct answers of a pool, the best first, and whether the best was found more than once."""
    distinct: list[list[int]] = []
    for at in sorted(range(len(pool)), key=lambda at: pool[at][2]):
        for same in distinct:
            if not _apart(pool[same[0]][0], pool[at][0]):
                same.append(at)
                break
        else:
            distinct.append([at])
    lowest = pool[distinct[0][0]][2]
    first = believe(kind, sights, *pool[distinct[0][0]][:2])
    reach = TWIN if _explains(first, sights, 1.0) else RIVAL
    rivals = [same for same in distinct[1:] if pool[same[0]][2] < reach * lowest]
    found = [(first, len(distinct[0]))]
    found += [(believe(kind, sights, *pool[same[0]][:2]), len(same)) for same in rivals]
    found.sort(key=lambda each: -each[0].evidence)
    return [answer for answer, _ in found], found[0][1] > 1


def _with_twins(kind: JointKind, sights: Sights, answers: list[Answer]) -> list[Answer]:
    """Add what the twins of the best answer lead to, the best first."""
    best = answers[0]
    starts = twin_starts(kind, best.sights, best.motions, best.x_m) if kind in LOOSE else None
    if starts is None:
        return answers
    motions, x_m, cost = adjust(kind, best.sights, *starts, iterations=40)
    twins = [motions.pick(np.array([s])) for s in range(len(cost))]
    found = [
        believe(kind, sights, twin, x_m[s : s + 1])
        for s, twin in enumerate(twins)
        if np.isfinite(cost[s]) and _apart(best.motions, twin)
    ]
    return sorted(answers + found, key=lambda each: -each.evidence)


def _explains(answer: Answer, sights: Sights, share: float) -> bool:
    """Say whether the answer believes this share of all marks, with the noise that is expected of them."""
    whole = answer.sights.used.sum() >= share * sights.used.sum()
    return bool(whole and answer.sigma_px < PLAUSIBLE * sights.sigma_px)


def _apart(one: Motions, other: Motions) -> bool:
    relative = one.R[0] @ other.R[0].swapaxes(-1, -2)
    return bool(Rotation.from_matrix(relative).magnitude().max() > TWIN_RAD)


def believe(kind: JointKind, sights: Sights, motions: Motions, x_m: Float[np.ndarray, "1 point 3"]) -> Answer:
    """Throw out wrong marks until none is left, and tell the noise of the rest."""
    marked = sights.used
    for _ in range(6):
        r, _ = whitened(sights.with_noise(1.0), motions.moved(x_m))
        size = np.hypot(r[0, ..., 0], r[0, ..., 1])
        sigma = _noise(size[sights.used], kind, sights.used)
        r_all, _ = whitened(replace(sights, used=marked, sigma_px=sigma), motions.moved(x_m))
        believed = marked & (np.hypot(r_all[0, ..., 0], r_all[0, ..., 1]) < REJECT)
        believed &= (believed.sum(axis=0) >= 2) | (sights.floor & believed).any(axis=0)
        if believed.any(axis=0).sum() < MIN_POINTS:
            break
        same = (believed == sights.used).all()
        sights = replace(sights, used=believed, sigma_px=sigma)
        motions, x_m, _ = adjust(kind, sights, motions, x_m, iterations=60)
        if same:
            break
    r, _ = whitened(sights, motions.moved(x_m))
    freedom = max(1, 2 * sights.used.sum() - 3 * sights.used.any(axis=0).sum() - unknowns(kind, len(sights.used)))
    sigma = sights.sigma_px * float(np.sqrt((r[..., :2] ** 2).sum() / freedom))
    finest = max(sigma, FINEST_PX)
    evidence = freedom * float(np.log(_scatter(sights, marked) / finest))
    return Answer(motions, x_m, sights.with_noise(finest), sigma, int(freedom), evidence)


def _scatter(sights: Sights, marked: Bool[np.ndarray, "picture point"]) -> float:
    """Give how far a mark is from the middle of its picture's marks, rms of both coordinates, pixels."""
    uv = np.where(marked[..., None], sights.uv_px, np.nan)
    return max(float(np.sqrt(np.nanmean(np.nanvar(uv[marked.any(axis=1)], axis=1)))), FINEST_PX)


def _noise(size_px: Float[np.ndarray, " mark"], kind: JointKind, used: Bool[np.ndarray, "picture point"]) -> float:
    """Tell the noise from the median of the distances, Rayleigh distributed, and what the unknowns took of it."""
    count = 2 * used.sum()
    left = max(0.1, 1 - (3 * used.any(axis=0).sum() + unknowns(kind, len(used))) / count)
    return float(max(np.median(size_px) / 1.1774 / np.sqrt(left), 1e-7))
