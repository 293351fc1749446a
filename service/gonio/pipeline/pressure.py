"""Stages ``sensors`` and ``pressure``: what soles and plates measured, read early, and put on the video's clock and feet."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from gonio.errors import InputError
from gonio.formats.force_plates import read_force_plates
from gonio.formats.pressure_card import MatCard, read_pressure_card
from gonio.formats.pressure_csv import read_pressure
from gonio.formats.pressure_mat import FeetOnMat
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.soles import BALL, HEEL, mark_soles
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.kernel.dynamics.zero_lag import FEWEST_FRAMES, differentiate
from gonio.kernel.forces.plates import assign_plates
from gonio.kernel.synchronization.pressure import BodyCourse, PressureClock, find_clock, is_idle, lacking_share
from gonio.pipeline.body import only_file
from gonio.pipeline.finding_kind import counted
from gonio.pipeline.findings import finding
from gonio.pipeline.moments import longest_stretch
from gonio.pipeline.motion import BodyMotion, complete
from gonio.pipeline.params import Parameters
from gonio.pipeline.run import CaptureFile, Outcome
from gonio.records import FEET, Finding, FootForces, FootPressure, ForcePlates, PressureStream, record

MARGIN_S = 1.0
"""So much of the stream is kept before and after the video: its clock may be that far off."""

CUTOFF_HZ = 6.0
"""Of the movement whose accelerations are compared with forces: walking."""

DOUBTFUL_SD_S = 0.012
"""An offset that is less certain costs more torque than the missing shear does [reference: 10 ms cost 1 Nm, 25 ms 4 Nm]."""

LATE_S = 0.020
"""A hardware trigger that the walk contradicts by so much, and by three standard deviations, is named."""

GAIN_RANGE = (0.85, 1.15)
"""Soles that show a weight outside of this share of the subject's are named: uncalibrated, or somebody else's."""

NOT_ZERO_SHARE = 0.03
LOW_RATE_HZ = 15.0

UNTURNED = np.eye(3)
UNTURNED.setflags(write=False)
"""The motion's lab is the one in which plates and mats lie."""

LARGEST_LACK = 0.1
"""A silent sole in whose trial the other one carries too little for a larger share of the time is dead, or was not worn."""


@record
class Sensors:
    """What the session's soles and plates hold, None where there are none.

    Of a mat the ``stream`` has each foot carry half; ``mat`` and ``mat_card`` are its files, to be read again when it is known
    where the feet are.
    """

    stream: PressureStream | None
    plates: ForcePlates | None
    mat: Path | None = None
    mat_card: Path | None = None


@record
class Measured:
    """What soles and plates measured, on the video's clock.

    ``pressure`` is in newtons, lost samples NaN, with the soles' own gain; None where there is none that can be used.
    ``clock`` says how it was synchronized, None where it was not looked for. ``plates`` gives each foot what plates measured
    of it, at the motion's frames.
    """

    pressure: FootPressure | None
    clock: PressureClock | None
    plates: FootForces | None


def read_sensors(files: Sequence[CaptureFile], duration_s: float) -> Outcome[Sensors]:
    """Read the pressure stream and the force plates of a session.

    Args:
        files: The session's files.
        duration_s: Of the video.

    Raises:
        InputError: two files of one role, or what the formats' readers say of a wrong one.
    """
    findings: list[Finding] = []
    table, card, plate_file = (only_file(files, role) for role in ("pressure", "pressure_card", "force_plates"))
    names = {file.path: file.name for file in files}
    stream, declared = None, read_pressure_card(card) if card is not None else None
    if table is not None:
        stream = read_pressure(table, declared, (-MARGIN_S, duration_s + MARGIN_S), names[table])
        if stream.doubled:
            findings.append(finding("pressure-samples-doubled", value=stream.doubled))
        if stream.negative > 0.01:
            findings.append(finding("pressure-below-zero", value=100 * stream.negative))
    plates = read_force_plates(plate_file, names[plate_file]) if plate_file is not None else None
    if stream is not None and plates is not None:
        findings.append(finding("plates-over-soles"))
    if table is None or not isinstance(declared, MatCard):
        table = card = None
    return Outcome(Sensors(stream=stream, plates=plates, mat=table, mat_card=card), tuple(findings))


