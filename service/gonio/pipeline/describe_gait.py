"""Describe a walk in the words of the report's schema, with the norms beside it."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from gonio.formats.norms import builtin_norms, builtin_usual_values
from gonio.kernel.gait.cycles import average
from gonio.kernel.gait.events import FORCE_METHOD, METHOD
from gonio.kernel.gait.norms import condition_at, dimensionless_speed, gait_variable_score, profile_score
from gonio.kernel.gait.parameters import symmetry_index_percent
from gonio.pipeline.gait import time_s
from gonio.pipeline.params import Subject
from gonio.pipeline.report_base import Side
from gonio.pipeline.report_gait import (
    Cycle,
    CycleCurve,
    GaitEvent,
    GaitParameter,
    GaitReportSection,
    NormBand,
    NormSource,
    Statistic,
)
from gonio.pipeline.rounding import number, series
from gonio.records import FEET, CycleCurves, GaitAnalysis, GaitCycle, Measure, Norms

CHILD_M = 1.40
"""Someone shorter is compared with children, whose curves are all that is published of short legs."""

SIDES: tuple[Side, Side] = ("right", "left")

QUANTITIES: dict[str, tuple[Literal["hip", "knee", "ankle"], str, str]] = {
    "hip_flexion": ("hip", "Hip flexion", "flexion"),
    "knee_flexion": ("knee", "Knee flexion", "flexion"),
    "ankle_dorsiflexion": ("ankle", "Ankle dorsiflexion", "dorsiflexion"),
    "hip_extension_moment": ("hip", "Hip moment", "extending"),
    "knee_extension_moment": ("knee", "Knee moment", "extending"),
    "ankle_plantarflexion_moment": ("ankle", "Ankle moment", "plantarflexing"),
    "hip_power": ("hip", "Hip power", "generated"),
    "knee_power": ("knee", "Knee power", "generated"),
    "ankle_power": ("ankle", "Ankle power", "generated"),
}


def describe_gait(gait: GaitAnalysis, subject: Subject) -> GaitReportSection:
    """Describe events, cycles, curves, parameters, and how far they are from the norms."""
    norms = choose_norms(subject)
    usual = builtin_usual_values()
    speed = gait.measure("speed", "both")
    relative = dimensionless_speed(speed.mean, gait.leg_length_m) if speed else np.nan
    curves = [describe_curve(curve, gait, norms, relative) for curve in gait.curves if curve.quantity in QUANTITIES]
    used = {c.norm.source for c in curves if c.norm is not None}
    known = {"male": usual.male, "female": usual.female}.get(subject.sex or "", {})
    child = subject.stature_m is not None and subject.stature_m < CHILD_M
    forces = any(train.from_force.any() for train in (*gait.events.strikes, *gait.events.lifts))
    return GaitReportSection(
        event_method=f"{FORCE_METHOD}; else {METHOD}" if forces else METHOD,
        ground="unknown" if np.isnan(gait.belt_m_s) else "treadmill" if gait.belt_m_s else "floor",
        belt_m_s=number(gait.belt_m_s, 3),
        events=describe_events(gait),
        cycles=[describe_cycle(cycle, gait) for cycle in gait.cycles],
        curves=curves,
        parameters=describe_parameters(gait.measures, {} if child else known),
        profile_score_deg={
            side: number(
                profile_score([c.deviation for c in curves if c.side == side and c.unit == "deg" and c.deviation]), 1
            )
            for side in SIDES
        },
        norms=[
            NormSource(name=n.name, population=n.population, citation=n.citation, licence=n.licence)
            for n in norms
            if n.name in used
        ],
        usual_from=usual.citation,
    )


def choose_norms(subject: Subject) -> tuple[Norms, ...]:
    """Give the norms in the order in which they are asked for a curve: those of the subject's size first."""
    adults, children = builtin_norms()
    child = subject.stature_m is not None and subject.stature_m < CHILD_M
    return (children,) if child else (adults, children)


