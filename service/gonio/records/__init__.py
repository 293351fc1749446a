"""What flows through gonio: frozen, shape-checked dataclasses on numpy arrays."""

from gonio.records.board import Board, BoardTrack, BoardViews
from gonio.records.body import (
    FIXED,
    GROUND,
    NOT_CONVERGED,
    PARTIAL,
    PRISMATIC,
    REVOLUTE,
    SOLVED,
    TOO_FEW_MARKERS,
    Bodies,
    BodyModel,
    Coordinates,
    Functions,
    JointTree,
    Markers,
    Motion,
    Tasks,
)
from gonio.records.calibration import (
    UNKNOWNS,
    Calibration,
    Judgement,
    LabFrame,
    LabSource,
    Level,
    Verdict,
    Volume,
)
from gonio.records.camera import Camera, Rig
from gonio.records.capture import Capture, View
from gonio.records.finding import Finding, Severity
from gonio.records.intrinsics import INTRINSIC_NAMES, Intrinsics, LensModel
from gonio.records.markerset import CoordinatePrior, MarkerSet, Measurement
from gonio.records.points import FILLED, MEASURED, MISSING, REJECTED, ImagePoints, LabPoints
from gonio.records.record import record
from gonio.records.timebase import Timebase

__all__ = [
    "FILLED",
    "FIXED",
    "GROUND",
    "INTRINSIC_NAMES",
    "MEASURED",
    "MISSING",
    "NOT_CONVERGED",
    "PARTIAL",
    "PRISMATIC",
    "REJECTED",
    "REVOLUTE",
    "SOLVED",
    "TOO_FEW_MARKERS",
    "UNKNOWNS",
    "Board",
    "BoardTrack",
    "BoardViews",
    "Bodies",
    "BodyModel",
    "Calibration",
    "Camera",
    "Capture",
    "CoordinatePrior",
    "Coordinates",
    "Finding",
    "Functions",
    "ImagePoints",
    "Intrinsics",
    "JointTree",
    "Judgement",
    "LabFrame",
    "LabPoints",
    "LabSource",
    "LensModel",
    "Level",
    "MarkerSet",
    "Markers",
    "Measurement",
    "Motion",
    "Rig",
    "Severity",
    "Tasks",
    "Timebase",
    "Verdict",
    "View",
    "Volume",
    "record",
]
