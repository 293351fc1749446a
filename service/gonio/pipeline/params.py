"""What a request may choose, with complete defaults. The HTTP schema is made from these classes, and a report keeps them."""

from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gonio.errors import InputError
from gonio.pipeline.run import CaptureFile

T = TypeVar("T")

FOREIGN_CONFIDENCE = 0.3
"""The least confidence for keypoints of OpenPose and RTMPose, whose numbers are lower than BlazePose's visibilities."""

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=_STRICT)
class Subject:
    """Who was filmed. All of it may be unknown; what needs a mass or a sex says so in the report."""

    mass_kg: Annotated[float, Field(gt=2, lt=400, description="Body mass in kilograms.")] | None = None
    stature_m: Annotated[float, Field(gt=0.4, lt=2.6, description="Standing height in metres.")] | None = None
    sex: Annotated[Literal["female", "male"], Field(description="Chooses the table of segment masses.")] | None = None


LabChoice = Literal["auto", "calibration", "walker"]

LookRate = Literal["exact", "default", "fast"]


@dataclass(frozen=True, config=_STRICT)
class KeypointParameters:
    """How keypoints are found in the videos."""

    model: Annotated[
        Literal["blazepose_heavy", "blazepose_full"],
        Field(description="`blazepose_heavy` is the accurate one; `blazepose_full` is a fast preview."),
    ] = "blazepose_heavy"
    rate: Annotated[
        LookRate,
        Field(
            description="How often each camera is looked at: 60, 30 or 20 times a second. Tracks are fused over time, so that "
            "30 is as good as 60 for walking; take `exact` for running and for impacts. The body is fitted to the pixels at "
            "this rate too, and the motion in between is the smoothest."
        ),
    ] = "default"
    layout: (
        Annotated[
            Literal["body25b", "coco17", "halpe26", "blazepose33"],
            Field(
                description="Which keypoints uploaded keypoint files hold, by the order of their network. Without it, 17, 26 "
                "and 33 keypoints are taken for COCO, HALPE and BlazePose; 25 must be named."
            ),
        ]
        | None
    ) = None
    rate_hz: (
        Annotated[
            float,
            Field(
                gt=1,
                le=2000,
                description="The rate of uploaded keypoint files, where their videos are not uploaded too.",
            ),
        ]
        | None
    ) = None
    person: Annotated[
        Literal["auto"] | Annotated[int, Field(ge=1, le=99)] | tuple[float, float],
        Field(
            description="Who of several people is the subject. `auto`: of those seen in at least half as many pictures as the "
            "best seen one, of those who walk (if anybody does), the one nearest to the middle of the capture volume. A "
            "number: the so-manyth in that order, as the report's `people` lists them. Two numbers: whose path comes nearest "
            "to this point (x, z) of the calibrated lab's floor, metres."
        ),
    ] = "auto"


@dataclass(frozen=True, config=_STRICT)
class ReconstructionParameters:
    """How keypoints of several cameras become points in the lab."""

    method: Annotated[
        Literal["stereo", "linear3", "linear4", "linear", "reprojection", "robust"],
        Field(
            description="A step of the ladder: plain linear least squares over two (stereo), three or four cameras, or "
            "confidence-weighted over all; confidence-weighted reprojection (Levenberg-Marquardt); robust (camera-pair "
            "hypotheses, then Cauchy's loss)."
        ),
    ] = "robust"
    min_confidence: Annotated[
        float,
        Field(
            ge=0,
            lt=1,
            description="Keypoints that the model trusts less are not used. 0.5 suits gonio's own networks, 0.3 OpenPose's and "
            "RTMPose's files, and is their default.",
        ),
    ] = 0.5
    synchronization: Annotated[
        Literal["estimate", "hardware"],
        Field(description="Estimate the cameras' delays from the subject's movement, or trust a common trigger."),
    ] = "estimate"
    refine_cameras: Annotated[
        bool,
        Field(
            description="Correct the cameras' poses on the subject's own movement, if that lowers the held-out error."
        ),
    ] = True
    lab: Annotated[
        LabChoice,
        Field(
            description="Where floor and vertical come from. `auto`: from the calibration, unless it only guessed them or the "
            "subject would walk on a wall in it; then from the subject's own steps. `calibration` and `walker`: always."
        ),
    ] = "auto"
    smoothing: Annotated[
        Literal["fusion", "median"],
        Field(
            description="`fusion`: one robust smooth track a keypoint from all observations over time. `median`: frame by "
            "frame, then a median and a zero-lag Butterworth filter."
        ),
    ] = "fusion"
    segments: Annotated[
        Literal["steady", "free"],
        Field(
            description="`steady`: the smooth points are corrected by what is known of arms and legs, that their segments keep "
            "their lengths. `free`: each keypoint for itself."
        ),
    ] = "steady"
    cutoff_hz: Annotated[
        float, Field(gt=0, le=60, description="Bandwidth of the tracks: 8 Hz for walking, 12 Hz for running.")
    ] = 8.0


@dataclass(frozen=True, config=_STRICT)
class KinematicsParameters:
    """How the joint angles are found."""

    method: Annotated[
        Literal["pixels", "points"],
        Field(
            description="`pixels`: the body is fitted to all cameras' keypoints over the whole trial, with error bars, and "
            "checked against `points`: inverse kinematics of the smoothed points, frame by frame."
        ),
    ] = "pixels"


