"""The real networks on the real recording, where both are at hand."""

import json
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from gonio.vision.blazepose import LandmarkModel, PersonDetector, Region
from gonio.vision.model_cards import load_card
from gonio.vision.sessions import open_session
from gonio.vision.tracking import PersonTracker
from gonio.vision.video import iterate_frames, probe_video

CAMERAS = ["cam01", "cam02", "cam03", "cam04"]
NAMES = load_card("blazepose_heavy").keypoints.names  # type: ignore[union-attr]


@pytest.fixture(scope="module")
def detector(real_weights: Callable[[str], Path]) -> PersonDetector:
    name = "blazepose_detector"
    return PersonDetector(load_card(name), open_session(real_weights(name)))


@pytest.fixture(scope="module")
def heavy(real_weights: Callable[[str], Path]) -> LandmarkModel:
    name = "blazepose_heavy"
    return LandmarkModel(load_card(name), open_session(real_weights(name)))


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_recording(balancing: Path, camera: str) -> None:
    path = balancing / "videos" / f"{camera}.mp4"
    info = probe_video(path)
    assert (info.frame_count, info.rate_hz, info.is_variable_rate) == (100, 60.0, False)
    assert info.image_size_px == ((1080 if camera in ("cam01", "cam02") else 1088), 1920)
    assert sum(1 for _ in iterate_frames(path)) == 100


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_whole_chain_agrees_with_mediapipe(
    balancing: Path, detector: PersonDetector, heavy: LandmarkModel, camera: str
) -> None:
    """One pass from the detector's region, as MediaPipe does with single pictures.

    Decoders and warps differ in the last bit, and the network answers half a crop pixel with 2 px: 3 px in the median is
    what the issue asks, 1.3 to 2.2 was measured over ten frames a camera.
    """
    golden = json.loads(Path(__file__).with_name("mediapipe_balancing.json").read_text())["cameras"][camera]
    distances_px = []
    for frame in islice(iterate_frames(balancing / "videos" / f"{camera}.mp4"), 51):
        if str(frame.index) in golden:
            person = heavy.locate(frame, detector.detect(frame)[0].region)
            distances_px.append(np.linalg.norm(person.uv_px - golden[str(frame.index)], axis=1))
    assert len(distances_px) == len(golden) == 2
    assert np.median(distances_px) < 3.0
    assert np.max(distances_px) < 30.0


def test_follow_a_person(balancing: Path, detector: PersonDetector, heavy: LandmarkModel) -> None:
    """Every second frame of a second: nothing is lost and no point jumps, though each crop follows from the last."""
    tracker = PersonTracker(detector, heavy)
    tracks = []
    for frame in islice(iterate_frames(balancing / "videos" / "cam02.mp4"), 0, 60, 2):
        if tracker.region is None:
            (candidate,) = tracker.candidates(frame)
            tracker.start(candidate)
        person = tracker.follow(frame)
        assert person is not None
        assert person.presence > 0.95
        tracks.append(person.uv_px)
    hips = np.array(tracks)[:, [NAMES.index("left_hip"), NAMES.index("right_hip")]]
    # 2 m/s at about 500 px a metre and 30 Hz are 33 px; the hips of this trial are slower.
    assert np.linalg.norm(np.diff(hips, axis=0), axis=-1).max() < 33
    ankles = np.array(tracks)[:, [NAMES.index("left_ankle"), NAMES.index("right_ankle")]]
    assert (ankles[..., 1].mean() - hips[..., 1].mean()) > 200  # which way is down


def test_nobody_where_nobody_is(balancing: Path, detector: PersonDetector, heavy: LandmarkModel) -> None:
    """A crop of the ceiling: the tracker has to notice."""
    tracker = PersonTracker(detector, heavy)
    frame = next(iterate_frames(balancing / "videos" / "cam02.mp4"))
    tracker.start(Region(centre_px=np.array([900.0, 60.0]), side_px=250.0, rotation_rad=0.0))
    assert tracker.follow(frame) is None
    assert tracker.follow(frame) is None
    assert tracker.region is None
