"""Stage ``gait``: the motion, and the moments where there are any, cut into gait cycles, measured and judged."""

from collections.abc import Sequence

import numpy as np

from gonio.kernel.body.forward import body_poses
from gonio.kernel.gait.cycles import cut_cycles, leave_out_odd, normalise
from gonio.kernel.gait.events import events_from_force, events_from_movement, fuse
from gonio.kernel.gait.parameters import measure_gait
from gonio.kernel.gait.paths import bridge_gaps, foot_paths
from gonio.kernel.gait.progression import Bout, find_bouts
from gonio.kernel.kinematics.clinical import clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.pipeline.finding_kind import counted
from gonio.pipeline.findings import finding
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.pressure import Measured
from gonio.pipeline.run import Outcome
from gonio.records import (
    FEET,
    BodyModel,
    CycleCurves,
    EventTrain,
    Finding,
    FootPaths,
    GaitAnalysis,
    GaitCycle,
    GaitEvents,
    Motion,
    Timebase,
    TimeCurve,
)

COMPARED = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion")
"""The curves by which an odd cycle is told."""

SOLE_SHARE = 0.05
"""Of the body's weight: from here on a sole counts as loaded; straps and drift press with less."""

LEAST_SOLE_HZ = 50.0
"""Slower soles are left aside: a load begins anywhere between two samples, and a foot that leaves the ground hardly presses
for its last 20 to 60 ms. In twenty virtual people with soles of 20 Hz, with the clock as found, the trial's mean instant of
5 to 20 % of the weight differs from person to person by 10 ms (contact) and 9 to 14 ms (toe-off), the movement's by 4 and 3."""

FEW_CYCLES = 3
"""With fewer of a side, the average says little about how someone usually walks."""


def analyse_gait(
    found: BodyMotion,
    timebase: Timebase,
    measured: Measured,
    moments: Sequence[TimeCurve] = (),
) -> Outcome[GaitAnalysis]:
    """Find the events, cut the cycles, average and measure; without a full cycle, give what there is, and say so.

    Args:
        found: The motion.
        timebase: Of the motion.
        measured: What soles and plates measured: forces show the events better than the motion.
        moments: Joint moments and powers over the trial.
    """
    motion, model = found.motion, found.model
    curves = (*angle_curves(motion, model), *moments)
    paths = foot_paths(model, motion, timebase)
    if paths is None:
        nothing = _nothing_found(curves, timebase, _leg_length_m(model))
        return Outcome(nothing, (finding("gait-no-cycle", where="the body model has no heels and toes"),))
    paths = bridge_gaps(paths)
    bouts = find_bouts(paths)
    events = find_events(paths, bouts, measured, model.weight_n)
    cycles = cut_cycles(events, paths, bouts)
    compared = {
        quantity: np.array([normalise(_curve(curves, quantity, FEET[c.foot]).values, c) for c in cycles])
        for quantity in COMPARED
        if cycles and any(c.quantity == quantity for c in curves)
    }
    cycles = leave_out_odd(cycles, {_words(q): rows for q, rows in compared.items()}, timebase.rate_hz)
    walked = [b for b in bouts if any(b.start <= f < b.stop for train in events.strikes for f in train.frames)]
    analysis = GaitAnalysis(
        events=events,
        cycles=cycles,
        measures=measure_gait(events, cycles, paths, bouts),
        curves=tuple(_over_cycles(curve, cycles) for curve in curves),
        timebase=timebase,
        belt_m_s=abs(float(np.mean([b.belt_m_s for b in walked]))) if walked else np.nan,
        leg_length_m=_leg_length_m(model),
    )
    return Outcome(analysis, judge_gait(analysis))


def find_events(paths: FootPaths, bouts: tuple[Bout, ...], measured: Measured, weight_n: float) -> GaitEvents:
    """Find the events from the movement, and from what measured a force often enough: plates before soles."""
    timebase = paths.timebase
    events = events_from_movement(paths, bouts)
    soles, plates = measured.pressure, measured.plates
    if soles is not None and np.median(np.diff(soles.times_s)) < 1.05 / LEAST_SOLE_HZ:
        threshold_n = SOLE_SHARE * weight_n
        events = fuse(
            events_from_force(soles.times_s, soles.vertical_n, timebase, threshold_n), events, timebase.rate_hz
        )
    if plates is not None:
        by_plates = events_from_force(plates.times_s, plates.wrench[..., 1], timebase)
        events = fuse(by_plates, events, timebase.rate_hz)
    return events


