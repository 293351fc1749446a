from collections.abc import Sequence

import numpy as np

from gonio.kernel.synchronization.looks import thin
from gonio.records import ImagePoints, Timebase


def seen(looked_at: Sequence[Sequence[int]], frames: int, stride: int) -> ImagePoints:
    """Two points that move by 4 px a frame, seen by each camera in its own frames."""
    uv = np.full((len(looked_at), frames, 2, 2), np.nan)
    confidence = np.zeros((len(looked_at), frames, 2))
    for camera, own in enumerate(looked_at):
        uv[camera, own] = 100.0 + 4.0 * np.array(own)[:, None, None]
        confidence[camera, own] = 0.8
    return ImagePoints(
        camera_names=tuple(f"cam{i}" for i in range(len(looked_at))),
        keypoint_names=("a", "b"),
        timebase=Timebase(rate_hz=60.0, start_s=0.5),
        uv_px=uv,
        confidence=confidence,
        stride=stride,
    )


def test_frames_between_are_left_out() -> None:
    found = thin(seen([range(60), range(60)], 60, 1), 4)
    assert (found.timebase.rate_hz, found.timebase.start_s) == (15.0, 0.5)
    np.testing.assert_array_equal(found.uv_px[0, :, 0, 0], 100.0 + 16.0 * np.arange(15))


def test_cameras_looked_at_in_turn_meet_in_the_same_frames() -> None:
    found = thin(seen([range(0, 90, 3), range(1, 90, 3), range(2, 90, 3)], 90, 3), 3)
    assert (found.confidence[:, 2:-2] > 0).all()
    np.testing.assert_allclose(found.uv_px[:, 4:-4, 0, 0] - 12.0 * np.arange(30)[4:-4], 100.0, atol=0.2)


def test_what_was_not_seen_is_not_made_up() -> None:
    found = thin(seen([[*range(20), *range(40, 60)]], 60, 1), 2)
    np.testing.assert_array_equal(np.flatnonzero(found.confidence[0, :, 0] == 0), np.arange(11, 20))
    assert np.isnan(found.uv_px[0, 11:20]).all()