def measure_forces(
    sensors: Sensors,
    motion: BodyMotion,
    parameters: Parameters,
    R_lab_calibrated: Float[np.ndarray, "3 3"] = UNTURNED,
) -> Outcome[Measured]:
    """Put soles and plates on the video's clock and to the feet, and judge them.

    ``R_lab_calibrated`` turns the lab in which plates and mats lie to the motion's.
    """
    nothing = Measured(pressure=None, clock=None, plates=None)
    if sensors.stream is None and sensors.plates is None:
        return Outcome(nothing)
    course = body_course(motion)
    findings: list[Finding] = []
    plates = None
    if sensors.plates is not None and course is not None:
        turned = turn_plates(sensors.plates, R_lab_calibrated)
        plates = assign_plates(turned, course.times_s, course.heel_lab_m, course.toe_lab_m)
        findings += judge_plates(plates)
    if sensors.stream is None:
        return Outcome(replace(nothing, plates=plates), tuple(findings))
    if course is None:
        findings.append(finding("pressure-not-synchronized", where="the movement in the video is not known"))
        return Outcome(replace(nothing, plates=plates), tuple(findings))
    try:
        on_floor = _in_lab(course, R_lab_calibrated.T)
        given = _above_mat(sensors, sensors.stream, on_floor, 0.0)
        first = in_newtons(given, course.weight_n).pressure
        clock = find_clock(first, course, parameters.forces.search_s)
        offset_s, said = _judge_clock(clock, first, course, parameters)
        if silent := _silent_sole(first, course, np.nan_to_num(offset_s)):
            return Outcome(Measured(pressure=None, clock=clock, plates=plates), (*findings, silent))
        given = _above_mat(sensors, given, on_floor, offset_s)
    except InputError as error:  # the mat's two halves were right, but not what the feet left on it
        findings.append(finding("pressure-not-synchronized", where=error.message.rstrip(".")))
        return Outcome(replace(nothing, plates=plates), tuple(findings))
    findings += said
    if np.isnan(offset_s):
        return Outcome(Measured(pressure=None, clock=clock, plates=plates), tuple(findings))
    pressure = in_newtons(given, course.weight_n).pressure
    pressure = replace(pressure, times_s=pressure.times_s - offset_s)
    findings += judge_pressure(given, pressure, course, known_mass=parameters.subject.mass_kg is not None)
    return Outcome(Measured(pressure=pressure, clock=clock, plates=plates), tuple(findings))


def turn_plates(plates: ForcePlates, rotation: Float[np.ndarray, "3 3"]) -> ForcePlates:
    """Turn plates with the lab about its vertical: forces, places and corners; moments about the vertical stay."""
    return replace(
        plates,
        force_lab_n=plates.force_lab_n @ rotation.T,
        cop_lab_m=plates.cop_lab_m @ rotation.T,
        corners_lab_m=plates.corners_lab_m @ rotation.T,
    )


def _in_lab(course: BodyCourse, rotation: Float[np.ndarray, "3 3"]) -> BodyCourse:
    """Turn the feet of a movement into another lab."""
    return replace(course, heel_lab_m=course.heel_lab_m @ rotation.T, toe_lab_m=course.toe_lab_m @ rotation.T)


def body_course(motion: BodyMotion) -> BodyCourse | None:
    """Give what synchronization needs of the movement; None where too little of it is known, or the model has no feet."""
    model, found = motion.model, motion.motion
    if not {f"{part}_{side[0]}" for part in ("calcn", "toes") for side in FEET} <= set(model.bodies.names):
        return None
    q = complete(motion)
    if np.isfinite(q).all(axis=1).sum() < FEWEST_FRAMES:
        return None
    smooth = differentiate(found.times_s, q, CUTOFF_HZ)
    whole = solve_dynamics(model, smooth.q, smooth.velocity, smooth.acceleration)
    places_m = marker_positions(mark_soles(model), smooth.q).reshape(len(smooth.q), len(FEET), -1, 3)
    return BodyCourse(
        times_s=smooth.times_s,
        need_n=whole.net_force_n[:, 1],
        com_lab_m=whole.com_lab_m,
        heel_lab_m=places_m[:, :, HEEL],
        toe_lab_m=places_m[:, :, BALL],
        weight_n=model.weight_n,
    )


