"""The joint solver on virtual versions of the paper's five bodies, beside the paper's own method.

Four pictures of one moving, zooming camera, no initial guess. A joint is a success if each of its pictures is within three
predicted standard deviations of the truth, or within 2°, whichever is more; a parent's failure is its child's too. The paper's
method, which predicts none and is less exact, is allowed 4°, and is given the parents' true motion. The tables
of quaternion dot products, length_1 and length_2 are those of the paper: how far turn and displacement are from the truth.
``GONIO_BENCH_SEEDS`` sets the number of bodies (200 without it).
"""

import os
import time
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.bench import Bench
from gonio.errors import GonioError
from gonio.kernel.articulated.chain import sights_of, solve_body
from gonio.kernel.articulated.paper import solve_paper
from gonio.kernel.virtual_lab.articulated import BODIES, VirtualBody, virtual_body
from gonio.records import JointMotion

SUCCESS_DEG = 2.0
PAPER_TURN_RAD, LARGE_TURN_RAD = (0.17, 1.05), (2.08, 2.97)


def measure_bodies(bench: Bench) -> None:
    """Add the metrics of the joint solver on bodies that are marks alone."""
    seeds = int(os.environ.get("GONIO_BENCH_SEEDS", "200"))
    bench.explain(__doc__)
    bench.notes.append(f"{seeds} bodies of each kind.")
    few = max(1, seeds // 4)
    _measure(bench, "0.3px", seeds, {"noise_px": 0.3}, at_least=99.5, paper=True)
    _measure(bench, "1px", seeds, {"noise_px": 1.0}, at_least=97.0)
    _measure(bench, "170deg", few, {"noise_px": 0.3, "turn_rad": LARGE_TURN_RAD}, at_least=97.0)
    _measure(bench, "outliers", few, {"noise_px": 0.5, "wrong": 0.08}, at_least=95.0)


def _measure(
    bench: Bench, name: str, seeds: int, options: dict[str, Any], *, at_least: float, paper: bool = False
) -> None:
    successes: list[bool] = []
    paper_successes: list[bool] = []
    seconds: list[float] = []
    paper_seconds: list[float] = []
    squares: list[float] = []
    table: dict[str, list[list[float]]] = {}
    for shapes in BODIES.values():
        for seed in range(seeds):
            body = virtual_body(shapes, seed, **options)
            begun = time.process_time()
            try:
                motions = solve_body(body.cameras, body.parts, body.floor)
            except GonioError:
                successes += [False] * len(shapes)
                continue
            seconds.append((time.process_time() - begun) / len(shapes))
            for motion in motions:
                errors = errors_of(body, motion)
                successes.append(bool(errors[0] < max(SUCCESS_DEG, 3 * np.degrees(motion.rotation_sd_rad.max()))))
                squares += _squares(body, motion)
                table.setdefault(motion.part, []).append(errors)
            if paper:
                begun = time.process_time()
                paper_successes += _paper(body)
                paper_seconds.append((time.process_time() - begun) / len(shapes))
    bench.add(f"success_pct_{name}", 100 * float(np.mean(successes)), "%", at_least=at_least)
    every_turn = [errors[1] for rows in table.values() for errors in rows]
    bench.add(f"median_rotation_deg_{name}", float(np.median(every_turn)), "deg")
    # Robust: the median of chi-squares of three freedoms is 2.366; the ratio of predicted to actual deviation.
    ratio = np.sqrt(2.366 / np.median(squares))
    suffix = "" if paper else f"_{name}"
    bench.add(f"normalised_sd_ratio{suffix}", ratio, "1", at_least=0.8, at_most=1.25)
    _add_table(bench, name, table)
    bench.add(f"median_joint_ms{suffix}", 1e3 * np.median(seconds), "ms")
    if paper:
        bench.add("success_pct_paper", 100 * float(np.mean(paper_successes)), "%")
        bench.add("time_ratio_paper", np.median(paper_seconds) / np.median(seconds), "1")


def _add_table(bench: Bench, name: str, table: dict[str, list[list[float]]]) -> None:
    for part, rows in table.items():
        _, turn, dot, length_1, length_2 = np.median(np.array(rows), axis=0)
        at = f"{part.replace(' ', '_')}_{name}"
        bench.add(f"turn_{at}", turn, "deg")
        bench.add(f"dot_below_1_{at}", 1e6 * (1 - dot), "1e-6")
        bench.add(f"length_1_{at}", 1e3 * length_1, "mm")
        bench.add(f"length_2_{at}", 1e3 * length_2, "mm")


def errors_of(body: VirtualBody, motion: JointMotion) -> list[float]:
    """Give the worst and the mean turn error (degrees), the mean dot product, and length_1 and length_2 of the worst picture.

    Lengths are of the displacement of the part's middle, because a translation alone depends on where the origin is.
    """
    truth, found = body.Ts_parent_part[motion.part], motion.Ts_parent_part
    turn = _turn_deg(found[:, :3, :3], truth[:, :3, :3])
    middle = np.append(body.xyz_m[motion.part].mean(axis=0), 1.0)
    there, here = ((T @ middle)[:, :3] - middle[:3] for T in (truth, found))
    length_1 = np.abs(np.linalg.norm(there, axis=1) - np.linalg.norm(here, axis=1)).max()
    length_2 = np.linalg.norm(there - here, axis=1).max()
    return [turn.max(), turn[1:].mean(), np.cos(np.radians(turn[1:]) / 2).mean(), length_1, length_2]


def _turn_deg(
    found: Float[np.ndarray, "picture 3 3"], truth: Float[np.ndarray, "picture 3 3"]
) -> Float[np.ndarray, " picture"]:
    return np.degrees(Rotation.from_matrix(found @ truth.swapaxes(1, 2)).magnitude())


def _squares(body: VirtualBody, motion: JointMotion) -> list[float]:
    """Give the chi-squares of the world turns of joints whose turns have all three freedoms."""
    if motion.kind not in ("free", "spherical"):
        return []
    truth, found = body.Ts_parent_part[motion.part][1:, :3, :3], motion.Ts_parent_part[1:, :3, :3]
    error = Rotation.from_matrix(found @ truth.swapaxes(1, 2)).as_rotvec()
    pictures = len(body.cameras)
    block = motion.twist_covariance.reshape(pictures, 6, pictures, 6)
    return [float(e @ np.linalg.solve(block[i, :3, i, :3], e)) for i, e in enumerate(error, start=1)]


def _paper(body: VirtualBody) -> list[bool]:
    """Solve a body by the paper's method, each joint with its parent's true motion: it is the single joint that is judged."""
    successes: list[bool] = []
    for part in body.parts:
        Gs = body.Ts_world_part[part.parent] if part.parent else np.tile(np.eye(4), (len(body.cameras), 1, 1))
        sights, _ = sights_of(part, body.cameras, Gs, body.floor, 0, 1.0)
        rotation, _ = solve_paper(part.kind, sights)
        turn = _turn_deg(rotation, body.Ts_parent_part[part.name][:, :3, :3])
        successes.append(bool(turn.max() < 2 * SUCCESS_DEG))
    return successes
