"""The stage gait and its part of the report, from a motion that is known."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from gonio.formats.osim import read_osim
from gonio.formats.record_file import read_record, write_record
from gonio.kernel.virtual_lab import truth_at, walk
from gonio.pipeline.describe_gait import describe_gait
from gonio.pipeline.figures import cycle_figure
from gonio.pipeline.gait import analyse_gait
from gonio.pipeline.motion import BodyMotion
from gonio.pipeline.params import Subject
from gonio.pipeline.pressure import Measured
from gonio.pipeline.report_page import key_facts
from gonio.records import (
    BodyModel,
    Finding,
    FootForces,
    FootPressure,
    GaitAnalysis,
    Motion,
    Timebase,
    TimeCurve,
    WalkTruth,
)
from gonio.resources import models_dir

RATE_HZ = 60.0
NOTHING = Measured(pressure=None, clock=None, plates=None)


@pytest.fixture(scope="module")
def man() -> BodyModel:
    return read_osim(models_dir() / "bodies" / "fullbody_male.osim")


@pytest.fixture(scope="module")
def truth(man: BodyModel) -> WalkTruth:
    return truth_at(walk(man, 1.25), 0.013 + np.arange(round(5 * RATE_HZ)) / RATE_HZ)


def _found(man: BodyModel, truth: WalkTruth, values: np.ndarray | None = None) -> BodyMotion:
    frames = len(truth.times_s)
    motion = Motion(
        coordinate_names=truth.coordinate_names,
        rotational=man.coordinates.rotational,
        times_s=truth.times_s,
        values=truth.q if values is None else values,
        status=np.zeros(frames, dtype=np.uint8),
        iterations=np.zeros(frames, dtype=int),
        residual_rms_m=np.zeros(frames),
    )
    return BodyMotion(motion=motion, model=man, two_step=motion, fit=None, distrusted="")


def _analyse(
    found: BodyMotion, measured: Measured = NOTHING, moments: Sequence[TimeCurve] = ()
) -> tuple[GaitAnalysis, list[Finding]]:
    outcome = analyse_gait(found, Timebase(rate_hz=RATE_HZ, start_s=0.013), measured, moments)
    return outcome.value, list(outcome.findings)


def test_a_walk_becomes_a_section_of_the_report(man: BodyModel, truth: WalkTruth) -> None:
    mass_kg = man.mass_kg
    moments = [
        TimeCurve(
            quantity="knee_extension_moment",
            side=side,
            unit="Nm/kg",
            values=truth.moment_of(f"knee_angle_{side[0]}") / mass_kg,
            sd=np.full(len(truth.times_s), 0.05),
        )
        for side in ("right", "left")
    ]
    gait, findings = _analyse(_found(man, truth), moments=moments)
    section = describe_gait(gait, Subject(sex="male", stature_m=1.75, mass_kg=75))
    assert [f.code for f in findings] == ["gait-events-from-movement"]
    assert section.ground == "floor"
    times = [event.time_s for event in section.events]
    assert times == sorted(times)
    knee = next(c for c in section.curves if c.quantity == "knee_flexion" and c.side == "right")
    assert len(knee.cycles) == len([c for c in section.cycles if c.side == "right"])
    assert knee.norm is not None
    assert knee.norm.source == "fukuchi2018"
    # The walker follows published curves of children at this pace, within their spread of 5 to 8°.
    assert knee.deviation is not None
    assert knee.deviation < 8
    torque = next(c for c in section.curves if c.quantity == "knee_extension_moment")
    assert torque.norm is not None
    assert torque.norm.source == "schwartz2008"
    assert {n.name for n in section.norms} == {"fukuchi2018", "schwartz2008"}
    assert [f.label.split(",")[0] for f in key_facts(section)] == [
        "Speed",
        "Cadence",
        "Step length",
        "Greatest knee flexion",
        "Greatest knee moment",
        "Knee off the healthy mean",
    ]
    svg = cycle_figure(section)
    assert svg.startswith("<svg role=")
    assert cycle_figure(section.model_copy(update={"curves": []})) == ""


def test_the_stage_can_be_kept_and_taken_up_again(man: BodyModel, truth: WalkTruth, tmp_path: Path) -> None:
    gait, _ = _analyse(_found(man, truth))
    write_record(tmp_path / "gait.npz", gait)
    again = read_record(tmp_path / "gait.npz")
    assert describe_gait(again, Subject()) == describe_gait(gait, Subject())


def test_children_are_compared_with_children_alone(man: BodyModel, truth: WalkTruth) -> None:
    gait, _ = _analyse(_found(man, truth))
    section = describe_gait(gait, Subject(stature_m=1.2, sex="female"))
    assert {n.name for n in section.norms} == {"schwartz2008"}
    assert all(p.usual is None for p in section.parameters)


def test_forces_show_the_events_where_they_are(man: BodyModel, truth: WalkTruth) -> None:
    wrench = truth.wrench.copy()
    wrench[:, 1] = np.nan  # the left foot never met a plate
    plates = FootForces(
        times_s=truth.times_s, wrench=wrench, cop_lab_m=truth.cop_lab_m, shared=np.zeros(len(wrench), dtype=bool)
    )
    gait, findings = _analyse(_found(man, truth), Measured(pressure=None, clock=None, plates=plates))
    assert gait.events.strikes[0].from_force.any()
    assert not gait.events.strikes[1].from_force.any()
    assert "gait-events-from-movement" in {f.code for f in findings}
    section = describe_gait(gait, Subject())
    assert re.search("force.*Zeni", section.event_method)


@pytest.mark.parametrize(("rate_hz", "used"), [(100.0, True), (20.0, False)])
def test_soles_show_the_events_if_they_are_quick_enough(
    man: BodyModel, truth: WalkTruth, rate_hz: float, used: bool
) -> None:
    times_s = np.arange(0.013, 5.0, 1.0 / rate_hz)
    vertical_n = np.stack([np.interp(times_s, truth.times_s, truth.wrench[:, foot, 1]) for foot in (0, 1)], axis=1)
    soles = FootPressure(times_s=times_s, vertical_n=vertical_n, cop_foot_m=np.full((len(times_s), 2, 2), np.nan))
    gait, _ = _analyse(_found(man, truth), Measured(pressure=soles, clock=None, plates=None))
    assert gait.events.strikes[0].from_force.any() == used
    errors = [
        np.min(np.abs(truth.events[foot].strike_frames - frame))
        for foot in (0, 1)
        for frame in gait.events.strikes[foot].frames
    ]
    # 5 % of the weight is passed up to 25 ms after a strike of this smooth load: 1.5 frames.
    assert max(errors) < (1.5 if used else 1.0)


def test_a_clip_without_a_full_cycle_says_so(man: BodyModel, truth: WalkTruth) -> None:
    short = WalkTruth(
        **{  # type: ignore[arg-type]
            name: getattr(truth, name)[:40]
            for name in (
                "times_s",
                "q",
                "velocity",
                "acceleration",
                "generalized_forces",
                "wrench",
                "cop_lab_m",
                "com_lab_m",
            )
        },
        coordinate_names=truth.coordinate_names,
        events=truth.events,
    )
    gait, findings = _analyse(_found(man, short))
    assert [f.code for f in findings] == ["gait-no-cycle"]
    section = describe_gait(gait, Subject())
    assert section.cycles == []
    assert cycle_figure(section) == ""
    assert all(v is None for curve in section.curves for v in curve.mean)


def test_an_odd_cycle_is_named_and_left_out(man: BodyModel, truth: WalkTruth) -> None:
    values = truth.q.copy()
    knee = truth.coordinate_names.index("knee_angle_r")
    gait, _ = _analyse(_found(man, truth))
    second = [c for c in gait.cycles if c.foot == 0][1]
    frames = np.arange(len(values))
    bump = np.where((frames > second.start_frame) & (frames < second.end_frame), 1.0, 0.0)
    values[:, knee] += np.deg2rad(25.0) * bump * np.sin(np.pi * (frames - second.start_frame) / 64.0) ** 2
    gait, findings = _analyse(_found(man, truth, values))
    assert any(f.code == "gait-cycle-odd" and f.where.startswith("right cycle 2") for f in findings)
    curve = next(c for c in describe_gait(gait, Subject()).curves if c.quantity == "knee_flexion" and c.side == "right")
    assert len(curve.cycles) == len(gait.cycles_of("right"))
