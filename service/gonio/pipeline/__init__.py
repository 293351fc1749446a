"""The river, from capture to report. Nobody but this package knows the order of the stages."""

from gonio.pipeline.multicamera import analyse

__all__ = ["analyse"]
