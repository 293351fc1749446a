from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import CaptureError, GonioError, InputError
from gonio.formats.openpose import LAYOUTS, write_poses
from gonio.pipeline.capture import common_time, fit_camera_to_video, match_videos, read_capture, read_rig
from gonio.pipeline.folder import find_capture_files
from gonio.pipeline.keypoints import read_sightings
from gonio.pipeline.params import KeypointParameters, Parameters, parse_parameters, with_file_defaults
from gonio.pipeline.run import CaptureFile
from gonio.records import Rig
from gonio.vision.video import VideoInfo

MakeVideo = Callable[..., Path]

CAMERA = """<camera serial="{name}"><fov_video bottom="47" left="0" right="63" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="{x}" y="-4000" z="1500"/>
<intrinsic centerPointU="2048" centerPointV="1536" focalLengthU="6400" focalLengthV="6400" radialDistortion1="0"
 radialDistortion2="0"/></camera>"""


@pytest.fixture
def calibration(tmp_path: Path) -> CaptureFile:
    cameras = "".join(CAMERA.format(name=f"cam{i}", x=500 * i) for i in range(1, 5))
    path = tmp_path / "lab.qca.txt"
    path.write_text(f"<calibration><cameras>{cameras}</cameras></calibration>")
    return CaptureFile(path=path, name=path.name, role="calibration")


def video(path: Path, camera: str | None = None) -> CaptureFile:
    return CaptureFile(path=path, name=path.name, role="video", camera=camera)


def info(**change: object) -> VideoInfo:
    given: dict[str, object] = {
        "file_name": "cam1.mp4",
        "codec": "h264",
        "image_size_px": (1280, 720),
        "rotation_deg": 0,
        "frame_count": 100,
        "rate_hz": 60.0,
        "duration_s": 100 / 60,
        "is_variable_rate": False,
        "largest_deviation_s": 0.0,
    }
    return VideoInfo(**(given | change))  # type: ignore[arg-type]


def codes(found: tuple[object, ...]) -> list[str]:
    return [f.code for f in found]  # type: ignore[attr-defined]


def test_four_videos_for_four_cameras(calibration: CaptureFile, make_video: MakeVideo) -> None:
    files = [video(make_video(f"cam{i}.mp4")) for i in (3, 1, 4, 2)] + [calibration]
    rig = read_rig(files).value
    outcome = read_capture(files, rig)
    assert outcome.value.rig.names == ("cam1", "cam2", "cam3", "cam4")
    assert [v.file_name for v in outcome.value.views] == ["cam1.mp4", "cam2.mp4", "cam3.mp4", "cam4.mp4"]
    assert (outcome.value.frame_count, outcome.value.timebase.rate_hz) == (12, 30.0)
    assert outcome.findings == ()


def test_three_videos_for_four_cameras_work_with_a_finding(calibration: CaptureFile, make_video: MakeVideo) -> None:
    files = [video(make_video(f"cam{i}.mp4")) for i in (1, 2, 4)] + [calibration]
    outcome = read_capture(files, read_rig(files).value)
    assert outcome.value.rig.names == ("cam1", "cam2", "cam4")
    assert codes(outcome.findings) == ["camera-without-video"]
    assert "cam3" in outcome.findings[0].message


def test_different_lengths_use_the_common_part_with_a_finding(calibration: CaptureFile, make_video: MakeVideo) -> None:
    files = [video(make_video("cam1.mp4")), video(make_video("cam2.mp4", frames=9)), calibration]
    outcome = read_capture(files, read_rig(files).value)
    assert outcome.value.frame_count == 9
    assert "lengths-differ" in codes(outcome.findings)


def poses(path: Path, frames: int = 12) -> CaptureFile:
    write_poses(path, np.ones((frames, 17, 2)), np.ones((frames, 17)))
    return CaptureFile(path=path, name=path.name, role="keypoints")


