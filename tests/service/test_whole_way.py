"""From an empty service to a report, through the client."""

import json

import pytest

from gonio.errors import Cancelled, CaptureError, GonioError


@pytest.mark.slow
def test_upload_analyse_wait_report(lab, capture, journal, tmp_path):
    sent: list[tuple[int, int]] = []
    session = lab.client.create_session(name="Anna", subject={"mass_kg": 61.0})["id"]
    for path in capture.iterdir():
        file = lab.client.upload(session, path, on_progress=lambda done, size: sent.append((done, size)))
        assert file["size"] == path.stat().st_size
    assert sent[-1][0] == sent[-1][1]
    by_name = {file["name"]: file for file in lab.client.files(session)}
    facts = by_name["cam01.mp4"]["facts"]
    assert (facts["frames"], facts["rate_hz"], facts["width_px"]) == (8, 30.0, 64)
    assert by_name["calibration.xml"]["facts"] == {"cameras": ["cam01", "cam02"]}
    assert by_name["calibration.xml"]["role"] == "calibration"

    states: list[dict] = []
    job = lab.client.analyse(session, journal.parameters(seconds=0.6))
    job = lab.client.wait(job["id"], states.append, timeout_s=30, poll_s=0.1)
    assert [stage["name"] for stage in job["stages"]] == ["capture", "keypoints", "dynamics", "report"]
    fractions = [state["progress"]["fraction"] for state in states if state["progress"]]
    assert fractions == sorted(fractions)
    assert fractions[-1] > 0.1

    report = lab.client.report(job["id"])
    assert report["frames"] == [8, 8]
    assert report["exist"] == [True, True, True]
    assert report["mass_kg"] == 61.0
    assert report["findings"] == ["dark"]
    paths = lab.client.download(job["id"], tmp_path / "report")
    assert {path.name for path in paths} == {"report.json", "report.html", "knee.mot"}
    assert json.loads((tmp_path / "report" / "report.json").read_text()) == report
    assert job["id"] in {item["id"] for item in lab.client.jobs()}

    lab.client.delete_session(session)
    assert [path for path in lab.objects() if session in str(path)] == []
    for gone in (f"/v1/jobs/{job['id']}", f"/v1/reports/{job['id']}", f"/v1/sessions/{session}"):
        assert lab.http.get(gone).status_code == 404


def test_cancel_stops_a_long_stage_in_its_first_part(lab, capture, journal):
    """Progress is told once a second, and stops the stage when its job was cancelled: of 60 s, it gets through 2 or so.

    A third leaves room for a machine that is busy with other things; a stage that didn't hear would get to its end.
    """
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(seconds=60))["id"]
    journal.wait_for("begin keypoints", timeout_s=90)
    assert lab.client.cancel(job)["state"] == "cancelled"
    with pytest.raises(Cancelled):
        lab.client.wait(job)
    # The one worker is free again when the next job begins.
    lab.client.wait(lab.client.analyse(session, journal.parameters(seconds=0.0))["id"], timeout_s=90)
    lines = journal.lines()
    stopped = next(line for line in lines if line.startswith("stopped at"))
    assert float(stopped.rpartition(" ")[2]) < 1 / 3
    assert lines.index(stopped) < lines.index("begin capture", 1)
    assert lines.count("begin keypoints") == lines.count("end keypoints") + 1
    assert lab.client.cancel(job)["state"] == "cancelled"


def test_a_capture_error_reaches_the_reader_of_the_job(lab, capture, journal):
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(fault={"keypoints": "capture"}))["id"]
    with pytest.raises(GonioError, match="Nobody is in the videos") as caught:
        lab.client.wait(job, timeout_s=180)
    assert (caught.value.code, caught.value.hint) == ("nobody-found", "Film a person.")
    problem = lab.client.job(job)["problem"]
    assert problem["details"] == {"frames": 3}
    assert problem["type"] == f"/problems/{CaptureError.code}"
    assert lab.http.get(f"/v1/reports/{job}").status_code == 404


def test_a_bug_in_a_stage_tells_only_a_reference(lab, capture, journal):
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters(fault={"dynamics": "bug"}))["id"]
    with pytest.raises(GonioError) as caught:
        lab.client.wait(job, timeout_s=180)
    assert caught.value.code == "internal-error"
    told = json.dumps(lab.client.job(job))
    assert "secret" not in told
    reference = lab.client.job(job)["problem"]["details"]["reference"]
    log = lab.log.read_text()
    assert reference in log
    assert "secret: /etc/passwd" in log


def test_a_queued_job_can_be_cancelled_and_never_runs(start_lab, capture, journal):
    lab = start_lab(workers=0)
    session = lab.complete_session(capture)
    job = lab.client.analyse(session, journal.parameters())["id"]
    assert lab.client.job(job)["state"] == "todo"
    assert lab.client.cancel(job)["state"] == "cancelled"
    lab.client.delete_session(session)
    assert journal.lines() == []
