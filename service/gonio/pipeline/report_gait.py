"""The report's part on gait: events, cycles, curves over the cycle, parameters, and how far they are from healthy ones."""

from typing import Annotated, Literal

from pydantic import Field

from gonio.pipeline.report_base import ReportModel, Series, Side


class GaitEvent(ReportModel):
    """A foot strikes the ground or leaves it."""

    side: Side
    kind: Literal["initial contact", "toe-off"]
    time_s: float
    sd_ms: Annotated[float, Field(description="Standard deviation of its time.")]
    from_force: Annotated[bool, Field(description="Whether a force showed it; else the movement did.")]


class Cycle(ReportModel):
    """From an initial contact to the next one of the same foot; per cent of the cycle, null where it was not seen."""

    side: Side
    start_s: float
    end_s: float
    opposite_toe_off_percent: Annotated[float | None, Field(description="The end of loading.")]
    heel_off_percent: Annotated[float | None, Field(description="The end of mid-stance.")]
    opposite_contact_percent: float | None
    toe_off_percent: Annotated[float | None, Field(description="The end of stance.")]
    left_out: Annotated[str, Field(description="Why it does not count in the averages; empty where it does.")]


class NormBand(ReportModel):
    """Healthy people at each per cent of the cycle."""

    source: Annotated[str, Field(description="The name of one of the report's norms.")]
    condition: str
    mean: Series
    sd: Annotated[Series, Field(description="Between people.")]


class CycleCurve(ReportModel):
    """An angle, moment or power over the gait cycle: 101 values, one at each per cent."""

    quantity: str
    joint: Literal["hip", "knee", "ankle"]
    side: Side
    name: str
    unit: str
    positive: Annotated[str, Field(description="What a positive value means.")]
    cycles: Annotated[list[Series], Field(description="All cycles of the side, in the order of the report's cycles.")]
    mean: Annotated[Series, Field(description="Over the cycles that count.")]
    sd_between: Annotated[
        Series, Field(description="Standard deviation between those cycles; null with fewer than two.")
    ]
    error_sd: Annotated[Series, Field(description="Standard deviation of the measurement's error; null: not known.")]
    norm: NormBand | None
    deviation: Annotated[
        float | None, Field(description="Root mean square difference to the norm (Gait Variable Score, Baker 2009).")
    ]


class Statistic(ReportModel):
    """Mean and standard deviation over steps or cycles."""

    mean: float
    sd: float | None
    count: int


class GaitParameter(ReportModel):
    """A spatio-temporal parameter."""

    name: str
    unit: str
    both: Statistic | None
    right: Statistic | None
    left: Statistic | None
    asymmetry_percent: Annotated[
        float | None, Field(description="100 |R − L| / mean of both (Robinson 1987); 0 for equal sides.")
    ]
    usual: Annotated[float | None, Field(description="In healthy adults of the subject's sex at their own speed.")]


class NormSource(ReportModel):
    """Where a norm comes from."""

    name: str
    population: str
    citation: str
    licence: str


class GaitReportSection(ReportModel):
    """The walk, cut into cycles."""

    event_method: str
    ground: Literal["floor", "treadmill", "unknown"]
    belt_m_s: float | None
    events: list[GaitEvent]
    cycles: list[Cycle]
    curves: list[CycleCurve]
    parameters: list[GaitParameter]
    profile_score_deg: Annotated[
        dict[Side, float | None],
        Field(description="Root mean square of the deviations of a side's hip, knee and ankle angles from the norm."),
    ]
    norms: list[NormSource]
    usual_from: Annotated[str, Field(description="The source of the parameters' usual values.")]
