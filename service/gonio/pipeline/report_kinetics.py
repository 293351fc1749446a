"""The report's part on forces and torques."""

from typing import Annotated, Literal

from pydantic import Field

from gonio.pipeline.report_base import ReportModel, Series, Side


class PressureReport(ReportModel):
    """The clock of the pressure soles against the video's."""

    used: Annotated[bool, Field(description="Whether the stream was used; if not, a finding says why.")]
    offset_ms: Annotated[
        float | None, Field(description="How far the soles' clock runs ahead, from both kinds of evidence.")
    ]
    offset_sd_ms: Annotated[float | None, Field(description="Standard deviation of the offset.")]
    force_offset_ms: Annotated[
        float | None, Field(description="The offset by force alone: both feet carry what the movement needs.")
    ]
    force_offset_sd_ms: float | None
    contact_offset_ms: Annotated[
        float | None, Field(description="The offset by contact alone: loads begin and end with the feet's steps.")
    ]
    contact_offset_sd_ms: float | None
    contacts: Annotated[int, Field(description="Beginnings and ends of loads that steps in the video correspond to.")]
    refused: Annotated[str, Field(description="Why there is no offset; empty if there is one.")]


class FootForce(ReportModel):
    """What the ground does to one foot over time, at the report's times, in the lab; null where it is not known."""

    side: Side
    method: Annotated[str, Field(description="How its shear was found; `plates`: measured.")]
    gain: Annotated[float | None, Field(description="The factor that the sole's force was multiplied by.")]
    forward_n: Annotated[Series, Field(description="Along the lab's X.")]
    up_n: Series
    right_n: Annotated[Series, Field(description="Along the lab's Z.")]
    cop_x_m: Annotated[Series, Field(description="Centre of pressure on the floor; null without contact.")]
    cop_z_m: Series


class JointTorque(ReportModel):
    """A joint's torque and power over time, at the report's times."""

    joint: Literal["hip", "knee", "ankle"]
    side: Side
    positive: Annotated[str, Field(description="What a positive torque does.")]
    values_nm: Series
    band_nm: Annotated[Series, Field(description="Half the width of the 95 % band, the force method's error included.")]
    values_nm_kg: Series
    power_w: Annotated[Series, Field(description="Positive: the joint gives energy.")]


class Kinetics(ReportModel):
    """Forces under the feet and torques of the joints."""

    task: str
    asked: Annotated[str, Field(description="The method that was asked for.")]
    fallback: Annotated[str, Field(description="Why another method was used; empty if none was.")]
    expected_error_nm_kg: Annotated[
        float | None,
        Field(description="Error of the knee's torque in people on force plates, with perfect soles and movement."),
    ]
    coefficients_source: Annotated[
        str,
        Field(description="Where the numbers by which shear was found come from; a lab's own are among the inputs."),
    ]
    speed_m_s: float | None
    stance_s: float | None
    amplitude: Annotated[float | None, Field(description="Of the template: how far this walk swings by what is usual.")]
    residual_rms_n: Annotated[float | None, Field(description="What the movement needs beyond what the feet give.")]
    feet: list[FootForce]
    torques: list[JointTorque]
