"""The fit to the pixels against the truth: a walker hidden by his own limbs, seen by a network that errs, unlike his model."""

import numpy as np
import pytest

from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.kinematics import pixels
from gonio.kernel.kinematics.clinical import clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.kernel.virtual_lab import PRESETS, film, grow, make_rig, walk
from gonio.pipeline.body import scale_to_subject
from gonio.pipeline.motion import BodyMotion, fit_motion
from gonio.pipeline.params import Parameters, Subject
from gonio.pipeline.reconstruction import hold_lengths, reconstruct, refine_cameras, smooth
from gonio.pipeline.run import Progress
from gonio.records import Motion, VirtualTrial
from gonio.resources import models_dir


@pytest.fixture(scope="module")
def solved() -> list[tuple[VirtualTrial, BodyMotion]]:
    generic = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    card = read_markerset(models_dir() / "markersets" / "halpe26.toml")
    trials = []
    for seed, (stature_m, mass_kg, speed_m_s) in enumerate(((1.75, 72.0, 1.2), (1.62, 60.0, 1.0), (1.85, 90.0, 1.4))):
        walker = walk(grow(generic, stature_m=stature_m, mass_kg=mass_kg), speed_m_s, start_m=-1.5)
        trial = film(walker, make_rig(), card, effects=PRESETS["mismatch"], rate_hz=60.0, seed=seed)
        trials.append((trial, solve(trial)))
    return trials


def solve(trial: VirtualTrial, on_progress: Progress | None = None) -> BodyMotion:
    chosen = Parameters()
    rig = refine_cameras(trial.points, trial.rig, chosen.reconstruction).value.rig
    raw = reconstruct(trial.points, rig, chosen.reconstruction).value
    points = hold_lengths(smooth(trial.points, raw, chosen.reconstruction).value, chosen.reconstruction)
    body = scale_to_subject(points, Subject(sex="male", mass_kg=trial.walk.body.mass_kg)).value
    return fit_motion(body, points, trial.points, raw.rig, chosen, on_progress).value


def errors_deg(name: str, trial: VirtualTrial, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Errors (side, frame) of an angle, and how far its 95 % band reaches."""
    angles = [angle for angle in find_clinical_angles(trial.walk.body) if angle.name == name]
    truth = np.array([angle.sign * np.degrees(trial.truth.of(angle.coordinate)) for angle in angles])
    found = np.array([clinical_deg(motion, angle) for angle in angles])
    return found - truth, 1.96 * np.array([clinical_sd_deg(motion, angle) for angle in angles])


@pytest.mark.parametrize(
    ("name", "most_deg"), [("knee_flexion", 2.5), ("hip_flexion", 3.5), ("ankle_dorsiflexion", 4.5)]
)
def test_curves_are_nearer_to_the_truth_than_frame_by_frame(
    solved: list[tuple[VirtualTrial, BodyMotion]], name: str, most_deg: float
) -> None:
    rms = {True: [], False: []}
    for trial, found in solved:
        assert found.fit is not None
        assert not found.distrusted
        for fitted, motion in ((True, found.motion), (False, found.two_step)):
            error, _ = errors_deg(name, trial, motion)
            rms[fitted] += list((error - error.mean(axis=1, keepdims=True)).std(axis=1))
    assert np.median(rms[True]) < most_deg
    assert np.median(rms[True]) < np.median(rms[False])


@pytest.mark.parametrize("name", ["knee_flexion", "ankle_dorsiflexion"])
def test_error_bars_contain_the_truth(solved: list[tuple[VirtualTrial, BodyMotion]], name: str) -> None:
    inside = []
    for trial, found in solved:
        error, reach = errors_deg(name, trial, found.motion)
        inside.append(np.mean(np.abs(error) < reach))
    assert 0.85 < np.mean(inside) < 0.995


def test_the_pelvis_stays_where_its_geometry_puts_it(solved: list[tuple[VirtualTrial, BodyMotion]]) -> None:
    for trial, found in solved:
        tilt = np.degrees(found.motion.of("pelvis_tilt") - trial.truth.of("pelvis_tilt"))
        assert abs(tilt.mean()) < 8.0


def test_a_long_trial_is_solved_in_windows_and_nobody_sees_the_seams(
    solved: list[tuple[VirtualTrial, BodyMotion]], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, whole = solved[0]
    monkeypatch.setattr(pixels, "MOST_SHARED_FRAMES", 50)
    monkeypatch.setattr(pixels, "WINDOW_FRAMES", 25)
    monkeypatch.setattr(pixels, "OVERLAP_FRAMES", 10)
    shares: list[float] = []
    parted = solve(trial, shares.append)
    assert not parted.distrusted
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] <= 1.0
    for angle in find_clinical_angles(whole.model):
        one, other = clinical_deg(whole.motion, angle), clinical_deg(parted.motion, angle)
        assert (np.abs(one - other) < 1.96 * clinical_sd_deg(whole.motion, angle)).mean() > 0.97
        assert np.abs(np.diff(other - one)).max() < 1.0
