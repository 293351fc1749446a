"""Several people: three virtual walkers who cross, for gonio and for Pose2Sim's own association, on the same sightings.

A person that is found is at each frame whoever of the walkers is nearest, hip to hip. One who changes from one walker to
another has been switched; one who is :data:`NOBODY_M` from everybody for most of the time, or where another found person is
already, is a ghost.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.peers import peer_python, run_in_peer
from gonio.bench.points.rivals import CARD, MIN_CONFIDENCE
from gonio.errors import GonioError
from gonio.formats.markerset import read_markerset
from gonio.formats.openpose import BODY_25B, gonio_names
from gonio.formats.osim import read_osim
from gonio.kernel.geometry.transforms import rotation_about_y, transform
from gonio.kernel.triangulation.people import find_people
from gonio.kernel.virtual_lab import PRESETS, make_rig, walk
from gonio.kernel.virtual_lab.company import Company, film_company
from gonio.records import Rig
from gonio.resources import models_dir

SEEDS, DURATION_S = 3, 3.0
NOBODY_M = 0.3
PATHS = ((0.0, -2.0), (2.1, -2.6), (4.2, -1.4))
"""Each walker's direction (rad about the vertical) and start (m before the middle, where all paths cross)."""

Centres = Float[np.ndarray, "frame 3"]


def measure_people(bench: Bench, build_dir: Path) -> None:
    """Measure found persons, switches and ghosts over all seeds, and the walkers' share of frames in which they are known."""
    rig = make_rig()
    body, card = read_osim(models_dir() / "bodies" / "fullbody_male.osim"), read_markerset(CARD)
    walks = [walk(body, 1.2, start_m=start_m) for _, start_m in PATHS]
    paths = [transform(rotation_about_y(angle), np.zeros(3)) for angle, _ in PATHS]
    companies = [
        film_company(walks, paths, rig, card, effects=PRESETS["occluded"], duration_s=DURATION_S, seed=seed)
        for seed in range(SEEDS)
    ]
    ours = [_find(rig, company) for company in companies]
    _add(bench, "gonio", companies, ours, none=0.0)
    try:
        theirs = [_run_pose2sim(build_dir, rig, company, seed) for seed, company in enumerate(companies)]
    except GonioError as error:
        bench.leave_out("people_*_pose2sim", error)
        return
    _add(bench, "pose2sim", companies, theirs)


def _add(
    bench: Bench, who: str, companies: Sequence[Company], found: Sequence[list[Centres]], none: float | None = None
) -> None:
    scores = np.array([_score(company, people) for company, people in zip(companies, found, strict=True)])
    bench.add(f"people_switches_{who}", float(scores[:, 0].sum()), "1", at_most=none)
    bench.add(f"people_ghosts_{who}", float(scores[:, 1].sum()), "1", at_most=none)
    bench.add(f"people_known_{who}_pct", 100 * float(scores[:, 2].mean()), "%")


def _score(company: Company, people: Sequence[Centres]) -> tuple[int, int, float]:
    """Count switches and ghosts, and give the share of the walkers' frames in which somebody found is with them."""
    hips = [company.sightings.keypoint_names.index(name) for name in ("left_hip", "right_hip")]
    truth = company.seen_lab_m[:, :, hips].mean(axis=2)
    known = np.zeros(truth.shape[:2], dtype=bool)
    switches = ghosts = 0
    for centres in sorted(people, key=lambda c: -np.isfinite(c[:, 0]).sum()):
        there = np.flatnonzero(np.isfinite(centres[:, 0]))
        away_m = np.linalg.norm((truth[:, there] - centres[there])[..., [0, 2]], axis=-1)
        who, near = away_m.argmin(axis=0), away_m.min(axis=0) < NOBODY_M
        if np.mean(near & ~known[who, there]) < 0.5:
            ghosts += 1
            continue
        switches += int((np.diff(who[near]) != 0).sum())
        known[who[near], there[near]] = True
    return switches, ghosts, float(known.mean())


def _find(rig: Rig, company: Company) -> list[Centres]:
    return [person.centre_lab_m for person in find_people(rig, company.sightings, MIN_CONFIDENCE)]


def _run_pose2sim(build_dir: Path, rig: Rig, company: Company, seed: int) -> list[Centres]:
    """Let Pose2Sim associate and triangulate, and give the middles of the persons' hips."""
    python = peer_python(build_dir, "pose2sim", "pose2sim==0.10.49")
    folder = (build_dir / "bench" / "people" / str(seed)).resolve()
    shutil.rmtree(folder, ignore_errors=True)  # of an earlier run
    folder.mkdir(parents=True)
    seen = company.sightings
    order = [seen.keypoint_names.index(name) for name in gonio_names(BODY_25B)]
    np.savez(
        folder / "trial.npz",
        keypoint_names=BODY_25B,
        uv_px=seen.uv_px[:, :, :, order],
        confidence=seen.confidence[:, :, :, order],
        rate_hz=seen.timebase.rate_hz,
        size_px=[camera.image_size_px for camera in rig.cameras],
        intrinsic_px=[camera.intrinsic_px for camera in rig.cameras],
        distortion=[camera.distortion for camera in rig.cameras],
        T_cam_lab=[np.linalg.inv(camera.T_lab_cam) for camera in rig.cameras],
    )
    run_in_peer(python, "pose2sim_people", folder / "trial.npz", folder / "pose2sim")
    found = np.load(folder / "pose2sim" / "people.npz")
    people: list[Centres] = []
    for number in range(int(found["people"])):
        names = gonio_names([str(name) for name in found[f"names_{number}"]])
        hips = found[f"xyz_{number}"][:, [names.index("left_hip"), names.index("right_hip")]].mean(axis=1)
        centres = np.full((seen.uv_px.shape[1], 3), np.nan)
        frames = found[f"frames_{number}"]
        centres[frames[frames < len(centres)]] = hips[frames < len(centres)]
        people.append(centres)
    return people
