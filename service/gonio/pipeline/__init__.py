"""The river, from capture to report. Nobody but this package knows the order of the stages."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gonio.pipeline.multicamera import analyse

__all__ = ["analyse"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - Python's protocol
    """Import the river when it is asked for: the HTTP service needs `run.py` only, not every solver and network."""
    if name != "analyse":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gonio.pipeline.multicamera import analyse

    return analyse
