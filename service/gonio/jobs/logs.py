"""What the service writes to its log: one line an event, for people or as JSON, with the job or request that it is about.

No name of a person, file or session comes in here: ids, codes and numbers only.
"""

import json
import logging
import sys
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from gonio.settings import Settings

_ABOUT: ContextVar[dict[str, Any]] = ContextVar("about", default={})  # noqa: B039 - never changed, only replaced


@contextmanager
def about(**what: Any) -> Generator[None]:  # noqa: ANN401 - anything that JSON holds
    """Say what the lines are about that are written in this block, such as ``job=...``."""
    token = _ABOUT.set({**_ABOUT.get(), **what})
    try:
        yield
    finally:
        _ABOUT.reset(token)


def set_up_logging(settings: Settings) -> None:
    """Write the log of this process to stderr, in the form that the settings say."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if settings.log_format == "json" else Lines())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    for library in ("httpx", "httpcore", "dbos", "alembic", "uvicorn.error"):
        logging.getLogger(library).setLevel(logging.WARNING)


class Lines(logging.Formatter):
    """Lines for people."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a line: time, level, logger, message, and what it is about."""
        text = super().format(record)
        pairs = " ".join(f"{key}={value}" for key, value in _extra(record).items())
        return f"{_time(record)} {record.levelname} {record.name}: {text}{f' [{pairs}]' if pairs else ''}"


class JsonLines(logging.Formatter):
    """One JSON object a line, for programs."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a line."""
        content: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_extra(record),
        }
        if record.exc_info:
            content["traceback"] = self.formatException(record.exc_info)
        return json.dumps(content, ensure_ascii=False, default=str)


def _extra(record: logging.LogRecord) -> dict[str, Any]:
    return {**_ABOUT.get(), **getattr(record, "about", {})}


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
