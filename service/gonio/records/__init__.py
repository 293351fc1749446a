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
    RigCheck,
    Verdict,
    Volume,
)
from gonio.records.camera import Camera, Rig
from gonio.records.capture import Capture, View
from gonio.records.finding import Finding, Severity
from gonio.records.intrinsics import INTRINSIC_NAMES, Intrinsics, LensModel
from gonio.records.markerset import CoordinatePrior, MarkerSet, Measurement
from gonio.records.people import Person, Sightings
from gonio.records.points import FILLED, MEASURED, MISSING, REJECTED, ImagePoints, LabPoints
from gonio.records.pressure import FootPressure, VirtualPressure
from gonio.records.record import record
from gonio.records.timebase import Timebase
from gonio.records.virtual_board import VirtualBoard
from gonio.records.virtual_trial import BURST, DROPPED, HIDDEN, OUTSIDE, PULLED, SWAPPED, VirtualTrial
from gonio.records.walk import FEET, FootEvents, Steps, Walk, WalkTruth

__all__ = [
    "BURST",
    "DROPPED",
    "FEET",
    "FILLED",
    "FIXED",
    "GROUND",
    "HIDDEN",
    "INTRINSIC_NAMES",
    "MEASURED",
    "MISSING",
    "NOT_CONVERGED",
    "OUTSIDE",
    "PARTIAL",
    "PRISMATIC",
    "PULLED",
    "REJECTED",
    "REVOLUTE",
    "SOLVED",
    "SWAPPED",
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
    "FootEvents",
    "FootPressure",
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
    "Person",
    "Rig",
    "RigCheck",
    "Severity",
    "Sightings",
    "Steps",
    "Tasks",
    "Timebase",
    "Verdict",
    "View",
    "VirtualBoard",
    "VirtualPressure",
    "VirtualTrial",
    "Volume",
    "Walk",
    "WalkTruth",
    "record",
]
