"""OpenSim's functions of a coordinate, read as piecewise polynomials."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.osim_xml import Element, describe, number, numbers
from gonio.kernel.body import functions as make
from gonio.kernel.body.functions import Pieces

_SIMM_SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")  # OpenSim renames the last two to the first
_KNOWN = ("Constant", "LinearFunction", "PolynomialFunction", "PiecewiseLinearFunction", *_SIMM_SPLINES)


def read_function(element: Element) -> Pieces:
    """Read a function of one variable.

    Raises:
        InputError: a kind that gonio can't honour exactly, or numbers that make no function; both name the element.
    """
    if element.tag == "Constant":
        return make.polynomial(np.array([number(element, "value", 0.0)]))
    if element.tag == "LinearFunction":
        slope, intercept = linear_coefficients(element, 1)
        return make.polynomial(np.array([intercept, slope]))
    if element.tag == "PolynomialFunction":
        return make.polynomial(_some(numbers(element, "coefficients"), element)[::-1])
    if element.tag in _SIMM_SPLINES:
        return make.simm_spline(*_knots(element))
    if element.tag == "PiecewiseLinearFunction":
        return make.piecewise_linear(*_knots(element))
    if element.tag == "MultiplierFunction":
        return make.scaled(read_function(inner_function(element)), number(element, "scale", 1.0))
    raise InputError(
        f"{describe(element)} is a kind of function that gonio does not know.",
        hint=f"Express it by one of {', '.join(_KNOWN)} or MultiplierFunction.",
    )


def linear_coefficients(element: Element, variables: int) -> Float[np.ndarray, " coefficient"]:
    """Read a LinearFunction's slopes, one per variable, and its intercept."""
    coefficients = numbers(element, "coefficients")
    if len(coefficients) == 0 and variables == 1:
        return np.array([1.0, 0.0])
    if len(coefficients) != variables + 1:
        raise InputError(
            f"{describe(element)} has {len(coefficients)} coefficients for {variables} coordinates.",
            hint="A linear function has one slope for each coordinate, then the intercept.",
        )
    return coefficients


def inner_function(element: Element) -> Element:
    """Find the function inside a MultiplierFunction or an older file's ``<function>``."""
    holder = element.find("function")
    if holder is None or len(holder) != 1:
        raise InputError(f"{describe(element)} holds no function.", hint="Give it one.")
    return holder[0]


def _knots(element: Element) -> tuple[Float[np.ndarray, " knot"], Float[np.ndarray, " knot"]]:
    x, y = numbers(element, "x"), numbers(element, "y")
    if len(x) != len(y) or len(x) < 2 or np.any(np.diff(x) <= 0):
        raise InputError(
            f"{describe(element)} has {len(x)} values of x, {len(y)} of y.",
            hint="A spline needs at least two knots, one y for each x, and x in ascending order.",
        )
    return x, y


def _some(values: Float[np.ndarray, " number"], element: Element) -> Float[np.ndarray, " number"]:
    if len(values) == 0:
        raise InputError(f"{describe(element)} has no coefficients.", hint="Give at least one.")
    return values
