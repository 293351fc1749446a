"""Cameras are calibrated by the service, and later sessions name the result; over the real server, with gonio's own river."""

import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from gonio.bench.board_sessions import Filming, film, write_films
from gonio.errors import GonioError, InputError

UNKNOWN = "00000000-0000-4000-8000-000000000000"
CARD = """kind = "charuco"
inner_corners = [7, 5]
square_mm = 100
marker_mm = 75
dictionary = "DICT_5X5_100"
"""


@pytest.fixture(scope="module")
def boards(tmp_path_factory) -> Path:
    """A folder with the films of two cameras and the board's card."""
    folder = tmp_path_factory.mktemp("boards")
    write_films(film(8, Filming(cameras=2, radius_m=2.2, poses=24)), folder)
    (folder / "board.toml").write_text(CARD)
    return folder


def begin_calibration(lab, boards: Path, **values) -> str:
    session = lab.client.create_session(kind="calibration", name="the rig", **values)["id"]
    for path in sorted(boards.iterdir()):
        lab.client.upload(session, path)
    return session


@pytest.fixture(scope="module")
def calibrated(lab, boards) -> dict:
    """A calibration that a second length contradicts: the job of a session of its own."""
    session = begin_calibration(lab, boards)
    length = {"first": "cam1", "second": "cam2", "metres": 9.0}  # they stand 2.2 m apart
    return lab.client.wait(lab.client.analyse(session, {"known_lengths": [length]})["id"], timeout_s=240)


@pytest.mark.slow
def test_upload_calibrate_poll_and_read_the_verdict(lab, calibrated, tmp_path):
    assert calibrated["report"] is None
    assert calibrated["calibration"] == f"/v1/calibrations/{calibrated['id']}"
    roles = {file["name"]: file["role"] for file in lab.client.files(calibrated["session"])}
    assert roles == {"board.toml": "board", "cam1.mp4": "sweep", "cam2.mp4": "sweep"}

    calibration = lab.client.calibration(calibrated["id"])
    assert (calibration["name"], calibration["cameras"], calibration["lab_source"]) == (
        "the rig",
        ["cam1", "cam2"],
        "cameras",
    )
    assert calibration["verdict"] == "reject"
    told = {finding["code"]: finding for finding in calibration["findings"]}
    assert told["lab-guessed"]["severity"] == "warning"
    assert (told["scale-wrong"]["severity"], told["scale-wrong"]["where"]) == ("serious", "cam1 to cam2")
    assert [item["id"] for item in lab.client.calibrations()] == [calibrated["id"]]

    paths = lab.client.download_calibration(calibrated["id"], tmp_path)
    assert {"calibration.json", "calibration.html", "calibration.qca.txt", "calibration.toml"} <= {
        p.name for p in paths
    }
    page = lab.http.get(f"{calibrated['calibration']}/files/calibration.html")
    assert page.headers["content-type"].startswith("text/html")
    assert "<svg" in page.text
    assert lab.http.get(f"/v1/calibrations/{calibrated['id']}/files/other.json").status_code == 404
    assert lab.http.get(f"/v1/reports/{calibrated['id']}").status_code == 404


@pytest.mark.slow
def test_a_session_names_a_calibration_which_can_not_be_deleted_while_it_is_read(lab, calibrated, capture, journal):
    session = lab.client.create_session(calibration=calibrated["id"])["id"]
    assert lab.client.session(session)["calibration"] == calibrated["id"]
    for path in capture.glob("*.mp4"):
        lab.client.upload(session, path)
    job = lab.client.analyse(session, journal.parameters(seconds=2.0))["id"]
    journal.wait_for("begin keypoints")
    with pytest.raises(GonioError) as caught:
        lab.client.delete_session(calibrated["session"])
    assert caught.value.code == "session-busy"
    lab.client.wait(job, timeout_s=180)
    assert f"calibration-{calibrated['id']}.json" in lab.client.report(job)["files"]

    lab.client.upload(session, capture / "calibration.xml")
    with pytest.raises(InputError) as caught:
        lab.client.analyse(session)
    assert caught.value.code == "calibration-ambiguous"