def describe_events(gait: GaitAnalysis) -> list[GaitEvent]:
    """List the events by time."""
    found: list[GaitEvent] = []
    kinds: tuple[tuple[Literal["initial contact", "toe-off"], int], ...] = (("initial contact", 0), ("toe-off", 1))
    for kind, index in kinds:
        for side, train in zip(SIDES, (gait.events.strikes, gait.events.lifts)[index], strict=True):
            found += [
                GaitEvent(
                    side=side,
                    kind=kind,
                    time_s=round(time_s(gait, frame), 4),
                    sd_ms=round(1e3 * float(sd_s), 1),
                    from_force=bool(force),
                )
                for frame, sd_s, force in zip(train.frames, train.sd_s, train.from_force, strict=True)
            ]
    return sorted(found, key=lambda event: event.time_s)


def describe_cycle(cycle: GaitCycle, gait: GaitAnalysis) -> Cycle:
    """Describe a cycle by its events."""
    return Cycle(
        side=SIDES[cycle.foot],
        start_s=round(time_s(gait, cycle.start_frame), 4),
        end_s=round(time_s(gait, cycle.end_frame), 4),
        opposite_toe_off_percent=number(cycle.percent(cycle.other_lift_frame), 1),
        heel_off_percent=number(cycle.percent(cycle.heel_off_frame), 1),
        opposite_contact_percent=number(cycle.percent(cycle.other_strike_frame), 1),
        toe_off_percent=number(cycle.percent(cycle.lift_frame), 1),
        left_out=cycle.left_out,
    )


def describe_curve(curve: CycleCurves, gait: GaitAnalysis, norms: Sequence[Norms], relative_speed: float) -> CycleCurve:
    """Describe a curve over the cycle, and the norm it is compared with."""
    joint, name, positive = QUANTITIES[curve.quantity]
    counts = np.array([not c.left_out for c in gait.cycles_of(curve.side)], dtype=bool)
    mean = average(curve.values[counts])
    norm = next(
        (
            (source, condition, condition.curves[curve.quantity])
            for source in norms
            if curve.quantity in (condition := condition_at(source, relative_speed)).curves
        ),
        None,
    )
    compare = norm is not None and norm[2].unit == curve.unit
    return CycleCurve(
        quantity=curve.quantity,
        joint=joint,
        side="right" if curve.side == FEET[0] else "left",
        name=name,
        unit=curve.unit,
        positive=positive,
        cycles=[series(values) for values in curve.values],
        mean=series(mean.mean),
        sd_between=series(mean.sd),
        error_sd=series(average(curve.sd[counts]).mean),
        norm=None
        if norm is None or not compare
        else NormBand(source=norm[0].name, condition=norm[1].name, mean=series(norm[2].mean), sd=series(norm[2].sd)),
        deviation=number(gait_variable_score(mean.mean, norm[2].mean), 3) if norm is not None and compare else None,
    )


def describe_parameters(measures: Sequence[Measure], usual: dict[str, float]) -> list[GaitParameter]:
    """Describe the parameters, the sides beside each other."""
    found: list[GaitParameter] = []
    for name in dict.fromkeys(m.name for m in measures):
        by_side = {m.side: m for m in measures if m.name == name}
        sided = all(side in by_side for side in SIDES)
        found.append(
            GaitParameter(
                name=name,
                unit=next(iter(by_side.values())).unit,
                both=_statistic(by_side.get("both")),
                right=_statistic(by_side.get("right")),
                left=_statistic(by_side.get("left")),
                asymmetry_percent=number(symmetry_index_percent(by_side["right"].mean, by_side["left"].mean), 1)
                if sided
                else None,
                usual=usual.get(name),
            )
        )
    return found


def _statistic(measure: Measure | None) -> Statistic | None:
    if measure is None:
        return None
    return Statistic(mean=round(measure.mean, 3), sd=number(measure.sd, 3), count=len(measure.values))