def angle_curves(motion: Motion, model: BodyModel) -> tuple[TimeCurve, ...]:
    """Give the report's joint angles over time."""
    return tuple(
        TimeCurve(
            quantity=angle.name,
            side=angle.side,
            unit="deg",
            values=clinical_deg(motion, angle),
            sd=clinical_sd_deg(motion, angle),
        )
        for angle in find_clinical_angles(model)
    )


def judge_gait(analysis: GaitAnalysis) -> tuple[Finding, ...]:
    """Say what the reader must know: no cycles, few cycles, odd cycles, and events that no force showed."""
    contacts = sum(len(train.frames) for train in analysis.events.strikes)
    if not analysis.cycles:
        where = (
            counted(contacts, "initial contact was|initial contacts were") + " seen"
            if contacts
            else "nobody walks in it"
        )
        return (finding("gait-no-cycle", where=where),)
    findings: list[Finding] = []
    for side in FEET:
        for number, cycle in enumerate(analysis.cycles_of(side), 1):
            if cycle.left_out:
                where = f"{side} cycle {number}: {cycle.left_out}"
                span_s = time_s(analysis, cycle.start_frame), time_s(analysis, cycle.end_frame)
                findings.append(finding("gait-cycle-odd", where=where, span_s=span_s))
    kept = {side: sum(not c.left_out for c in analysis.cycles_of(side)) for side in FEET}
    if min(kept.values()) < FEW_CYCLES:
        where = ", ".join(f"{count} {side}" for side, count in kept.items())
        findings.append(finding("gait-few-cycles", where=where, value=min(kept.values())))
    trains = (*analysis.events.strikes, *analysis.events.lifts)
    unseen = np.concatenate([train.sd_s[~train.from_force] for train in trains])
    if unseen.size:
        findings.append(finding("gait-events-from-movement", value=1e3 * float(np.max(unseen))))
    return tuple(findings)


def time_s(gait: GaitAnalysis, frame: float) -> float:
    """Give the time of a frame with a fraction."""
    return gait.timebase.start_s + frame / gait.timebase.rate_hz


def _over_cycles(curve: TimeCurve, cycles: Sequence[GaitCycle]) -> CycleCurves:
    own = [c for c in cycles if FEET[c.foot] == curve.side]
    return CycleCurves(
        quantity=curve.quantity,
        side=curve.side,
        unit=curve.unit,
        values=np.array([normalise(curve.values, c) for c in own]).reshape(-1, 101),
        sd=np.array([normalise(curve.sd, c) for c in own]).reshape(-1, 101),
    )


def _curve(curves: Sequence[TimeCurve], quantity: str, side: str) -> TimeCurve:
    return next(c for c in curves if c.quantity == quantity and c.side == side)


def _words(quantity: str) -> str:
    return quantity.replace("_", " ")


def _leg_length_m(model: BodyModel) -> float:
    """Give the height of the right hip over the sole in the default pose; NaN for a body without a right leg."""
    names = model.bodies.names
    if not {"femur_r", "calcn_r"} <= set(names):
        return np.nan
    height_m = body_poses(model, model.coordinates.default[None])[0, :, 1, 3]
    return float(height_m[names.index("femur_r")] - height_m[names.index("calcn_r")])


def _nothing_found(curves: Sequence[TimeCurve], timebase: Timebase, leg_length_m: float) -> GaitAnalysis:
    none = EventTrain(frames=np.zeros(0), sd_s=np.zeros(0), from_force=np.zeros(0, dtype=bool))
    return GaitAnalysis(
        events=GaitEvents(strikes=(none, none), lifts=(none, none)),
        cycles=(),
        measures=(),
        curves=tuple(_over_cycles(curve, ()) for curve in curves),
        timebase=timebase,
        belt_m_s=np.nan,
        leg_length_m=leg_length_m,
    )
