"""What a page gets to show the trial: the numbers are where the header says, and they are the analysis' own."""

import json
from pathlib import Path

import av
import numpy as np
import pytest

from gonio.demo.virtual import RATE_HZ, film_walk, write_session, write_videos
from gonio.kernel.geometry.cameras import project
from gonio.pipeline import analyse
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.run import LocalRunner
from gonio.pipeline.viewer import SKELETON, skeleton_of
from gonio.records import Camera

SECONDS = 0.7


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    trial = film_walk(SECONDS)
    write_session(trial, folder / "session")
    write_videos(trial, folder / "session")
    analyse(find_capture_files(folder / "session"), {"subject": {"mass_kg": 61.0}}, LocalRunner(), folder / "report")
    return folder / "report"


@pytest.fixture
def header(written: Path) -> dict:
    return json.loads((written / "viewer.json").read_text())


@pytest.fixture
def arrays(written: Path, header: dict) -> dict[str, np.ndarray]:
    numbers = np.frombuffer((written / "viewer.f32").read_bytes(), dtype="<f4")
    found = {}
    for name, where in header["arrays"].items():
        count = int(np.prod(where["shape"]))
        found[name] = numbers[where["offset"] : where["offset"] + count].reshape(where["shape"])
    assert sum(array.size for array in found.values()) == len(numbers)
    return found


def test_points_and_body_project_onto_what_the_cameras_saw(header: dict, arrays: dict[str, np.ndarray]) -> None:
    knee = header["keypoints"].index("right_knee")
    marker = header["markers"].index("right_knee")
    assert header["frames"] == len(arrays["points"]) == round(SECONDS * RATE_HZ)
    for index, view in enumerate(header["cameras"]):
        camera = Camera(
            name=view["name"],
            image_size_px=(view["width_px"], view["height_px"]),
            intrinsic_px=np.array(view["intrinsic_px"]),
            distortion=np.array(view["distortion"]),
            T_lab_cam=np.linalg.inv(np.array(view["T_cam_lab"])),
        )
        # Some pixels of noise, and outliers beyond the median: a wrong axis or frame would be off by a hundred.
        for xyz in (arrays["points"][:, knee], arrays["markers"][:, marker]):
            away = np.linalg.norm(project(camera, xyz.astype(float)) - arrays["observed"][index, :, knee], axis=-1)
            assert np.nanmedian(away) < 6.0, view["name"]
    assert 0.001 < np.nanmedian(arrays["point_sd"][:, knee]) < 0.05


def test_previews_have_a_picture_for_each_look_and_report_which_camera(written: Path, header: dict) -> None:
    for view in header["cameras"]:
        with av.open(str(written / "pictures" / view["preview"])) as video:
            stream = video.streams.video[0]
            frames = list(video.decode(stream))
        assert (stream.codec_context.name, float(stream.average_rate)) == ("vp8", 30.0)
        # Every second frame, and the last one.
        assert len(frames) == round(SECONDS * RATE_HZ) // 2 + 1
        assert max(stream.width, stream.height) <= 640
        assert frames[0].to_ndarray(format="gray").std() > 5


def test_lines_are_drawn_between_keypoints_that_are_there() -> None:
    assert skeleton_of(("right_hip", "right_knee", "nose")) == (("right_hip", "right_knee"),)
    assert len(set(SKELETON)) == len(SKELETON)
