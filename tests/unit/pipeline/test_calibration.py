"""The river of a calibration: from files to a verdict in words, the lab, and what it refuses."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gonio.bench.board_faults import SMALL
from gonio.bench.board_sessions import Filming, film, write_films
from gonio.errors import CaptureError, GonioError, InputError
from gonio.formats.calibration import read_own_calibration, write_calibration_as
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.calibration.rig import solve_rig
from gonio.kernel.calibration.verdict import CRITERIA
from gonio.kernel.geometry.cameras import project
from gonio.pipeline.boards import card_text
from gonio.pipeline.calibration import calibrate, calibrate_lenses, compare
from gonio.pipeline.calibration_files import find_calibration_files, pictures_of
from gonio.pipeline.calibration_lab import find_lab
from gonio.pipeline.calibration_recording import find_sweep, read_sweep
from gonio.pipeline.calibration_verdict import WORDS, find_lengths
from gonio.pipeline.capture import judge_calibration, read_rig
from gonio.pipeline.findings import KINDS
from gonio.pipeline.params import KnownLengthParameter
from gonio.pipeline.run import CaptureFile, LocalRunner
from gonio.records import Calibration, Judgement, Rig, Verdict

FILMED = Filming(cameras=3, radius_m=2.4, poses=50, board=SMALL)
CARD = card_text("5x4", 80, "A0", "DICT_4X4_50", inverted=False)


@pytest.fixture(scope="module")
def session():
    return film(36, FILMED)


@pytest.fixture(scope="module")
def films(session, tmp_path_factory) -> Path:
    """Three cameras' films, the card, and lenses that are known."""
    folder = tmp_path_factory.mktemp("films")
    write_films(session, folder)
    (folder / "board.toml").write_text(CARD)
    write_toml_calibration(folder / "optics.toml", session.rig)
    return folder


def run(folder: Path, parameters: dict, output: Path) -> tuple[Calibration, LocalRunner, str]:
    runner = LocalRunner()
    result = calibrate(find_calibration_files(folder), parameters, runner, output)
    calibration = read_own_calibration(result.document)
    assert calibration is not None
    return calibration, runner, result.page.read_text()


@pytest.fixture(scope="module")
def calibrated(films, tmp_path_factory):
    """The films' calibration, with a length that was measured by hand."""
    return run(
        films, {"known_lengths": [{"first": "cam1", "second": "cam2", "metres": 2.4}]}, tmp_path_factory.mktemp("out")
    )


@pytest.mark.slow
def test_from_films_to_a_verdict_in_words(calibrated, session):
    calibration, runner, page = calibrated
    assert calibration.rig.names == ("cam1", "cam2", "cam3")
    assert {"boards", "rig", "verdict", "calibration-report"} <= set(runner.seconds)
    truth = [camera.centre_lab_m for camera in session.rig.cameras]
    found = [camera.centre_lab_m for camera in calibration.rig.cameras]
    for a, b in ((0, 1), (1, 2), (0, 2)):
        # 50 pictures of an 80 mm board: within 2 %; the verdict says how well it really knows.
        assert np.linalg.norm(found[a] - found[b]) == pytest.approx(np.linalg.norm(truth[a] - truth[b]), rel=0.02)
    codes = {finding.code for finding in calibration.findings}
    assert "lab-guessed" in codes
    assert "scale-unverified" not in codes
    for finding in calibration.findings:
        assert finding.message in page.replace("&#39;", "'").replace("&amp;", "&")
    assert page.count("<svg") == 2
    assert "arrow shows forward" in page


@pytest.mark.slow
def test_the_same_rig_is_checked_later_and_keeps_its_lab(calibrated, films, session, tmp_path):
    calibration, _, _ = calibrated
    shutil.copytree(films, tmp_path / "again")
    (tmp_path / "again" / "optics.toml").unlink()
    files = find_calibration_files(tmp_path / "again")
    write_calibration_as(tmp_path / "old.json", calibration)
    files.append(CaptureFile(path=tmp_path / "old.json", name="old.json", role="previous"))
    result = calibrate(files, {}, LocalRunner(), tmp_path / "out")
    again = read_own_calibration(result.document)
    assert again is not None
    codes = {finding.code for finding in again.findings}
    assert "cameras-steady" in codes
    assert codes.isdisjoint({"camera-displaced", "lab-guessed", "lens-from-session"})
    np.testing.assert_allclose(again.rig.cameras[0].T_lab_cam, calibration.rig.cameras[0].T_lab_cam, atol=0.02)
    assert "stands as it stood" in result.page.read_text()
    drawn = {path.name: path.read_text() for path in result.others if path.suffix == ".svg"}
    assert set(drawn) == {"plan.svg", "coverage.svg"}
    assert all(text.startswith("<svg") and "xmlns=" in text for text in drawn.values())


def test_each_criterion_is_told_and_named(calibrated):
    assert set(WORDS) == set(CRITERIA)
    for name, say in WORDS.items():
        made = say(Judgement(name=name, level="reject", value=3.0, accept=1.0, warn=2.0, where="cam2"))
        assert made.severity == "serious"
        assert made.code in KINDS


