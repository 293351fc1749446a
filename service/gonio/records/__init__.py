"""What flows through gonio: frozen, shape-checked dataclasses on numpy arrays."""

from gonio.records.camera import Camera, Rig
from gonio.records.capture import Capture, View
from gonio.records.finding import Finding, Severity
from gonio.records.points import FILLED, MEASURED, MISSING, REJECTED, ImagePoints, LabPoints
from gonio.records.record import record
from gonio.records.timebase import Timebase

__all__ = [
    "FILLED",
    "MEASURED",
    "MISSING",
    "REJECTED",
    "Camera",
    "Capture",
    "Finding",
    "ImagePoints",
    "LabPoints",
    "Rig",
    "Severity",
    "Timebase",
    "View",
    "record",
]
