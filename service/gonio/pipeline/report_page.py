"""The report as one self-contained page that prints on two sheets of A4."""

import base64
from collections.abc import Mapping
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from gonio.pipeline.finding_kind import counted
from gonio.pipeline.report_base import Side
from gonio.pipeline.report_gait import CycleCurve, GaitParameter, GaitReportSection, Statistic
from gonio.pipeline.report_schema import GaitReport, ReportFinding


class Fact(NamedTuple):
    """One of the numbers at the top of the page."""

    label: str
    value: str
    unit: str
    note: str


def render_html(report: GaitReport, pictures: Mapping[str, bytes], plan_svg: str) -> str:
    """Render the report as one self-contained page; ``pictures`` holds a JPEG a camera, ``plan_svg`` the room."""
    from gonio.pipeline.figures import angle_figure, cycle_figure  # with matplotlib: slow to load

    environment = Environment(
        loader=PackageLoader("gonio.pipeline", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("report.html.jinja").render(
        report=report,
        counted=counted,
        quantity=quantity,
        statistic=statistic,
        moment=moment,
        facts=key_facts(report.gait),
        cycle_svg=cycle_figure(report.gait),
        angle_svg=angle_figure(report.time_s, report.angles),
        plan_svg=plan_svg,
        moments=any(c.quantity.endswith("moment") for c in report.gait.curves),
        deviations=[c for c in report.gait.curves if c.unit == "deg" and c.deviation is not None],
        pictures={name: base64.b64encode(jpeg).decode() for name, jpeg in pictures.items()},
    )


def key_facts(gait: GaitReportSection) -> list[Fact]:
    """Give the numbers that a reader looks for first; none without a cycle."""
    by_name = {p.name: p for p in gait.parameters}
    facts = [_of_both(by_name, "speed", "Speed"), _of_both(by_name, "cadence", "Cadence")]
    step = by_name.get("step length")
    if step is not None and step.right is not None and step.left is not None:
        value = f"{step.right.mean:.2f} / {step.left.mean:.2f}"
        facts.append(Fact("Step length, right / left", value, "m", f"asymmetry {step.asymmetry_percent:g} %"))
    facts.append(_peaks(gait, "knee_flexion", "Greatest knee flexion, right / left", "°"))
    facts.append(_peaks(gait, "knee_extension_moment", "Greatest knee moment, right / left", " Nm/kg", 2))
    knees = [c for c in gait.curves if c.quantity == "knee_flexion" and c.deviation is not None]
    if len(knees) == 2:
        right, left = (next(c for c in knees if c.side == side) for side in ("right", "left"))
        facts.append(
            Fact(
                "Knee off the healthy mean, right / left",
                f"{right.deviation:.1f}° / {left.deviation:.1f}°",
                "",
                "RMS over the cycle",
            )
        )
    return [fact for fact in facts if fact is not None]


def quantity(value: float | None, unit: str = "") -> str:
    """Write a number of a parameter with as many digits as it deserves, and its unit; a dash for what is not known."""
    if value is None:
        return "–"
    digits = {"m": 2, "m/s": 2, "s": 2}.get(unit, 0)
    short = {"% of cycle": "%"}.get(unit, unit)
    return f"{value:.{digits}f} {short}".strip()


def statistic(found: Statistic | None, unit: str) -> str:
    """Write mean ± standard deviation, without the unit."""
    if found is None:
        return "–"
    digits = {"m": 3, "m/s": 3, "s": 3}.get(unit, 1)
    spread = "" if found.sd is None else f" ± {found.sd:.{digits}f}"
    return f"{found.mean:.{digits}f}{spread}"


def moment(found: ReportFinding) -> str:
    """Write when it was that a finding speaks of, from the trial's beginning; empty where it holds for all of it."""
    if found.start_s is None or found.end_s is None:
        return ""
    start, end = f"{found.start_s:.1f}", f"{found.end_s:.1f}"
    return f"at {start} s" if start == end else f"from {start} s to {end} s"


def _of_both(parameters: Mapping[str, GaitParameter], name: str, label: str) -> Fact | None:
    found = parameters.get(name)
    if found is None or found.both is None:
        return None
    note = f"usual {quantity(found.usual, found.unit)}" if found.usual is not None else f"{found.both.count} counted"
    value, _, unit = quantity(found.both.mean, found.unit).partition(" ")
    return Fact(label, value, unit, note)


def _peaks(gait: GaitReportSection, name: str, label: str, unit: str, digits: int = 0) -> Fact | None:
    peaks: dict[Side, str] = {}
    healthy = ""
    for curve in (c for c in gait.curves if c.quantity == name):
        known = [v for v in curve.mean if v is not None]
        if known:
            peaks[curve.side] = f"{max(known):.{digits}f}{'°' if unit == '°' else ''}"
            healthy = _healthy_peak(curve, unit, digits)
    value = f"{peaks.get('right', '–')} / {peaks.get('left', '–')}"
    return Fact(label, value, "" if unit == "°" else unit.strip(), healthy) if peaks else None


def _healthy_peak(curve: CycleCurve, unit: str, digits: int) -> str:
    known = [v for v in curve.norm.mean if v is not None] if curve.norm is not None else []
    return f"healthy {max(known):.{digits}f}{unit}" if known else ""