def test_keypoints_of_another_program_stand_for_the_videos(calibration: CaptureFile, tmp_path: Path) -> None:
    files = [poses(tmp_path / f"cam{i}.zip", frames=10 + i) for i in (1, 2)] + [calibration]
    rig = read_rig(files).value
    outcome = read_capture(files, rig, 50.0)
    capture = outcome.value
    assert (capture.rig.names, capture.timebase.rate_hz, capture.frame_count) == (("cam1", "cam2"), 50.0, 11)
    assert [(v.path, v.poses) for v in capture.views] == [(None, tmp_path / f"cam{i}.zip") for i in (1, 2)]
    assert "lengths-differ" in codes(outcome.findings)
    with pytest.raises(InputError, match=r"rate of cam1\.zip is not known") as caught:
        read_capture(files, rig)
    assert caught.value.code == "poses-rate-missing"
    sightings = read_sightings(capture, KeypointParameters())  # 17 keypoints: COCO's
    assert sightings.keypoint_names == LAYOUTS["coco17"]
    assert sightings.uv_px.shape == (2, 11, 1, 17, 2)


def test_keypoints_take_the_rate_of_their_video_and_must_be_complete(
    calibration: CaptureFile, make_video: MakeVideo, tmp_path: Path
) -> None:
    files = [
        video(make_video("cam1.mp4")),
        video(make_video("cam2.mp4")),
        poses(tmp_path / "cam1.zip", 9),
        poses(tmp_path / "cam2.zip", 9),
        calibration,
    ]
    capture = read_capture(files, read_rig(files).value, 50.0).value
    assert (capture.timebase.rate_hz, capture.frame_count) == (30.0, 9)
    assert all(view.path and view.poses for view in capture.views)
    files.append(video(make_video("cam3.mp4")))
    with pytest.raises(InputError, match="keypoints of cam3 are missing") as caught:
        read_capture(files, read_rig(files).value)
    assert caught.value.code == "poses-incomplete"


def test_twenty_five_keypoints_must_be_named(calibration: CaptureFile, tmp_path: Path) -> None:
    files = [calibration]
    for i in (1, 2):
        write_poses(tmp_path / f"cam{i}.zip", np.ones((3, 25, 2)), np.ones((3, 25)))
        files.append(CaptureFile(path=tmp_path / f"cam{i}.zip", name=f"cam{i}.zip", role="keypoints"))
    capture = read_capture(files, read_rig(files).value, 50.0).value
    with pytest.raises(InputError, match="people of 25 keypoints") as caught:
        read_sightings(capture, KeypointParameters())
    assert caught.value.code == "poses-layout-unknown"
    assert read_sightings(capture, KeypointParameters(layout="body25b")).keypoint_names == LAYOUTS["body25b"]


def test_keypoint_files_lower_the_least_confidence_unless_the_request_names_one(tmp_path: Path) -> None:
    files = [poses(tmp_path / "cam1.zip")]
    for asked, least in (({}, 0.3), ({"reconstruction": {"min_confidence": 0.6}}, 0.6)):
        chosen = with_file_defaults(parse_parameters(asked), asked, files)
        assert chosen.reconstruction.min_confidence == least
    assert with_file_defaults(Parameters(), {}, []) == Parameters()


@pytest.mark.parametrize(("videos", "code"), [(0, "too-few-videos"), (1, "too-few-videos")])
def test_one_video_is_refused(calibration: CaptureFile, make_video: MakeVideo, videos: int, code: str) -> None:
    files = [video(make_video(f"cam{i + 1}.mp4")) for i in range(videos)] + [calibration]
    with pytest.raises(CaptureError) as caught:
        read_capture(files, read_rig(files).value)
    assert caught.value.code == code


