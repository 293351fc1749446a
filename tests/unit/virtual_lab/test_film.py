"""Filmed keypoints: exact without effects, and each effect as it is stated."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.markerset import read_markerset
from gonio.kernel.geometry.cameras import project
from gonio.kernel.virtual_lab import PRESETS, Bursts, Clocks, Detector, Effects, SelfOcclusion, Swaps, film, make_rig
from gonio.kernel.virtual_lab.keypoints import read_anatomy
from gonio.records import BURST, DROPPED, HIDDEN, OUTSIDE, PULLED, SWAPPED
from gonio.resources import models_dir


def errors(trial):
    return trial.points.uv_px - trial.exact_px


def test_without_effects_keypoints_are_exact_projections(walker, ring, halpe26):
    trial = film(walker, ring, halpe26, effects=PRESETS["clean"])
    exact = np.stack([project(camera, trial.xyz_lab_m) for camera in trial.rig.cameras])
    inside = trial.cause == 0
    assert inside.mean() > 0.99
    np.testing.assert_array_equal(trial.points.uv_px[inside], exact[inside])
    assert np.all(trial.points.confidence[inside] == 1.0)
    np.testing.assert_array_equal(trial.seen_lab_m, trial.xyz_lab_m)
    assert trial.timebase.rate_hz == 120.0
    assert len(trial.truth.times_s) == trial.points.uv_px.shape[1] == round(3.6 / 1.25 * 120)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_same_seed_gives_the_same_recording_and_another_one_does_not(walker, ring, halpe26, preset):
    first, again, other = (film(walker, ring, halpe26, effects=PRESETS[preset], seed=s) for s in (4, 4, 5))
    np.testing.assert_array_equal(first.points.uv_px, again.points.uv_px)
    np.testing.assert_array_equal(first.points.confidence, again.points.confidence)
    assert preset == "clean" or not np.array_equal(first.points.uv_px, other.points.uv_px, equal_nan=True)
    assert np.all((first.points.confidence == 0) == np.isnan(first.points.uv_px).any(axis=-1))


@pytest.mark.parametrize("effect", ["bursts", "swaps", "occlusion", "dropouts"])
def test_switching_an_effect_off_changes_nothing_else(walker, ring, halpe26, effect):
    everything = replace(PRESETS["occluded"], clocks=Clocks(delay_s=0.01))
    without = replace(everything, **{effect: 0.0 if effect == "dropouts" else None})
    full, less = (film(walker, ring, halpe26, effects=e, seed=2) for e in (everything, without))
    cause = {"bursts": BURST, "swaps": SWAPPED, "occlusion": HIDDEN | PULLED, "dropouts": DROPPED}[effect]
    # A swapped keypoint carries its counterpart's errors; neither one may have been touched.
    touched = (full.cause | full.cause[:, :, read_anatomy(halpe26).counterpart]) & cause != 0
    assert 0.005 < touched.mean() < 0.5
    np.testing.assert_array_equal(full.points.uv_px[~touched], less.points.uv_px[~touched])
    np.testing.assert_array_equal(full.points.confidence[~touched], less.points.confidence[~touched])


def test_one_more_camera_changes_nothing_about_the_others(walker, ring, halpe26):
    fewer = replace(ring, cameras=ring.cameras[:3])
    full, less = (film(walker, r, halpe26, effects=PRESETS["mismatch"], seed=2) for r in (ring, fewer))
    np.testing.assert_array_equal(full.points.uv_px[:3], less.points.uv_px)


def test_a_late_camera_shows_a_later_moment(walker, ring, halpe26):
    effects = Effects(clocks=Clocks(delay_s=0.05, drift=1e-3))
    trial = film(walker, ring, halpe26, effects=effects, seed=1)
    late_s = trial.camera_times_s - trial.truth.times_s
    assert np.all(late_s[0] == 0)
    # To first order the exact points are displaced by velocity times delay; the ankle at 4 m/s and 100 px/m moves 20 px.
    still = film(walker, ring, halpe26, effects=Effects())
    velocity = np.gradient(still.exact_px, 1 / 120, axis=1)
    for camera in range(1, 4):
        moved = trial.exact_px[camera] - still.exact_px[camera]
        expected = velocity[camera] * late_s[camera][:, None, None]
        assert np.abs(expected).max() > 1.0
        assert np.abs(moved - expected).max() < 0.35 * np.abs(expected).max()


def test_scatter_grows_as_confidence_falls_and_dies_away_in_time(walker, ring, halpe26):
    detector = Detector(sigma_m=0.01, bias_m=0.0)
    trials = [film(walker, ring, halpe26, effects=Effects(detector=detector), seed=s) for s in range(4)]
    depth = np.stack([(trials[0].xyz_lab_m - c.centre_lab_m) @ c.T_lab_cam[:3, 2] for c in ring.cameras])
    at_person_m = np.stack([errors(t) for t in trials]) * (depth / 520.0)[..., None]
    confidence = np.stack([t.points.confidence for t in trials])
    # Four recordings of 2.9 s, 26 keypoints, 4 cameras: 20 000 independent errors or so, known to 1 %.
    for low, high in ((0.45, 0.55), (0.6, 0.7)):
        chosen = (confidence > low) & (confidence < high)
        assert np.nanstd(at_person_m[chosen]) == pytest.approx(0.01 * 0.65 / ((low + high) / 2), rel=0.05)
    scaled = at_person_m * np.maximum(confidence, 0.2)[..., None]
    lag = round(0.105 * 120)
    correlation = np.nanmean(scaled[:, :, lag:] * scaled[:, :, :-lag]) / np.nanmean(scaled**2)
    assert correlation == pytest.approx(0.76 * np.exp(-lag / 120 / 0.105), abs=0.03)


def test_bias_is_constant_for_each_camera_and_keypoint(walker, ring, halpe26):
    effects = Effects(detector=Detector(sigma_m=0.0, bias_m=0.008))
    trial = film(walker, ring, halpe26, effects=effects)
    depth = np.stack([(trial.xyz_lab_m - c.centre_lab_m) @ c.T_lab_cam[:3, 2] for c in ring.cameras])
    at_person_m = errors(trial) * (depth / 520.0)[..., None]
    assert np.nanstd(at_person_m, axis=1).max() < 1e-9
    assert np.nanstd(np.nanmean(at_person_m, axis=1)) == pytest.approx(0.008, rel=0.25)  # 208 draws: 5 %


def test_bursts_are_as_the_comparison_of_triangulators_has_them(walker, halpe26):
    """In the balancing recording's geometry: 13 % of the observations, 40 to 150 px, 40 % of them confident."""
    rig = make_rig(4, radius_m=4.0, height_m=0.9, image_size_px=(1920, 1920), focal_px=1680.0)
    effects = Effects(bursts=Bursts())
    trials = [film(walker, rig, halpe26, effects=effects, rate_hz=60.0, seed=s) for s in range(3)]
    for trial in trials:
        burst = (trial.cause & BURST != 0) & (trial.cause & OUTSIDE == 0)
        away = np.linalg.norm(errors(trial), axis=-1)
        assert np.all(away[~burst & (trial.cause == 0)] == 0)
    share = np.mean([(t.cause & BURST != 0).mean() for t in trials])
    assert share == pytest.approx(0.13, abs=0.02)  # 312 sequences of 173 frames: some 500 bursts, 4 %
    burst = np.stack([(t.cause & BURST != 0) & (t.cause & OUTSIDE == 0) for t in trials])
    away = np.linalg.norm(np.stack([errors(t) for t in trials]), axis=-1)[burst]
    # 4 m away at the middle of the lab; the walker is up to 1.8 m nearer or farther.
    assert 40 * 4 / 6 < np.quantile(away, 0.01) < np.quantile(away, 0.99) < 150 * 4 / 2
    assert 80 < np.median(away) < 110
    confident = np.stack([t.points.confidence for t in trials])[burst] == 1.0
    assert confident.mean() == pytest.approx(0.4, abs=0.08)