@pytest.mark.slow
def test_an_old_calibration_is_checked_by_a_new_sweep(lab, calibrated, boards):
    session = begin_calibration(lab, boards)
    with pytest.raises(InputError) as caught:
        lab.client.analyse(session, calibration=UNKNOWN)
    assert caught.value.code == "not-found"
    job = lab.client.wait(lab.client.analyse(session, calibration=calibrated["id"])["id"], timeout_s=120)
    codes = [finding["code"] for finding in lab.client.calibration(job["id"])["findings"]]
    assert "cameras-steady" in codes  # it is the same film
    assert "lab-guessed" not in codes  # the lab is the old one
    assert "comparison" in [stage["name"] for stage in job["stages"]]
    lab.client.delete_session(session)
    assert lab.http.get(f"/v1/calibrations/{job['id']}").status_code == 404
    assert [path for path in lab.objects() if session in str(path)] == []


@pytest.mark.parametrize(
    ("name", "content", "fields", "code"),
    [
        ("cam1.mp4", b"no film", {}, "not-a-video"),
        ("cam1.mp4", b"", {"role": "video"}, "role-wrong"),
        ("001.jpg", b"", {}, "camera-missing"),
        ("001.jpg", b"", {"camera": "cam1"}, "image-empty"),
        ("001.png", b"no picture", {"camera": "cam1"}, "image-unreadable"),
        ("board.toml", b'kind = "charuco"', {}, "board-card-unreadable"),
        ("lenses.json", b"{}", {"role": "optics"}, "calibration-unreadable"),
        ("old.json", b'{"format": "gonio calibration"}', {"role": "previous"}, "calibration-unreadable"),
        ("notes.txt", b"", {}, "role-unknown"),
        ("optics.toml", b"", {}, "calibration-format-unknown"),
        ("floor_points.toml", b"[points]", {}, "floor-points-unreadable"),
    ],
)
def test_what_can_not_be_read_is_refused_at_once(lab, tmp_path, name, content, fields, code):
    session = lab.client.create_session(kind="calibration")["id"]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        lab.client.upload(session, tmp_path / name, **fields)
    assert caught.value.code == code
    assert caught.value.hint
    assert lab.client.files(session) == []
    assert lab.spooled() == []


def test_a_calibration_needs_two_cameras_and_a_session_a_calibration_that_exists(lab):
    session = lab.client.create_session(kind="calibration")["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.analyse(session)
    assert caught.value.code == "too-few-cameras"
    with pytest.raises(InputError) as caught:
        lab.client.create_session(calibration=UNKNOWN)
    assert caught.value.code == "not-found"


@pytest.mark.slow
def test_a_wrong_card_fails_the_job_with_what_to_do(lab, boards, tmp_path):
    shutil.copytree(boards, tmp_path / "boards")
    (tmp_path / "boards" / "board.toml").write_text(CARD.replace("[7, 5]", "[5, 7]"))
    job = lab.client.analyse(begin_calibration(lab, tmp_path / "boards"))["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.wait(job, timeout_s=120)
    assert caught.value.code == "board-card-wrong"
    assert "7 × 5" in caught.value.message
    assert lab.http.get(f"/v1/calibrations/{job}").status_code == 404


@pytest.mark.slow
def test_a_calibration_survives_the_kill_of_its_worker_and_is_the_same(lab, start_lab, start_worker, boards):
    undisturbed = lab.client.analyse(begin_calibration(lab, boards))["id"]
    lab.client.wait(undisturbed, timeout_s=240)
    expected = lab.http.get(f"/v1/calibrations/{undisturbed}/files/calibration.json").content
    lab.client.delete_session(lab.client.job(undisturbed)["session"])

    lab = start_lab(workers=0)
    start_worker(lab.settings)
    session = begin_calibration(lab, boards)
    job = lab.client.analyse(session)["id"]
    deadline_s = time.monotonic() + 60
    while lab.client.job(job)["started_at"] is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    workers = list(lab.settings.work_dir.iterdir())
    assert len(workers) == 1
    second = start_worker(lab.settings)
    for process in _workers_but(second.pid):
        os.kill(process, signal.SIGKILL)
    ended = lab.client.wait(job, timeout_s=240)
    assert ended["calibration"] == f"/v1/calibrations/{job}"
    assert [item["id"] for item in lab.client.calibrations()] == [job]
    assert lab.http.get(f"/v1/calibrations/{job}/files/calibration.json").content == expected


def _workers_but(pid: int) -> list[int]:
    """List the other worker processes that this test process started."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return [
        int(child)
        for child in children
        if int(child) != pid and b"worker_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]
