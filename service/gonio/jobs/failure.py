"""How an error gets from a worker to the reader of a job: as plain JSON, and never with an internal text."""

import json
import logging
from typing import Any
from uuid import uuid4

from gonio import errors
from gonio.errors import GonioError

log = logging.getLogger(__name__)

Problem = dict[str, Any]
"""``code``, ``message``, ``hint``, ``details``, and ``kind``: a class of ``gonio.errors``, or nothing for a bug."""


class StageCrashed(Exception):
    """A stage ended with an error that is no GonioError; its problem was already logged and described."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem["code"])
        self.problem = problem


class Suspended(BaseException):
    """The database can't record how a job gets on, so nothing about the job is settled: its worker takes it up again.

    No ``Exception``, or DBOS would record it as the outcome of the stage or of the job as soon as the database is back.
    """


def describe(error: Exception) -> Problem:
    """Describe an error for the reader of a job, who gets of an unforeseen one only its reference in the log."""
    if isinstance(error, StageCrashed):
        return error.problem
    if isinstance(error, GonioError):
        kind = next(cls.__name__ for cls in type(error).__mro__ if cls.__module__ == errors.__name__)
        details = {name: value for name, value in error.details.items() if _is_plain(value)}
        return {
            "kind": kind,
            "code": error.code,
            "message": error.message,
            "hint": error.hint,
            "details": details,
        }
    reference = uuid4().hex[:12]
    log.error("Internal error %s", reference, exc_info=error)
    return {
        "kind": "",
        "code": "internal-error",
        "message": "Something went wrong inside gonio.",
        "hint": f"Tell whoever runs the service: its log explains the reference {reference}.",
        "details": {"reference": reference},
    }


def revive(problem: Problem) -> Exception:
    """Make the error again that was described, so that a stage that failed before a crash fails alike after it."""
    if not problem["kind"]:
        return StageCrashed(problem)
    cls: type[GonioError] = getattr(errors, problem["kind"])
    if cls is errors.Cancelled:
        return errors.Cancelled(problem["message"], hint=problem["hint"])
    return cls(problem["message"], hint=problem["hint"], code=problem["code"], **problem["details"])


def _is_plain(value: object) -> bool:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return False
    return True