def _above_mat(sensors: Sensors, stream: PressureStream, course: BodyCourse, offset_s: float) -> PressureStream:
    """Read a mat again with the feet where the video has them; what soles measured stays."""
    if sensors.mat is None or sensors.mat_card is None or np.isnan(offset_s):
        return stream
    feet = FeetOnMat(course.times_s + offset_s, course.heel_lab_m, course.toe_lab_m)
    span_s = (float(feet.times_s[0]) - MARGIN_S, float(feet.times_s[-1]) + MARGIN_S)
    return read_pressure(sensors.mat, read_pressure_card(sensors.mat_card), span_s, stream.source, feet)


def in_newtons(stream: PressureStream, weight_n: float) -> PressureStream:
    """Scale a stream of counts so that both feet carry the body's weight in the mean; one in newtons stays."""
    if stream.in_newtons:
        return stream
    both = stream.pressure.vertical_n.sum(axis=1)
    scaled = stream.pressure.vertical_n * (weight_n / float(np.nanmean(both)))
    return replace(stream, pressure=replace(stream.pressure, vertical_n=scaled), in_newtons=True)


def _silent_sole(pressure: FootPressure, course: BodyCourse, offset_s: float) -> Finding | None:
    """Say that a sole without any load is not one of a foot in the air: the other foot does not carry the body alone."""
    silent = [side for foot, side in enumerate(FEET) if not np.nan_to_num(pressure.vertical_n[:, foot]).any()]
    lack = lacking_share(replace(pressure, times_s=pressure.times_s - offset_s), course)
    if not silent or lack <= LARGEST_LACK:
        return None
    return finding("pressure-foot-silent", where=" and ".join(silent), value=100 * lack)


def _judge_clock(
    clock: PressureClock, pressure: FootPressure, course: BodyCourse, parameters: Parameters
) -> tuple[float, tuple[Finding, ...]]:
    """Give the offset that is taken out, NaN where the stream is not used, and what is to be said of it."""
    if clock.swapped:
        return np.nan, (finding("pressure-feet-swapped"),)
    witnesses = f"±{1e3 * clock.sd_s:.0f} ms, from {counted(clock.events, 'contact|contacts')}"
    if parameters.forces.synchronization == "hardware":
        if clock.refused:
            return 0.0, (finding("pressure-hardware-unconfirmed", where=clock.refused),)
        late = abs(clock.offset_s) > max(LATE_S, 3 * clock.sd_s)
        return 0.0, (finding("pressure-hardware-late", value=1e3 * clock.offset_s),) if late else ()
    if clock.refused and is_idle(pressure, course, parameters.forces.search_s):
        return 0.0, (finding("pressure-clock-idle"),)
    if clock.refused:
        return np.nan, (finding("pressure-not-synchronized", where=clock.refused),)
    said = [finding("pressure-synchronized", where=witnesses, value=1e3 * clock.offset_s)]
    if clock.sd_s > DOUBTFUL_SD_S:
        where = (
            f"force says {1e3 * clock.force_offset_s:+.0f} ms, contact {1e3 * clock.contact_offset_s:+.0f} ms"
            if np.isfinite([clock.force_offset_s, clock.contact_offset_s]).all()
            else "only one kind of evidence was there"
        )
        said.append(finding("pressure-clock-doubtful", where=where, value=1e3 * clock.sd_s))
    return clock.offset_s, tuple(said)