@dataclass(frozen=True, config=_STRICT)
class ForceParameters:
    """How the forces of the ground are found."""

    method: Annotated[
        Literal["template", "pivot", "newton_euler", "vertical"],
        Field(
            description="Where soles measure the vertical force only, how its shear is found. `template`: the course over the "
            "contact that people have in common, with the whole body's moment; where it was never tried, `pivot`: through a "
            "fixed point above the centre of mass. `newton_euler`: a share of what the whole body needs. `vertical`: none."
        ),
    ] = "template"
    task: Annotated[
        Literal["recognise", "walking", "running", "squat", "sit_to_stand", "landing"],
        Field(description="What the subject does; `recognise`: told from the contacts of the feet."),
    ] = "recognise"
    synchronization: Annotated[
        Literal["estimate", "hardware"],
        Field(
            description="Estimate how far the clock of the pressure soles runs ahead from the walk itself, or trust that it is "
            "the video's (a common trigger). Force plates are always taken to run on the video's clock."
        ),
    ] = "estimate"
    search_s: Annotated[
        float,
        Field(
            gt=0,
            le=0.5,
            description="How far the offset is searched each way: less than half a step, or steps are mistaken.",
        ),
    ] = 0.25


@dataclass(frozen=True, config=_STRICT)
class Parameters:
    """All that a request may choose for an analysis."""

    subject: Subject = field(default_factory=Subject)
    keypoints: KeypointParameters = field(default_factory=KeypointParameters)
    reconstruction: ReconstructionParameters = field(default_factory=ReconstructionParameters)
    kinematics: KinematicsParameters = field(default_factory=KinematicsParameters)
    forces: ForceParameters = field(default_factory=ForceParameters)


@dataclass(frozen=True, config=_STRICT)
class KnownLengthParameter:
    """A length that was measured by hand, between two cameras' lenses or two floor points: it checks the scale."""

    first: Annotated[str, Field(min_length=1, description="A camera, or a floor point.")]
    second: Annotated[str, Field(min_length=1, description="Another one of the same kind.")]
    metres: Annotated[float, Field(gt=0.05, lt=200)]


@dataclass(frozen=True, config=_STRICT)
class CalibrationParameters:
    """All that a request may choose for a calibration."""

    board: Annotated[str, Field(description="One of gonio's boards by name; empty: a card is among the files.")] = ""
    method: Annotated[
        Literal["tree", "chain"],
        Field(
            description="How the cameras are put together before the bundle adjustment: over the most reliable pairs, or "
            "from neighbour to neighbour (1-2, 2-3, 3-4)."
        ),
    ] = "tree"
    floor_frame: Annotated[
        int | None,
        Field(ge=0, description="A frame of the sweep in which the board lies still on the floor: it is the lab."),
    ] = None
    board_thickness_mm: Annotated[float, Field(ge=0, le=100, description="How far the print is above the floor.")] = 0.0
    known_lengths: tuple[KnownLengthParameter, ...] = ()
    pictures_per_s: Annotated[
        float, Field(gt=0.2, le=60, description="So many pictures a second are searched for the board.")
    ] = 10.0


_ADAPTER: TypeAdapter[Parameters] = TypeAdapter(Parameters)
_CALIBRATION_ADAPTER: TypeAdapter[CalibrationParameters] = TypeAdapter(CalibrationParameters)


def parse_parameters(values: Mapping[str, Any]) -> Parameters:
    """Check the parameters of a request and fill in the defaults.

    Raises:
        InputError: ``parameter-invalid``; the message names each wrong field and what it may be.
    """
    return _parse(_ADAPTER, values)


def with_file_defaults(parameters: Parameters, asked: Mapping[str, Any], files: Iterable[CaptureFile]) -> Parameters:
    """Lower the least confidence where keypoints of another program come in and the request says nothing of it."""
    named = "min_confidence" in asked.get("reconstruction", {})
    if named or not any(file.role == "keypoints" for file in files):
        return parameters
    return replace(parameters, reconstruction=replace(parameters.reconstruction, min_confidence=FOREIGN_CONFIDENCE))


def parse_calibration_parameters(values: Mapping[str, Any]) -> CalibrationParameters:
    """Check the parameters of a calibration and fill in the defaults.

    Raises:
        InputError: ``parameter-invalid``; the message names each wrong field and what it may be.
    """
    return _parse(_CALIBRATION_ADAPTER, values)


def _parse(adapter: TypeAdapter[T], values: Mapping[str, Any]) -> T:
    try:
        return adapter.validate_python(dict(values))
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors(include_url=False))
        raise InputError(
            f"The parameters are not valid: {wrong}.",
            hint="Leave a parameter out to get its default; GET /v1/parameters lists them all.",
            code="parameter-invalid",
        ) from error


def parameters_document(parameters: Parameters) -> dict[str, Any]:
    """Give the parameters as plain JSON values, for the report."""
    return _ADAPTER.dump_python(parameters, mode="json")


def parameters_schema() -> dict[str, Any]:
    """Give the JSON schema of the parameters."""
    return _ADAPTER.json_schema()


def calibration_parameters_schema() -> dict[str, Any]:
    """Give the JSON schema of a calibration's parameters."""
    return _CALIBRATION_ADAPTER.json_schema()
