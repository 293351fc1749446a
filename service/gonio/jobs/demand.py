"""What must hold before an analysis is queued, and by what it is known again."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from gonio.errors import CaptureError, InputError
from gonio.jobs.tables import CalibrationRow, JobRow
from gonio.jobs.workflow import VERSION


def as_file(row: CalibrationRow, kind: str) -> dict[str, Any]:
    """Give a calibration's document as a file of a job: what it computes with, or what it checks."""
    document = next(file for file in row.files if file["kind"] == "document")
    return {
        "name": f"calibration-{row.id}.json",
        "role": "previous" if kind == "calibration" else "calibration",
        "camera": None,
        "key": document["key"],
        "sha256": document["sha256"],
    }


def fingerprint_of(kind: str, files: Sequence[Mapping[str, Any]], parameters: Mapping[str, Any]) -> str:
    """Give a hash of all that a report depends on: this version of gonio, the files' contents, the parameters."""
    contents = sorted([file["name"], file["role"], file["camera"] or "", file["sha256"]] for file in files)
    content = json.dumps([version("gonio"), VERSION, kind, contents, parameters], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def refuse_when_full(active: int, most: int) -> None:
    """Raise ``too-many-jobs`` if the lab has as many as it may."""
    if active >= most:
        raise InputError(
            f"{active} jobs of the lab wait or run, as many as may.",
            hint="Wait until some of them have ended, or cancel those that aren't needed.",
            code="too-many-jobs",
            retry_after_s=60,
        )


def same_job(known: JobRow, session_id: str, parameters: dict[str, Any], calibration_id: str | None) -> JobRow:
    """Give the job that an idempotency key stands for, or raise ``idempotency-key-reused``."""
    if (known.session_id, known.parameters, known.calibration_id) == (session_id, parameters, calibration_id):
        return known
    raise InputError(
        "This Idempotency-Key was already used for another analysis.",
        hint="Use a new key for each analysis, and the same one only to repeat a request that got no answer.",
        code="idempotency-key-reused",
        job=known.id,
    )


def refuse_when_incomplete(files: Sequence[Mapping[str, Any]], kind: str) -> None:
    """Raise an error if an analysis or a calibration lacks files, or has too many calibrations."""
    calibrations = [file["name"] for file in files if file["role"] in ("calibration", "previous")]
    if len(calibrations) > 1:
        raise InputError(
            f"There are {len(calibrations)} calibrations: {', '.join(calibrations)}.",
            hint="Delete the uploaded one, or name none in the request.",
            code="calibration-ambiguous",
        )
    if kind == "calibration":
        _refuse_without_sweep(files)
        return
    if kind == "articulated_object":
        _refuse_without_object(files)
        return
    videos = max(sum(file["role"] == role for file in files) for role in ("video", "keypoints"))
    if not calibrations:
        raise CaptureError(
            "The session has no calibration.",
            hint="Name one of GET /v1/calibrations, or upload that of its cameras; then start the analysis again.",
            code="calibration-missing",
        )
    fewest, cameras = (1, "the camera") if kind == "human_monocular" else (2, "at least two calibrated cameras")
    if videos < fewest:
        raise CaptureError(
            f"The session has {'no video' if videos == 0 else 'one video'}; the analysis needs "
            f"{'one' if fewest == 1 else 'at least two'}.",
            hint=f"Upload the videos, or the keypoints, of {cameras}, then start the analysis again.",
            code="too-few-videos",
            videos=videos,
        )


def _refuse_without_object(files: Sequence[Mapping[str, Any]]) -> None:
    roles = [file["role"] for file in files]
    for role, name in (("joint_tree", "body.toml"), ("tracks", "tracks.csv or tracks.json")):
        if roles.count(role) != 1:
            raise CaptureError(
                f"The session has {roles.count(role) or 'no'} files of role {role}; the analysis needs one.",
                hint=f"Upload {name} with role={role}, then start the analysis again.",
                code="object-files-missing",
            )
    if not {"calibration", "background", "picture"} & set(roles):
        raise CaptureError(
            "Nothing tells where the camera was.",
            hint="Upload the cameras, marks of the background, or the pictures; then start the analysis again.",
            code="object-files-missing",
        )


def _refuse_without_sweep(files: Sequence[Mapping[str, Any]]) -> None:
    cameras = {file["camera"] or file["name"] for file in files if file["role"] == "sweep"}
    if len(cameras) < 2:
        raise CaptureError(
            f"The board was filmed by {'no camera' if not cameras else 'one camera'}; a rig has two or more.",
            hint="Upload each camera's video of the board, filmed at the same time, with role=sweep.",
            code="too-few-cameras",
        )
