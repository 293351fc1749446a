"""A trial whose calibration can't tell the lab takes it from the subject; delays that the calibration found are asked for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import apply, inverse, transform
from gonio.kernel.virtual_lab import make_rig
from gonio.pipeline.params import ReconstructionParameters
from gonio.pipeline.reconstruction import reconstruct, synchronize
from gonio.pipeline.trial_lab import find_trial_lab
from gonio.records import MEASURED, ImagePoints, LabPoints, Rig, Timebase

RATE_HZ = 60.0
NAMES = tuple(f"{side}_{joint}" for joint in ("heel", "hip", "shoulder") for side in ("left", "right"))
OVER = transform(Rotation.from_euler("xyz", [150, 20, -10], degrees=True).as_matrix(), np.array([0.4, -2.0, 3.0]))
"""A frame of somebody's first camera: Y is down, and more."""


def walking(seconds: float = 6.0, speed_m_s: float = 1.2) -> np.ndarray:
    """Heels, hips and shoulders, (frame, name, 3), of somebody who walks along +X, 16 cm between the feet."""
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    xyz = np.zeros((len(times_s), len(NAMES), 3))
    for foot, (side, phase) in enumerate(((-0.08, 0.0), (0.08, 0.5))):
        steps, share = np.divmod(times_s / 1.1 + phase, 1.0)
        swing = np.clip((share - 0.6) / 0.4, 0, 1)  # stands for six tenths of the cycle
        xyz[:, foot, 0] = speed_m_s * 1.1 * (steps + (1 - np.cos(np.pi * swing)) / 2 - phase)
        xyz[:, foot, 1] = 0.15 * np.sin(np.pi * swing)
        xyz[:, foot, 2] = side
    middle = speed_m_s * times_s
    for name, height, side in ((2, 0.9, -0.1), (3, 0.9, 0.1), (4, 1.4, -0.2), (5, 1.4, 0.2)):
        xyz[:, name] = np.stack([middle, np.full_like(middle, height), np.full_like(middle, side)], axis=-1)
    return xyz


def seen(xyz_lab_m: np.ndarray, noise_m: float = 0.008) -> LabPoints:
    noise = np.random.default_rng(0).normal(0, noise_m, xyz_lab_m.shape)
    frames, names = xyz_lab_m.shape[:2]
    return LabPoints(
        camera_names=("cam1", "cam2"), keypoint_names=NAMES, timebase=Timebase(rate_hz=RATE_HZ),
        xyz_lab_m=xyz_lab_m + noise, origin=np.full((frames, names), MEASURED, dtype=np.uint8),
        covariance_m2=np.broadcast_to(1e-4 * np.eye(3), (frames, names, 3, 3)).copy(),
        residual_px=np.zeros((2, frames, names, 2)),
    )  # fmt: skip


def turned(rig: Rig) -> Rig:
    return replace(rig, cameras=tuple(replace(c, T_lab_cam=inverse(OVER) @ c.T_lab_cam) for c in rig.cameras))


@pytest.mark.parametrize("source", ["cameras", None])
def test_a_walk_in_no_lab_at_all_stands_on_the_floor_and_goes_forward(source) -> None:
    truth = walking()
    points, rig, found = find_trial_lab(seen(apply(inverse(OVER), truth)), turned(make_rig(4)), 1, source, "auto")
    assert {f.code for f in found} == {"lab-contradicted", "lab-from-walker"}
    heels, shoulders = points.xyz_lab_m[:, :2], points.xyz_lab_m[:, 4:]
    # 11 contacts of 8 mm over 7 m and 16 cm: the person's posture holds the tilt across, ±5° at the worst.
    assert np.percentile(heels[..., 1], 10) == pytest.approx(0.0, abs=0.02)
    assert shoulders[..., 1].mean() == pytest.approx(1.4, abs=0.03)
    travel = shoulders[-1].mean(axis=0) - shoulders[0].mean(axis=0)
    assert travel[0] == pytest.approx(7.2, abs=0.1)
    assert np.abs(travel[1:]).max() < 0.25
    assert rig.cameras[0].centre_lab_m[1] == pytest.approx(make_rig(4).cameras[0].centre_lab_m[1], abs=0.25)
    assert heels[:, 1, 2].mean() > heels[:, 0, 2].mean()  # the right foot is on the right


