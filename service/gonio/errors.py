"""The whole error tree. Each class's docstring is what a user reads first; each instance says what to do about it.

::

    GonioError
    ├── InputError       the request or a file is wrong
    ├── CaptureError     the recording can't give the answer
    ├── SolverError      the numbers failed
    ├── ResourceError    something that has to be installed or fetched is missing
    └── Cancelled        the user asked to stop

HTTP status codes live in one table in ``gonio.http``; the domain never knows them. A result that is worse than it could
be is no error: it is a :class:`gonio.records.Finding` and stands in the report.
"""

from typing import Any


class GonioError(Exception):
    """Something went wrong in gonio.

    Args:
        message: What happened, naming the file and the field.
        hint: What the user can do about it. Compulsory: an error without a remedy is half an error.
        code: A stable, documented name of this kind of error, in kebab-case.
        details: Numbers and names that belong to the message, for programs.
    """

    code = "gonio-error"

    def __init__(self, message: str, *, hint: str, code: str | None = None, **details: Any) -> None:  # noqa: ANN401 - JSON
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.code = code or type(self).code
        self.details = details

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})"


class InputError(GonioError):
    """The request or a file is wrong."""

    code = "invalid-input"


class CaptureError(GonioError):
    """The recording can't give the answer that was asked for."""

    code = "capture-insufficient"


class SolverError(GonioError):
    """A numerical solver failed; ``details`` keeps the problem and the solver's report."""

    code = "solver-failed"


class ResourceError(GonioError):
    """Something that has to be installed or fetched is missing."""

    code = "resource-missing"


class Cancelled(GonioError):
    """The work was cancelled on request."""

    code = "cancelled"

    def __init__(
        self, message: str = "The analysis was cancelled.", *, hint: str = "Start it again when you like."
    ) -> None:
        super().__init__(message, hint=hint)
