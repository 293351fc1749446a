"""A finding: a degraded result that the report must show."""

from typing import Literal

from gonio.records.record import record

Severity = Literal["info", "warning", "serious"]


@record
class Finding:
    """Something about the recording or the result that its reader has to know.

    ``code`` is stable and documented (docs/reference/findings.md). ``message`` is a sentence a clinician understands,
    ``hint`` what to do about it next time. ``where`` names the camera, file, joint or keypoint, ``value`` the measured
    number behind the sentence with its unit in ``unit``.

    ``span_s`` is the stretch of the trial that it speaks of, on the trial's clock; both ends are the same where it is a
    moment, and it is None where it holds for the whole trial or its moment is not known. Of several stretches it is the
    longest, of something that varies the worst moment. ``camera`` and ``joint`` (``right knee``) name the one that is meant.
    """

    code: str
    severity: Severity
    stage: str
    message: str
    hint: str
    where: str = ""
    value: float | None = None
    unit: str = ""
    span_s: tuple[float, float] | None = None
    camera: str = ""
    joint: str = ""
