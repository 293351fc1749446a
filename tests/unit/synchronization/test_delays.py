from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.synchronization.delays import estimate_delays
from gonio.kernel.synchronization.looks import shift
from gonio.records import ImagePoints, Rig, Timebase

RATE_HZ, FRAMES, KEYPOINTS = 60.0, 300, 17
BODY = np.random.default_rng(1).uniform([-0.2, 0.05, -0.25], [0.2, 1.75, 0.25], (KEYPOINTS, 3))


def walk(time_s: np.ndarray, moving: float = 1.0) -> np.ndarray:
    """A body that walks 0.5 m/s and swings its limbs once a second: (time, keypoint, 3)."""
    swing = 0.2 * np.sin(2 * np.pi * time_s[:, None, None] + 7 * BODY) * (1.8 - BODY[:, 1:2]) * [1.0, 0.3, 0.1]
    path = np.stack([0.5 * time_s - 1.2, 0.02 * np.sin(4 * np.pi * time_s), 0 * time_s], axis=-1)
    return BODY + moving * (swing + path[:, None])


def film(
    rig: Rig, delay_frames: list[float], *, moving: float = 1.0, noise_px: float = 3.0, frames: int = FRAMES
) -> ImagePoints:
    rng = np.random.default_rng(2)
    time_s = np.arange(frames) / RATE_HZ
    uv = np.stack(
        [project(c, walk(time_s - lag / RATE_HZ, moving)) for c, lag in zip(rig.cameras, delay_frames, strict=True)]
    )
    uv += rng.normal(0, noise_px, uv.shape)
    return ImagePoints(
        camera_names=rig.names,
        keypoint_names=tuple(f"k{i}" for i in range(KEYPOINTS)),
        timebase=Timebase(rate_hz=RATE_HZ),
        uv_px=uv,
        confidence=np.ones(uv.shape[:3]),
    )


def knocked(rig: Rig) -> Rig:
    """The third camera stands elsewhere than its calibration says: that alone must not look like a delay."""
    R = Rotation.from_rotvec([0.01, 0.012, 0.0]).as_matrix()
    T = rig.cameras[2].T_lab_cam @ transform(R, np.array([0.03, 0.0, 0.0]))
    return replace(rig, cameras=tuple(replace(c, T_lab_cam=T) if i == 2 else c for i, c in enumerate(rig.cameras)))


def test_synchronous_cameras_are_left_alone_even_where_the_calibration_has_drifted(rig: Rig) -> None:
    for truth in (rig, knocked(rig)):
        found = estimate_delays(rig, film(truth, [0, 0, 0, 0]), 0.5)
        assert found.status == "synchronous"
        assert not found.delay_s.any()


@pytest.mark.parametrize("delays", [[0, 7, 0, 0], [0, 1, -20, 3]])
def test_whole_frames_are_found_exactly(rig: Rig, delays: list[float]) -> None:
    found = estimate_delays(rig, film(knocked(rig), delays, frames=180), 0.5)
    assert found.status == "corrected"
    np.testing.assert_allclose(found.delay_s * RATE_HZ, delays, atol=1e-9)
    assert found.error_after_px < found.error_before_px


def test_half_frames_are_found_to_a_tenth(rig: Rig) -> None:
    delays = [0, 0.5, -3.5, 0.25]
    found = estimate_delays(rig, film(rig, delays, noise_px=2.0), 0.5)
    np.testing.assert_allclose(found.delay_s * RATE_HZ, delays, atol=0.1)


def test_a_motionless_subject_tells_nothing_and_that_is_said(rig: Rig) -> None:
    found = estimate_delays(rig, film(rig, [0, 5, 0, 0], moving=0.0), 0.5)
    assert found.status == "unknown"
    assert not found.delay_s.any()


def test_two_cameras_or_a_blink_tell_nothing(rig: Rig) -> None:
    filmed = film(rig, [0, 5, 0, 0])
    two = replace(rig, cameras=rig.cameras[:2])
    pair = replace(filmed, camera_names=two.names, uv_px=filmed.uv_px[:2], confidence=filmed.confidence[:2])
    assert estimate_delays(two, pair, 0.5).status == "unknown"
    blink = replace(filmed, uv_px=filmed.uv_px[:, :8], confidence=filmed.confidence[:, :8])
    assert estimate_delays(rig, blink, 0.5).status == "unknown"


def test_shifting_brings_the_cameras_together_and_invents_nothing(rig: Rig) -> None:
    delays = [0.0, 6.0, -2.5, 0.25]
    filmed = film(rig, delays, noise_px=0.0)
    gap = filmed.uv_px.copy()
    gap[1, 100, 3] = np.nan
    confidence = filmed.confidence.copy()
    confidence[1, 100, 3] = 0.0
    together = shift(replace(filmed, uv_px=gap, confidence=confidence), np.array(delays) / RATE_HZ)
    truth = film(rig, [0, 0, 0, 0], noise_px=0.0).uv_px
    inner = slice(10, -10)
    error = np.abs(together.uv_px - truth)[:, inner]
    # A straight line between frames misses a swing of 0.2 m at 1 Hz (200 px at 1 m) by a dt²/8: 200 · 39 / 3600 / 8 = 0.3 px.
    assert np.nanmax(error) < 0.4
    assert np.nanmax(error[1]) < 1e-9  # whole frames are exact
    assert np.isnan(together.uv_px[1, 94, 3]).all()
    assert np.isnan(together.uv_px[1, -6:]).all()
    assert np.isnan(together.uv_px[2, :2]).all()
    assert (together.confidence[np.isnan(together.uv_px[..., 0])] == 0).all()
