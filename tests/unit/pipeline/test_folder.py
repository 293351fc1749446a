"""Which files of a folder are recordings."""

import pytest

from gonio.pipeline.folder import find_capture_files


@pytest.mark.parametrize("output", ["gonio", "results/first"])
def test_a_second_analysis_does_not_take_the_first_ones_results_for_recordings(tmp_path, output):
    for name in ("cam1.mp4", "cam2.mp4", "calib.toml", "soles.csv"):
        (tmp_path / name).touch()
    first = find_capture_files(tmp_path)
    (tmp_path / output).mkdir(parents=True)
    for name in ("report.json", "angles.csv", "trial.c3d", "motion.mot", "model.osim", "camera1.webm"):
        (tmp_path / output / name).touch()
    assert find_capture_files(tmp_path) == first
    assert [file.role for file in first] == ["calibration", "video", "video", "pressure"]