def with_verdict(calibration: Calibration, level: str) -> Calibration:
    return replace(calibration, verdict=Verdict(level=level, judgements=()))


@pytest.mark.slow
def test_a_session_that_uses_a_rejected_calibration_says_so(calibrated, tmp_path):
    calibration, _, _ = calibrated
    write_calibration_as(tmp_path / "rig.json", with_verdict(calibration, "reject"))
    outcome = read_rig([CaptureFile(path=tmp_path / "rig.json", name="rig.json", role="calibration")])
    assert outcome.value.names == calibration.rig.names
    assert [(f.code, f.severity) for f in outcome.findings] == [("calibration-rejected", "serious")]
    assert judge_calibration(with_verdict(calibration, "warn"))[0].code == "calibration-doubtful"
    assert judge_calibration(with_verdict(calibration, "accept")) == ()
    write_calibration_as(tmp_path / "rig.toml", calibration)
    assert read_rig([CaptureFile(path=tmp_path / "rig.toml", name="rig.toml", role="calibration")]).findings == ()


def test_cameras_that_moved_or_were_not_seen_are_named(session):
    solution = solve_rig(session.views, session.optics)
    cameras = list(solution.lenses(session.views))
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]
    cameras[2] = replace(cameras[2], T_lab_cam=cameras[2].T_lab_cam @ turn)
    calibration = _bare(session, tuple(cameras))
    outcome = compare(session.views, calibration)
    assert [(f.code, f.where) for f in outcome.findings] == [("camera-displaced", "cam3")]
    assert "It turned by 1.1" in outcome.findings[0].message  # 0.02 rad
    assert " ± " in outcome.findings[0].message
    sd_rad = outcome.value.turned_sd_rad
    assert abs(outcome.value.turned_rad[2] - 0.02) < 3 * max(sd_rad[2], 0.001)
    assert (sd_rad < 0.01).all()
    other = replace(session.views, camera_names=("cam1", "cam2", "cam9"))
    assert ("camera-not-checked", "cam3") in [(f.code, f.where) for f in compare(other, calibration).findings]


def _bare(session, cameras) -> Calibration:
    from gonio.records import LabFrame, Volume

    return Calibration(
        rig=Rig(cameras=cameras, source=""),
        intrinsics=session.optics,
        delay_s=np.zeros(3),
        covariance=np.zeros((48, 48)),
        sigma_px=0.3,
        lab=LabFrame(T_lab_ref=np.eye(4), source="board", misfit_m=0.0, tilt_sd_rad=0.0),
        volume=Volume(lower_lab_m=np.zeros(3), upper_lab_m=np.ones(3), error_m=0.0),
        verdict=Verdict(level="accept", judgements=()),
        board="",
    )


def test_lenses_come_from_their_recording_the_file_or_the_sweep(session):
    outcome = calibrate_lenses(session.views, (), [])
    assert {f.code for f in outcome.findings} == {"lens-from-session"}
    assert [optics.origin for optics in outcome.value] == ["session"] * 3
    blind = replace(session.views, uv_px=np.where(np.arange(3)[:, None, None, None] == 2, np.nan, session.views.uv_px))
    assert calibrate_lenses(blind, (), []).value[2].views == 0


def points_text(session, names) -> str:
    places = {"a": [0, 0, 0], "b": [0.8, 0, 0], "c": [0.8, 0, 0.6], "d": [0, 0, 0.6]}
    lines = []
    for name, xyz in places.items():
        lines.append(f"[points.{name}]\nlab_m = {[float(x) for x in xyz]}")
        for camera in session.rig.cameras:
            if camera.name in names:
                u, v = project(camera, np.array(xyz, dtype=float))
                lines.append(f"{camera.name} = [{u:.3f}, {v:.3f}]")
    return "\n".join(lines)


def test_named_floor_points_are_the_lab_and_end_known_lengths(session, tmp_path):
    solution = solve_rig(session.views, session.optics)
    path = tmp_path / "floor_points.toml"
    path.write_text(points_text(session, session.rig.names))
    files = [CaptureFile(path=path, name=path.name, role="floor_points")]
    lab = find_lab(session.views, solution, files, None).value
    assert lab.frame.source == "points"
    for found, true in zip(lab.rig.cameras, session.rig.cameras, strict=True):
        np.testing.assert_allclose(found.centre_lab_m, true.centre_lab_m, atol=0.05)
        assert found.T_lab_cam[:3, 2] @ true.T_lab_cam[:3, 2] > np.cos(np.deg2rad(1.5))
    from gonio.pipeline.calibration_lab import read_points

    lengths = (KnownLengthParameter(first="a", second="b", metres=0.8),)
    (length,) = find_lengths(lengths, lab.rig, read_points(files, lab.rig))
    assert length.found_m == pytest.approx(0.8, rel=0.01)
    with pytest.raises(InputError) as caught:
        find_lengths((KnownLengthParameter(first="a", second="nowhere", metres=1.0),), lab.rig, None)
    assert caught.value.code == "length-unknown"
    path.write_text(
        points_text(session, session.rig.names).replace("lab_m = [0.8, 0.0, 0.6]", "lab_m = [0.8, 0.5, 0.6]")
    )
    assert [f.code for f in find_lab(session.views, solution, files, None).findings] == ["lab-misfit"]


