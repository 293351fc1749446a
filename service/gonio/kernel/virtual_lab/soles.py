"""Pressure soles: vertical force and centre of pressure of each foot, as cheap insoles report them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.kernel.body.forward import body_poses
from gonio.kernel.body.soles import measure_sole
from gonio.kernel.virtual_lab.chance import correlated, spells, stream
from gonio.kernel.virtual_lab.walker import truth_at
from gonio.records import FEET, BodyModel, FootPressure, VirtualPressure, Walk

LEAST_N = 10.0
"""Below this force a sole reports no centre of pressure."""

TOE_SHARE, TOE_SHIFT_M = 0.3, 0.03
"""What a sole without sensors under the toes misses at push-off: so much of the force, and its centre that far back."""


@dataclass(frozen=True)
class SoleErrors:
    """What is wrong with a pair of soles. Standard deviations, where nothing else is said; 0 is: nothing.

    ``gain`` differs between the feet and stays, ``gain_drift`` is how it wanders within minutes; ``zero_n`` is a wandering
    offset under load; ``saturation_n`` the most that a sole can show, ``quantum_n`` and ``quantum_m`` its steps. ``gaps`` is
    the share of samples that are lost, in stretches of ``gap_s``. ``offset_s`` is how far the soles' clock runs ahead of the
    cameras', exactly; ``jitter_s`` how irregular the samples are.
    """

    gain: float = 0.0
    gain_drift: float = 0.0
    zero_n: float = 0.0
    force_noise_n: float = 0.0
    cop_bias_m: float = 0.0
    cop_noise_m: float = 0.0
    toes_missing: bool = False
    saturation_n: float = np.inf
    quantum_n: float = 0.0
    quantum_m: float = 0.0
    offset_s: float = 0.0
    jitter_s: float = 0.0
    gaps: float = 0.0
    gap_s: tuple[float, float] = (0.2, 0.7)


SOLES: Mapping[str, SoleErrors] = {
    "clean": SoleErrors(),
    "good": SoleErrors(
        gain=0.03, cop_bias_m=0.003, cop_noise_m=0.003, force_noise_n=10.0, offset_s=0.020, jitter_s=0.002
    ),
    "realistic": SoleErrors(
        gain=0.05,
        gain_drift=0.01,
        zero_n=5.0,
        force_noise_n=10.0,
        cop_bias_m=0.005,
        cop_noise_m=0.003,
        quantum_n=2.0,
        quantum_m=0.001,
        offset_s=0.050,
        jitter_s=0.005,
        gaps=0.02,
    ),
    "poor": SoleErrors(
        gain=0.10,
        gain_drift=0.03,
        zero_n=10.0,
        force_noise_n=20.0,
        cop_bias_m=0.010,
        cop_noise_m=0.005,
        toes_missing=True,
        saturation_n=1000.0,
        quantum_n=10.0,
        quantum_m=0.005,
        offset_s=-0.120,
        jitter_s=0.015,
        gaps=0.10,
    ),
}
"""From perfect to a messy stream such as real insoles give: irregular, with gaps of up to 0.7 s."""


def press(
    walk: Walk,
    *,
    errors: SoleErrors = SOLES["realistic"],
    rate_hz: float = 20.0,
    duration_s: float | None = None,
    seed: int = 0,
) -> VirtualPressure:
    """Let soles measure a walk, from its time 0 on.

    Args:
        walk: The walk.
        errors: What is wrong with the soles: one of :data:`SOLES`, or your own.
        rate_hz: Of the samples, on average.
        duration_s: How long; None as long as :func:`gonio.kernel.virtual_lab.film.film` films.
        seed: Of everything random.

    Raises:
        InputError: a stream of no length.
    """
    if duration_s is None:
        duration_s = -2.0 * walk.start_m / walk.steps.speed_m_s
    samples = round(duration_s * rate_hz)
    if samples < 2:
        raise InputError(f"A stream of {duration_s:.3f} s has no two samples.", hint="Give a longer duration.")
    # Jitter never changes the order of two samples: at most 0.4 of a period each way.
    jitter = np.clip(errors.jitter_s * stream(seed, "jitter", 0).standard_normal(samples) * rate_hz, -0.4, 0.4)
    times_s = (np.arange(samples) + jitter) / rate_hz
    truth = truth_at(walk, times_s)
    vertical_n = truth.wrench[..., 1]
    cop_m = cop_on_soles(walk.body, truth.q, truth.cop_lab_m)
    reports = [_report(vertical_n[:, foot], cop_m[:, foot], walk, errors, rate_hz, foot, seed) for foot in range(2)]
    lost = np.zeros(samples, dtype=bool)
    for gap in spells(stream(seed, "gaps", 0), samples, rate_hz, errors.gaps, errors.gap_s):
        lost[gap] = True
    reported_n, reported_m = (np.stack([report[part] for report in reports], axis=1) for part in (0, 1))
    reported_n[lost], reported_m[lost] = np.nan, np.nan
    return VirtualPressure(
        pressure=FootPressure(times_s=times_s + errors.offset_s, vertical_n=reported_n, cop_foot_m=reported_m),
        times_s=times_s,
        vertical_n=vertical_n,
        cop_foot_m=cop_m,
        gain=np.array([_gain(errors, foot, seed) for foot in range(2)]),
        offset_s=errors.offset_s,
    )


def cop_on_soles(
    body: BodyModel, q: Float[np.ndarray, "sample coordinate"], cop_lab_m: Float[np.ndarray, "sample foot 3"]
) -> Float[np.ndarray, "sample foot 2"]:
    """Give where on the soles the lab's centres of pressure lie: along from the heel, and across to the right.

    A sole bends at the toe joint: beyond it the place is measured in the toes, and added to the joint's.
    """
    T_lab_body, ball_m = body_poses(body, q), measure_sole(body).ball_m
    places = np.empty((len(q), len(FEET), 2))
    for foot, side in enumerate(FEET):
        heel, toes = (T_lab_body[:, body.bodies.index(f"{name}_{side[0]}")] for name in ("calcn", "toes"))
        in_heel, in_toes = (
            np.einsum("sji,sj->si", T[:, :3, :3], cop_lab_m[:, foot] - T[:, :3, 3])[:, [0, 2]] for T in (heel, toes)
        )
        beyond = in_heel[:, :1] > ball_m[foot, 0]
        places[:, foot] = np.where(beyond, ball_m[foot, [0, 2]] + in_toes, in_heel)
    return places


def _report(
    vertical_n: Float[np.ndarray, " sample"],
    cop_m: Float[np.ndarray, "sample 2"],
    walk: Walk,
    errors: SoleErrors,
    rate_hz: float,
    foot: int,
    seed: int,
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, "sample 2"]]:
    """Give what one sole shows of a force and its place."""
    samples = len(vertical_n)
    shown_n, shown_m = vertical_n.copy(), cop_m.copy()
    if errors.toes_missing:
        ball_m = measure_sole(walk.body).length_m
        on_toes = np.clip(
            np.nan_to_num(cop_m[:, 0] / ball_m - 0.7) / 0.4, 0.0, 1.0
        )  # all of it 10 % past the toe joint
        shown_n *= 1.0 - TOE_SHARE * on_toes
        shown_m[:, 0] -= TOE_SHIFT_M * on_toes
    drift = correlated(stream(seed, "drift", foot), (samples, 2), rate_hz, 60.0)
    shown_n *= _gain(errors, foot, seed) + errors.gain_drift * drift[:, 0]
    loaded = vertical_n > 0
    shown_n += np.where(loaded, errors.zero_n * drift[:, 1], 0.0)
    shown_n += np.where(loaded, errors.force_noise_n * stream(seed, "force", foot).standard_normal(samples), 0.0)
    place = stream(seed, "place", foot)
    shown_m += errors.cop_bias_m * place.standard_normal(2) + errors.cop_noise_m * place.standard_normal((samples, 2))
    shown_n = np.clip(_step(shown_n, errors.quantum_n), 0.0, errors.saturation_n)
    shown_m = np.where(shown_n[:, None] > LEAST_N, _step(shown_m, errors.quantum_m), np.nan)
    return shown_n, shown_m


def _gain(errors: SoleErrors, foot: int, seed: int) -> float:
    return 1.0 + errors.gain * float(stream(seed, "gain", foot).standard_normal())


def _step(values: np.ndarray, quantum: float) -> np.ndarray:
    return np.round(values / quantum) * quantum if quantum > 0 else values