def test_a_calibrated_lab_is_left_alone_and_a_guess_is_mended() -> None:
    truth = walking()
    rig = make_rig(4)
    for source, wanted in (("board", "auto"), (None, "auto"), ("cameras", "calibration")):
        points, same, found = find_trial_lab(seen(truth), rig, 1, source, wanted)
        assert found == ()
        assert same is rig
        np.testing.assert_array_equal(points.xyz_lab_m, seen(truth).xyz_lab_m)
    leaning = transform(Rotation.from_euler("z", 6, degrees=True).as_matrix(), np.array([0.0, 0.3, 0.0]))
    points, _, (finding,) = find_trial_lab(seen(apply(leaning, truth)), rig, 1, "cameras", "auto")
    assert finding.code == "lab-from-walker"
    assert np.ptp(points.xyz_lab_m[:, 4:, 1].mean(axis=1)) < 0.1  # uphill by 6° it was 0.75 m


def test_without_steps_the_posture_turns_over_and_a_guess_stays_one() -> None:
    still = np.repeat(walking()[:1], 200, axis=0)
    points, _, found = find_trial_lab(seen(apply(inverse(OVER), still)), turned(make_rig(4)), 1, None, "auto")
    assert [f.code for f in found] == ["lab-contradicted", "lab-from-posture"]
    assert (points.xyz_lab_m[:, 4:, 1] > 1.2).all()
    assert [f.code for f in find_trial_lab(seen(still), make_rig(4), 1, "cameras", "auto")[2]] == ["lab-walk-missing"]
    lying = apply(transform(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3)), still)
    assert find_trial_lab(seen(lying), make_rig(4), 1, "board", "auto")[2] == ()


def pictured(rig: Rig, xyz_lab_m: np.ndarray, late_frames: tuple[int, ...]) -> ImagePoints:
    uv_px = np.stack(
        [project(c, np.roll(xyz_lab_m, late, axis=0)) for c, late in zip(rig.cameras, late_frames, strict=True)]
    )
    return ImagePoints(
        camera_names=rig.names, keypoint_names=NAMES, timebase=Timebase(rate_hz=RATE_HZ), uv_px=uv_px,
        confidence=np.ones(uv_px.shape[:-1]),
    )  # fmt: skip


def test_delays_of_the_calibration_are_taken_where_two_cameras_bear_them_out() -> None:
    # Two cameras alone can't tell a delay from a wrong pose; that the calibration found one is asked of the movement.
    rig, truth = make_rig(2, radius_m=6.0), walking() - [3.6, 0.0, 0.0]
    late = pictured(rig, truth, (0, 6))
    outcome = synchronize(late, rig, ReconstructionParameters(), {"cam1": 0.0, "cam2": 0.1})
    (found, shifted), findings = outcome.value, outcome.findings
    assert found.status == "corrected"
    assert [(f.code, f.where, round(f.value or 0)) for f in findings] == [("delays-from-calibration", "cam2", 100)]
    middle = slice(30, -30)
    np.testing.assert_allclose(
        shifted.uv_px[1, middle], pictured(rig, truth, (0, 0)).uv_px[1, middle], atol=1e-6
    )  # whole frames only change the place
    same = pictured(rig, truth, (0, 0))
    outcome = synchronize(same, rig, ReconstructionParameters(), {"cam2": 0.1})
    (found, unshifted), findings = outcome.value, outcome.findings
    assert (found.status, [f.code for f in findings]) == ("unknown", ["synchronization-unknown"])
    assert unshifted is same
    hardware = ReconstructionParameters(synchronization="hardware")
    assert [f.code for f in synchronize(late, rig, hardware, {"cam2": 0.1}).findings] == ["delays-not-applied"]


def test_the_river_takes_the_lab_of_a_guessed_calibration_from_the_walk() -> None:
    rig, truth = make_rig(4, radius_m=6.0), walking() - [3.6, 0.0, 0.0]
    outcome = reconstruct(
        pictured(turned(rig), apply(inverse(OVER), truth), (0,) * 4), turned(rig), ReconstructionParameters()
    )
    assert {"lab-contradicted", "lab-from-walker"} <= {f.code for f in outcome.findings}
    assert np.nanmean(outcome.value.points.of("left_shoulder")[:, 1]) == pytest.approx(1.4, abs=0.03)