def judge_pressure(
    stream: PressureStream, pressure: FootPressure, course: BodyCourse, *, known_mass: bool
) -> tuple[Finding, ...]:
    """Find what the reader has to know about the soles' values; ``pressure`` is on the video's clock, in newtons."""
    findings: list[Finding] = []
    times_s, shown = pressure.times_s, pressure.vertical_n
    blind = _unknown(pressure, course.times_s)
    unknown = 100 * float(blind.mean())
    if unknown > 1.0:
        severe, span_s = "serious" if unknown > 50 else None, longest_stretch(blind, course.times_s)
        findings.append(finding("pressure-gaps", value=unknown, severity=severe, span_s=span_s))
    period_s = float(np.median(np.diff(times_s)))
    if 1.0 / period_s < LOW_RATE_HZ:
        findings.append(finding("pressure-rate-low", where=f"±{500 * period_s:.0f} ms", value=1.0 / period_s))
    if not stream.in_newtons:
        findings.append(finding("pressure-uncalibrated"))
    for foot, side in enumerate(FEET):
        loaded = np.nan_to_num(shown[:, foot]) > 0.1 * course.weight_n
        saturated = 100 * float(stream.saturated[loaded, foot].mean()) if loaded.any() else 0.0
        if saturated > 0:
            span_s = longest_stretch(loaded & stream.saturated[:, foot], times_s)
            findings.append(finding("pressure-saturated", where=side, value=saturated, span_s=span_s))
        rest_n = _in_the_air_n(pressure, course, foot)
        if rest_n > NOT_ZERO_SHARE * course.weight_n:
            findings.append(finding("pressure-not-zero", where=side, value=rest_n))
    during = (times_s >= course.times_s[0]) & (times_s <= course.times_s[-1]) & np.isfinite(shown).all(axis=1)
    if stream.in_newtons and known_mass and during.sum() > 5:
        gain = float(shown[during].sum(axis=1).mean()) / course.weight_n
        if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
            severe = "serious" if not 0.6 <= gain <= 1.6 else None
            findings.append(finding("pressure-gain", value=100 * gain, severity=severe))
    return tuple(findings)


def judge_plates(plates: FootForces) -> tuple[Finding, ...]:
    """Find what the reader has to know about the plates."""
    if not (np.nan_to_num(plates.wrench[..., 1]) > 0).any():
        return (finding("plates-not-used"),)
    shared_s = float(plates.shared.sum() * np.median(np.diff(plates.times_s)))
    span_s = longest_stretch(plates.shared, plates.times_s)
    return (finding("plates-shared", value=shared_s, span_s=span_s),) if shared_s > 0 else ()


def _unknown(pressure: FootPressure, times_s: Float[np.ndarray, " frame"]) -> Bool[np.ndarray, " frame"]:
    """Mark the frames that lie between no two known samples."""
    after = np.searchsorted(pressure.times_s, times_s)
    inside = (after > 0) & (after < len(pressure.times_s))
    known = np.asarray(np.isfinite(pressure.vertical_n).all(axis=1))
    after = np.clip(after, 1, len(known) - 1)
    return ~(inside & known[after] & known[after - 1])


def _in_the_air_n(pressure: FootPressure, course: BodyCourse, foot: int) -> float:
    """Give what a sole shows in the median while its foot swings forwards; 0 if it never does.

    Forwards is where the foot points, so that one that a treadmill takes backwards does not count.
    """
    sole_m = (course.toe_lab_m[:, foot] - course.heel_lab_m[:, foot]) * [1.0, 0.0, 1.0]
    forwards = sole_m / np.maximum(np.linalg.norm(sole_m, axis=1, keepdims=True), 1e-6)
    heel_m_s = (np.gradient(course.heel_lab_m[:, foot], course.times_s, axis=0) * forwards).sum(axis=1)
    body_m_s = (np.gradient(course.com_lab_m, course.times_s, axis=0) * forwards).sum(axis=1)
    fast = heel_m_s > np.maximum(1.5 * body_m_s, 1.0)
    swings = np.interp(pressure.times_s, course.times_s, fast.astype(float), left=0.0, right=0.0) == 1.0
    shown = pressure.vertical_n[swings & np.isfinite(pressure.vertical_n[:, foot]), foot]
    return float(np.median(shown)) if shown.size >= 3 else 0.0