def test_a_still_board_in_the_sweep_is_the_floor(session):
    solution = solve_rig(session.views, session.optics)
    flat = np.eye(4)  # its printed side up, its rows along X
    flat[:3, :3], flat[:3, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [-0.2, 0.0, 0.0]
    corners = SMALL.corners_board_m @ flat[:3, :3].T + flat[:3, 3]
    seen = np.stack([project(camera, corners)[None] for camera in session.rig.cameras])
    floor = replace(session.views, times_s=np.zeros(1), uv_px=seen)
    lab = find_lab(session.views, solution, [], floor).value
    assert lab.frame.source == "board"
    middle = corners.mean(axis=0)
    for found, true in zip(lab.rig.cameras, session.rig.cameras, strict=True):
        np.testing.assert_allclose(found.centre_lab_m, true.centre_lab_m - middle, atol=0.06)
    with pytest.raises(InputError) as caught:
        find_lab(session.views, solution, [], None, floor_time_s=1e6)
    assert caught.value.code == "floor-frame-empty"


def plan(folder: Path, board=SMALL):
    return read_sweep(pictures_of(find_calibration_files(folder), "sweep"), board, 10.0)


def photographs(folder: Path, session, count: int) -> Path:
    """The first frames of each film as photographs."""
    for camera in session.rig.cameras:
        (folder / camera.name).mkdir(parents=True)
        for number in range(count):
            cv2.imwrite(str(folder / camera.name / f"{number}.png"), np.full((540, 720), 96, np.uint8))
    return folder


def test_recordings_that_can_not_be_used_are_refused(session, films, tmp_path):
    with pytest.raises(CaptureError) as caught:
        find_sweep(plan(photographs(tmp_path / "walls", session, 2)).value, lambda fraction: None)
    assert caught.value.code == "board-not-found"

    uneven = photographs(tmp_path / "uneven", session, 2)
    (uneven / "cam1" / "1.png").unlink()
    mixed = photographs(tmp_path / "mixed", session, 1)
    shutil.copy(films / "cam2.mp4", mixed / "film.mp4")
    alone = photographs(tmp_path / "alone", session, 1)
    for name in ("cam2", "cam3"):
        shutil.rmtree(alone / name)
    for folder, code in (
        (uneven, "pictures-differ-in-number"),
        (mixed, "calibration-files-mixed"),
        (alone, "too-few-cameras"),
    ):
        with pytest.raises(GonioError) as caught:
            plan(folder)
        assert caught.value.code == code
    turned = replace(SMALL, kind="checkerboard", corners_across=4, corners_down=6)
    with pytest.raises(InputError) as caught:
        plan(films, turned)
    assert caught.value.code == "board-ambiguous-turned"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (lambda d: (d / "cam1.mp4").write_bytes(b""), None),
        (
            lambda d: (d / "board.toml").write_text(card_text("4x5", 80, "A0", "DICT_4X4_50", inverted=False)),
            "board-card-wrong",
        ),
        (lambda d: (d / "board.toml").unlink(), "board-missing"),
        (lambda d: (d / "charuco.toml").write_text(CARD), "board-ambiguous"),
        (lambda d: (d / "optics.toml").write_text("x"), "calibration-format-unknown"),
    ],
)
def test_bad_files_are_refused_with_their_name(films, tmp_path, spoil, code):
    folder = tmp_path / "films"
    shutil.copytree(films, folder)
    spoil(folder)
    with pytest.raises(GonioError) as caught:
        run(folder, {}, tmp_path / "out")
    if code is not None:
        assert caught.value.code == code
    assert caught.value.hint


def test_folders_tell_what_pictures_are(tmp_path):
    for name in ("intrinsics/int_cam01_img/1.png", "extrinsics/cam01_ext.mp4", "floor/cam01/1.jpg", "calibration/cam02.mp4",
                 "board.toml", "floor_points.toml", "camera_array.toml", "notes.txt", "gonio/old.mp4"):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = {(file.role, file.camera or "") for file in find_calibration_files(tmp_path)}
    assert found == {
        ("lens", "cam01"), ("sweep", "cam01"), ("floor", "cam01"), ("sweep", "cam02"), ("board", ""),
        ("floor_points", ""), ("optics", ""),
    }  # fmt: skip
    for folder, code in ((tmp_path / "nothing", "folder-missing"), (tmp_path / "floor", None)):
        if code:
            with pytest.raises(InputError) as caught:
                find_calibration_files(folder)
            assert caught.value.code == code


def test_the_print_of_a_card_beside_it_is_no_second_card(tmp_path):
    for name in ("board.toml", "board.pdf", "cam1.mp4"):
        (tmp_path / name).touch()
    assert [file.name for file in find_calibration_files(tmp_path) if file.role == "board"] == ["board.toml"]
