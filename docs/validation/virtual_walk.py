"""Draw docs/images/virtual-walk.png and print the table of docs/validation/virtual-lab.md: the walker against his lead.

Run ``python docs/validation/virtual_walk.py`` after a change of the walker.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

from gonio.compiled_cache import keep_compiled_code_apart

keep_compiled_code_apart()
mpl.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402 - after the choice of what draws

from gonio.formats.osim import read_osim  # noqa: E402 - the cache goes first
from gonio.kernel.body.forward import marker_positions  # noqa: E402 - the cache goes first
from gonio.kernel.body.soles import BALL, HEEL, mark_soles, measure_sole  # noqa: E402 - the cache goes first
from gonio.kernel.virtual_lab import Limp, grow, truth_at, walk  # noqa: E402 - the cache goes first
from gonio.kernel.virtual_lab.feet import directions, heels_on_floor  # noqa: E402 - the cache goes first
from gonio.kernel.virtual_lab.normal_gait import normal_gait  # noqa: E402 - the cache goes first
from gonio.kernel.virtual_lab.steps import pace_of  # noqa: E402 - the cache goes first
from gonio.kernel.virtual_lab.wanted import normal_phase  # noqa: E402 - the cache goes first
from gonio.records import Walk, WalkTruth  # noqa: E402 - the cache goes first
from gonio.resources import models_dir  # noqa: E402 - the cache goes first

CURVES = (
    ("hip flexion, °", "hip_flexion"),
    ("knee flexion, °", "knee_flexion"),
    ("ankle dorsiflexion, °", "ankle_dorsiflexion"),
    ("vertical force, BW", "vertical_force"),
    ("forward force, BW", "forward_force"),
    ("hip extension moment, Nm/kg", "hip_extension_moment"),
    ("knee extension moment, Nm/kg", "knee_extension_moment"),
    ("ankle plantarflexion moment, Nm/kg", "ankle_plantarflexion_moment"),
)
MOMENTS = {"hip_extension_moment": "hip_flexion_r", "knee_extension_moment": "knee_angle_r"} | {
    "ankle_plantarflexion_moment": "ankle_angle_r"
}
ANGLES = {"hip_flexion": "hip_flexion_r", "knee_flexion": "knee_angle_r", "ankle_dorsiflexion": "ankle_angle_r"}


def course(made: Walk, truth: WalkTruth, curve: str) -> np.ndarray:
    """Give the right leg's course of a published curve."""
    if curve in ANGLES:
        return np.rad2deg(truth.of(ANGLES[curve]))
    if curve in MOMENTS:
        return -truth.moment_of(MOMENTS[curve]) / made.body.mass_kg
    axis = {"vertical_force": 1, "forward_force": 0}[curve]
    return truth.wrench[:, 0, axis] / (made.body.mass_kg * 9.80665)


def slide_mm(made: Walk, truth: WalkTruth) -> float:
    """Give how far a foot that carries a tenth of the body moves along the floor."""
    phase = truth.times_s / made.steps.stride_s
    soles = marker_positions(mark_soles(made.body), truth.q).reshape(len(phase), 2, 4, 3)
    heels = heels_on_floor(made.steps, phase)
    heels[..., 0] += (made.start_m + made.steps.speed_m_s * truth.times_s)[:, None]
    most = 0.0
    for foot, turn in enumerate(directions(made.steps)):
        own = made.steps.phase(foot, phase)
        carries = truth.wrench[:, foot, 1] > 0.1 * made.body.mass_kg * 9.80665
        heel = (soles[:, foot, HEEL] - heels[:, foot])[carries & (own < made.steps.heel_off[foot])]
        ball = soles[:, foot, BALL] - heels[:, foot] - turn @ measure_sole(made.body).ball_m[foot]
        most = max(
            most, np.abs(heel[:, [0, 2]]).max(), np.abs(ball[carries & (own > made.steps.flat[foot])][:, [0, 2]]).max()
        )
    return 1000 * most


def main() -> None:
    """Draw and print."""
    man, woman = (read_osim(models_dir() / "bodies" / f"fullbody_{sex}.osim") for sex in ("male", "female"))
    walkers = {
        "man, 0.9 m/s": walk(man, 0.9),
        "man, 1.25 m/s": walk(man, 1.25),
        "man, 1.55 m/s": walk(man, 1.55),
        "woman of 1.55 m, 1.15 m/s": walk(grow(woman, 1.55, 52.0), 1.15),
        "man with a limp, 1.1 m/s": walk(man, 1.1, limp=Limp()),
    }
    lines = ["| walker | " + " | ".join(name.split(",")[0] for name, _ in CURVES) + " | friction | slide, mm |"]
    _, panels = plt.subplots(2, 4, figsize=(11, 5), layout="constrained")
    for walker, made in walkers.items():
        phase = np.arange(400) / 400
        truth = truth_at(made, (1.0 + phase) * made.steps.stride_s)
        gait = normal_gait(pace_of(made.body, made.steps.speed_m_s))
        own_phase, cells = normal_phase(made.steps, gait, 0, phase), []
        for (label, curve), panel in zip(CURVES, panels.flat, strict=True):
            own, published = course(made, truth, curve), gait.at(curve, own_phase)
            if curve == "hip_flexion":
                published = published - gait.at("anterior_pelvic_tilt", phase).mean()
            error = np.sqrt(np.mean((own - published) ** 2))
            cells.append(f"{np.corrcoef(own, published)[0, 1]:.3f}, {error:.2g}")
            if walker.startswith("man, "):
                colour = {"0": "#56b4e9", "1.2": "#000000", "1.5": "#d55e00"}[walker[5:8].rstrip("9.")]
                panel.plot(100 * phase, own, color=colour, lw=1.4, label=walker[5:])
                panel.plot(100 * phase, published, color=colour, lw=0.8, ls="--")
            panel.set_title(label, fontsize=9)
            panel.tick_params(labelsize=7)
        force = truth.wrench[..., :3][truth.wrench[..., 1] > 0]
        friction = (np.hypot(force[:, 0], force[:, 2]) / force[:, 1]).max()
        lines.append(f"| {walker} | " + " | ".join(cells) + f" | {friction:.2f} | {slide_mm(made, truth):.1f} |")
    panels[0, 0].legend(fontsize=7)
    plt.savefig(Path(__file__).parents[1] / "images" / "virtual-walk.png", dpi=80)
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