def test_swaps_exchange_the_legs(walker, ring, halpe26):
    trial = film(walker, ring, halpe26, effects=Effects(swaps=Swaps(share=0.1)))
    anatomy = read_anatomy(halpe26)
    swapped = trial.cause & SWAPPED != 0
    frames = swapped.any(axis=-1)
    assert frames.mean() == pytest.approx(0.1, abs=0.06)
    np.testing.assert_array_equal(swapped, frames[..., None] & anatomy.of_leg)
    exact = trial.exact_px[:, :, anatomy.counterpart]
    np.testing.assert_array_equal(trial.points.uv_px[swapped], exact[swapped])


def test_hidden_keypoints_are_less_sure_and_drawn_to_the_near_limb(walker, ring, halpe26):
    trial = film(walker, ring, halpe26, effects=Effects(occlusion=SelfOcclusion(pulled=0.5)))
    hidden, pulled = trial.cause & HIDDEN != 0, trial.cause & PULLED != 0
    assert 0.1 < hidden.mean() < 0.3
    assert np.all(hidden[pulled])
    np.testing.assert_allclose(trial.points.confidence[hidden & ~pulled], 0.6)
    np.testing.assert_allclose(trial.points.confidence[pulled], 0.36)
    anatomy = read_anatomy(halpe26)
    way = trial.exact_px[:, :, anatomy.counterpart] - trial.exact_px
    length = np.linalg.norm(way, axis=-1)
    share = (errors(trial) * way).sum(axis=-1)[pulled & (length > 1)] / length[pulled & (length > 1)] ** 2
    assert 0.4 - 1e-9 <= share.min() < 0.5 < 0.9 < share.max() <= 1.0 + 1e-9
    middle = anatomy.counterpart == np.arange(len(anatomy.counterpart))
    assert not pulled[:, :, middle].any()


