"""What no pair of feet can have given: a stream with such values is refused, with the likely reason."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records import FEET

LEAST_N, MOST_N = 60.0, 20_000.0
"""Of both feet together, when they carry most: a body of 6 kg that stands, one of 200 kg that lands at ten times its weight."""

NEGATIVE = 0.05
"""Of a foot's usual largest value: noise about zero stays above minus that."""

MOST_NEGATIVE = 0.01
"""Share of samples below it: more are no spikes."""

IN_THE_AIR = 0.05
"""A foot whose usual largest value is so little of the other foot's stands nowhere: it needs no centre of pressure."""

SOLE_M = ((-0.05, 0.40), (-0.12, 0.12))
"""Where a centre of pressure can lie in the mean: along the sole from the heel, and across it from its middle line."""


def check_values(
    force: Float[np.ndarray, "sample foot"], cop_m: Float[np.ndarray, "sample foot 2"], in_newtons: bool, name: str
) -> float:
    """Refuse what can't be foot pressure; give the share of values below zero.

    Args:
        force: Of each foot, right and left: N, or counts where not ``in_newtons``. NaN where lost.
        cop_m: Along and across the sole; NaN where not known.
        in_newtons: Whether the unit of force is known.
        name: What the file is called.

    Raises:
        InputError: ``pressure-one-foot``, ``pressure-negative``, ``pressure-unit`` or ``pressure-cop``.
    """
    for foot, side in enumerate(FEET):
        known = force[np.isfinite(force[:, foot]), foot]
        if known.size < 2 or (
            np.ptp(known) == 0 and known[0] != 0
        ):  # always 0 is a foot in the air: the movement tells
            said = f"always shows {known[0]:g}" if known.size else "has no value"
            raise InputError(
                f"The {side} foot {said} in {name}.",
                hint="Check that both soles were on and that the card names the right columns. What the ground does to the "
                "body is known from both feet only.",
                code="pressure-one-foot",
            )
    known = force[np.isfinite(force)]
    largest = float(np.percentile(np.abs(known), 98))
    below = known < -NEGATIVE * largest
    if below.mean() > MOST_NEGATIVE:
        raise InputError(
            f"{100 * below.mean():.0f} % of the forces in {name} are negative, down to {known.min():.4g}.",
            hint="A sole can't pull: turn the sign round when you export it, or set the soles' zero while they are unloaded.",
            code="pressure-negative",
        )
    both = force.sum(axis=1)
    if in_newtons and np.isfinite(both).any():
        most_n = float(np.nanpercentile(both, 98))
        if not LEAST_N <= most_n <= MOST_N:
            raise InputError(
                f"Both feet together press with at most {most_n:.3g} N in {name}: that is {most_n / 9.81:.3g} kg.",
                hint="Check the unit of force in the card: N, kN, kgf or lbf; counts, if the soles are not calibrated.",
                code="pressure-unit",
            )
    _check_centres(force, cop_m, name)
    return float((known < 0).mean())


def _check_centres(
    force: Float[np.ndarray, "sample foot"], cop_m: Float[np.ndarray, "sample foot 2"], name: str
) -> None:
    largest = np.nanpercentile(force, 98, axis=0)
    for foot, side in enumerate(FEET):
        if largest[foot] <= IN_THE_AIR * largest.max():
            continue
        pressed = force[:, foot] > 0.3 * largest[foot]
        places_m = cop_m[pressed, foot]
        known = np.isfinite(places_m).all(axis=1)
        if known.mean() < 0.1:
            raise InputError(
                f"{name} has no centre of pressure of the {side} foot in {100 * (1 - known.mean()):.0f} % of its contacts.",
                hint="Export the centre of pressure too, or the values of the sensors with their places.",
                code="pressure-cop",
            )
        middle_m = np.median(places_m[known], axis=0)
        for value_m, (low_m, high_m), way in zip(middle_m, SOLE_M, ("before the heel", "to the right"), strict=True):
            if not low_m <= value_m <= high_m:
                raise InputError(
                    f"The {side} foot's centre of pressure in {name} lies {1e3 * value_m:.0f} mm {way}, in the median: not "
                    "on its sole.",
                    hint="Check the unit, the directions and the place of the heel in the card.",
                    code="pressure-cop",
                )
