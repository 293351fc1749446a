"""The scalar functions that couple a coordinate to the nodes of a joint, each as one piecewise polynomial.

Model files know many kinds of function (constant, linear, polynomial, splines). All of them are polynomials between
breaks, so the compiled solvers need to evaluate only one kind.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_banded

from gonio.records import Functions


class Pieces(NamedTuple):
    """One function before it is stacked with the others: see :class:`gonio.records.Functions` for the meaning."""

    piece_from: Float[np.ndarray, " piece"]
    origin: Float[np.ndarray, " piece"]
    coefficients: Float[np.ndarray, "piece power"]


def polynomial(ascending: Float[np.ndarray, " power"]) -> Pieces:
    """Make Σ ``ascending[k]`` xᵏ, everywhere: one piece. A constant and a straight line are its shortest cases."""
    return Pieces(np.array([-np.inf]), np.zeros(1), np.asarray(ascending, dtype=float).reshape(1, -1))


def piecewise_linear(x: Float[np.ndarray, " knot"], y: Float[np.ndarray, " knot"]) -> Pieces:
    """Join the knots (x ascending) by straight lines; the outer two go on for ever."""
    slope = np.diff(y) / np.diff(x)
    start = x[:-1].copy()
    start[0] = -np.inf
    return Pieces(start, x[:-1], np.stack([y[:-1], slope], axis=-1))


def simm_spline(x: Float[np.ndarray, " knot"], y: Float[np.ndarray, " knot"]) -> Pieces:
    """Make the cubic spline of SIMM and OpenSim (``SimmSpline``, in older files ``natCubicSpline``) through the knots.

    It is the spline of Forsythe, Malcolm & Moler (1977, "Computer methods for mathematical computations", ch. 4): its
    third derivative in the first and the last interval is that of the cubic through the first and the last four knots.
    It is therefore not a natural spline, in spite of the old name. Outside the knots it goes on straight.
    """
    count = len(x)
    if count < 3:
        return piecewise_linear(x, y)
    step, slope = np.diff(x), np.diff(y) / np.diff(x)
    # Unknown: s = S''/6 at the knots. Inside, the first derivative is continuous; the two outer rows fix the third one.
    lower, diagonal, upper, right = (np.zeros(count) for _ in range(4))
    diagonal[1:-1], upper[1:-1], lower[1:-1] = 2 * (step[:-1] + step[1:]), step[1:], step[:-1]
    diagonal[0], upper[0], lower[-1], diagonal[-1] = -1, 1, -1, 1
    right[1:-1] = np.diff(slope)
    if count > 3:
        right[0] = step[0] * _third_divided_difference(x[:4], y[:4])
        right[-1] = step[-1] * _third_divided_difference(x[-4:], y[-4:])
    bands = np.stack([np.roll(upper, 1), diagonal, np.roll(lower, -1)])
    s = solve_banded((1, 1), bands, right)
    first = slope - step * (2 * s[:-1] + s[1:])
    cubic = np.stack([y[:-1], first, 3 * s[:-1], np.diff(s) / step], axis=-1)
    last_slope = slope[-1] + step[-1] * (s[-2] + 2 * s[-1])
    return Pieces(
        np.concatenate([[-np.inf], x]),
        np.concatenate([x[:1], x]),
        np.concatenate([[[y[0], first[0], 0, 0]], cubic, [[y[-1], last_slope, 0, 0]]]),
    )


def _third_divided_difference(x: Float[np.ndarray, "4"], y: Float[np.ndarray, "4"]) -> float:
    first = np.diff(y) / np.diff(x)
    second = np.diff(first) / (x[2:] - x[:-2])
    return float((second[1] - second[0]) / (x[3] - x[0]))


def scaled(pieces: Pieces, factor: float) -> Pieces:
    """Multiply a function's values by a factor."""
    return pieces._replace(coefficients=pieces.coefficients * factor)


def stack(functions: list[Pieces]) -> Functions:
    """Lay functions one after the other, as the record wants them; short polynomials are padded with zeros."""
    width = max((pieces.coefficients.shape[1] for pieces in functions), default=1)
    padded = [np.pad(p.coefficients, ((0, 0), (0, width - p.coefficients.shape[1]))) for p in functions]
    return Functions(
        first_piece=np.cumsum([0] + [len(pieces.origin) for pieces in functions]),
        piece_from=np.concatenate([np.empty(0), *(pieces.piece_from for pieces in functions)]),
        origin=np.concatenate([np.empty(0), *(pieces.origin for pieces in functions)]),
        coefficients=np.concatenate([np.empty((0, width)), *padded]),
    )


def scale_function(functions: Functions, index: int, factor: float) -> Functions:
    """Multiply the values of one function of a stack by a factor."""
    coefficients = functions.coefficients.copy()
    coefficients[functions.pieces_of(index)] *= factor
    return Functions(
        first_piece=functions.first_piece,
        piece_from=functions.piece_from,
        origin=functions.origin,
        coefficients=coefficients,
    )