def test_a_person_who_is_not_the_model_has_keypoints_elsewhere_by_millimetres(walker, ring, halpe26):
    trial = film(walker, ring, halpe26, effects=PRESETS["mismatch"])
    away_mm = 1000 * np.linalg.norm(trial.seen_lab_m - trial.xyz_lab_m, axis=-1)
    by_name = dict(zip(halpe26.keypoint_names, away_mm.T, strict=True))
    assert 10 < by_name["right_hip"].max() < 25
    assert 10 < by_name["left_knee"].max() < 14
    assert 3 < by_name["head"].max() < 12
    # The tilted axis leads the shank of 0.43 m sideways by up to sin 3° · sin 60° · 0.43 m = 20 mm in swing.
    assert 10 < by_name["left_ankle"].max() < 30
    assert not np.array_equal(trial.rig.cameras[0].T_lab_cam, trial.rig_true.cameras[0].T_lab_cam)


@pytest.mark.parametrize("card", ["blazepose33", "body25b", "coco17"])
def test_any_marker_set_can_be_filmed(walker, ring, card):
    markerset = read_markerset(models_dir() / "markersets" / f"{card}.toml")
    trial = film(walker, ring, markerset, effects=PRESETS["occluded"], rate_hz=30.0)
    assert trial.points.keypoint_names == markerset.keypoint_names
    anatomy = read_anatomy(markerset)
    names = [name.lower() for name in markerset.keypoint_names]
    for row, other in enumerate(anatomy.counterpart):
        sided = "left" in names[row] or "right" in names[row]
        if sided:
            swapped = names[row].replace("left", "?").replace("right", "left").replace("?", "right")
            assert names[other] == swapped


def test_a_recording_needs_two_frames(walker, ring, halpe26):
    with pytest.raises(InputError, match="no two frames"):
        film(walker, ring, halpe26, duration_s=0.0)