def test_a_session_without_or_with_two_calibrations_is_refused(calibration: CaptureFile) -> None:
    with pytest.raises(InputError, match="no calibration"):
        read_rig([])
    with pytest.raises(InputError, match="2 calibrations"):
        read_rig([calibration, replace(calibration, name="other.qca.txt")])


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ([("walk.mp4", None)], "video-camera-unknown"),
        ([("walk.mp4", "cam9")], "video-camera-unknown"),
        ([("cam1.mp4", None), ("trial_cam1.mp4", None)], "video-camera-taken"),
        ([("cam1_cam2.mp4", None)], "video-camera-unknown"),
    ],
)
def test_a_video_of_no_or_a_taken_camera_is_named(rig: Rig, files: list[tuple[str, str | None]], code: str) -> None:
    with pytest.raises(InputError) as caught:
        match_videos([video(Path(name), camera) for name, camera in files], rig)
    assert caught.value.code == code
    assert files[-1][0] in caught.value.message
    assert code == "video-camera-taken" or "cam1, cam2, cam3, cam4" in caught.value.hint


def test_videos_are_matched_by_camera_by_name_or_by_part_of_the_name(rig: Rig) -> None:
    files = [video(Path("left.mp4"), "CAM2"), video(Path("Cam1.MP4")), video(Path("trial7_cam3_raw.mp4"))]
    matched = match_videos(files, rig)
    assert {camera: file.name for camera, file in matched.items()} == {
        "cam2": "left.mp4",
        "cam1": "Cam1.MP4",
        "cam3": "trial7_cam3_raw.mp4",
    }


def test_calibration_is_fitted_to_the_video(rig: Rig) -> None:
    camera = rig.cameras[0]
    assert fit_camera_to_video(camera, info()) == (camera, ())
    cut, findings = fit_camera_to_video(camera, info(image_size_px=(1272, 720)))
    assert codes(findings) == ["image-size-differs"]
    np.testing.assert_array_equal(cut.intrinsic_px, camera.intrinsic_px)
    half, findings = fit_camera_to_video(camera, info(image_size_px=(640, 360)))
    assert codes(findings) == ["image-size-scaled"]
    # The principal point (640, 360) counts from a pixel's centre: 640.5 from the edge, half of it is 320.25.
    np.testing.assert_allclose(half.intrinsic_px, [[500, 0, 319.75], [0, 500, 179.75], [0, 0, 1]])
    with pytest.raises(InputError, match="720 × 1280 pixels"):
        fit_camera_to_video(camera, info(image_size_px=(720, 1280)))


def test_a_camera_twice_as_fast_gives_every_second_frame() -> None:
    timebase, count, steps, findings = common_time(["a", "b"], [info(), info(rate_hz=119.98, frame_count=199)])
    assert (timebase.rate_hz, count, steps) == (60.0, 100, (1, 2))
    assert codes(findings) == ["rates-differ"]


def test_rates_that_are_no_multiples_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"cam1.mp4 60.000 Hz, b.mp4 50.000 Hz"):
        common_time(["a", "b"], [info(), info(rate_hz=50.0, file_name="b.mp4")])


def test_ntsc_rates_are_the_same_rate() -> None:
    _, _, steps, findings = common_time(["a", "b"], [info(), info(rate_hz=60000 / 1001)])
    assert steps == (1, 1)
    assert findings == ()


def test_a_file_that_is_no_video_is_named(calibration: CaptureFile, make_video: MakeVideo, tmp_path: Path) -> None:
    (tmp_path / "cam2.mp4").write_text("this is no video")
    files = [video(make_video("cam1.mp4")), video(tmp_path / "cam2.mp4"), calibration]
    with pytest.raises(GonioError) as caught:
        read_capture(files, read_rig(files).value)
    assert caught.value.code == "not-a-video"
    assert "cam2.mp4" in caught.value.message


def test_a_folder_is_searched(tmp_path: Path, calibration: CaptureFile, make_video: MakeVideo) -> None:
    (tmp_path / "videos").mkdir()
    make_video("videos/cam1.mp4")
    found = find_capture_files(tmp_path)
    assert [(f.name, f.role) for f in found] == [("lab.qca.txt", "calibration"), ("cam1.mp4", "video")]


def test_a_missing_or_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        find_capture_files(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no videos"):
        find_capture_files(tmp_path)
