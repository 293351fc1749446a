"""The normal equations of one joint with its points eliminated, and its loss: scalar code that numba compiles.

What a descent does thousands of times, for all starts at once; :mod:`gonio.kernel.articulated.bundle` says what is minimised.
A start's points are left out one by one (Schur's complement): each couples only the pictures that show it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit


class Marks(NamedTuple):
    """Cameras and marks of one part as plain arrays.

    ``used`` are the marks that are seen, ``floor`` those that stand on the floor. ``plane`` is the floor's normal and offset by
    its standard deviation; ``f`` and ``uv`` are the focal lengths and marks by the marks' noise.
    """

    R_cam: np.ndarray
    o_m: np.ndarray
    f: np.ndarray
    uv: np.ndarray
    used: np.ndarray
    floor: np.ndarray
    plane: np.ndarray


class Reduced(NamedTuple):
    """What is left for the twists of the pictures, and the way back to the points.

    ``S`` and ``right`` are the reduced system, ``own`` each picture's block before the points were eliminated; ``inner`` are
    the points' inverted blocks, ``gx`` their gradients, ``coupling`` their blocks with each picture's twist.
    """

    S: Float[np.ndarray, "start twist twist"]
    right: Float[np.ndarray, "start twist"]
    own: Float[np.ndarray, "start picture 6 6"]
    inner: Float[np.ndarray, "start point 3 3"]
    gx: Float[np.ndarray, "start point 3"]
    coupling: Float[np.ndarray, "start point picture 6 3"]


@njit(cache=True, nogil=True, error_model="numpy")
def sum_losses(
    marks: Marks, R: np.ndarray, t: np.ndarray, x_m: np.ndarray, huber: float, nearest_m: float
) -> Float[np.ndarray, " start"]:
    """Sum Huber's loss of each mark's distance and the floor's squares, once a start; infinite with a point behind a camera."""
    starts, points = x_m.shape[:2]
    out = np.zeros(starts)
    for s in range(starts):
        for i in range(len(marks.o_m)):
            A, Y0 = marks.R_cam[i], t[s, i]
            for k in range(points):
                if not (marks.used[i, k] or marks.floor[i, k]):
                    continue
                X = x_m[s, k]
                Y = np.empty(3)
                for a in range(3):
                    Y[a] = R[s, i, a, 0] * X[0] + R[s, i, a, 1] * X[1] + R[s, i, a, 2] * X[2] + Y0[a]
                if marks.used[i, k]:
                    d0, d1, d2 = Y[0] - marks.o_m[i, 0], Y[1] - marks.o_m[i, 1], Y[2] - marks.o_m[i, 2]
                    z = A[2, 0] * d0 + A[2, 1] * d1 + A[2, 2] * d2
                    if not z >= nearest_m:
                        out[s] = np.inf
                        continue
                    u = marks.f[i, 0] * (A[0, 0] * d0 + A[0, 1] * d1 + A[0, 2] * d2) / z - marks.uv[i, k, 0]
                    v = marks.f[i, 1] * (A[1, 0] * d0 + A[1, 1] * d1 + A[1, 2] * d2) / z - marks.uv[i, k, 1]
                    size = np.sqrt(u * u + v * v)
                    out[s] += size * size if size <= huber else 2 * huber * size - huber * huber
                if marks.floor[i, k]:
                    out[s] += (
                        marks.plane[0] * Y[0] + marks.plane[1] * Y[1] + marks.plane[2] * Y[2] - marks.plane[3]
                    ) ** 2
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_points(
    marks: Marks, R: np.ndarray, t: np.ndarray, x_m: np.ndarray, damping: np.ndarray, huber: float
) -> Reduced:
    """Build the normal equations of each start, its points' blocks damped, and eliminate the points.

    No point may be behind a camera that shows it.
    """
    starts, points = x_m.shape[:2]
    pictures = len(marks.o_m)
    S, right = np.zeros((starts, 6 * pictures, 6 * pictures)), np.zeros((starts, 6 * pictures))
    own, inner = np.zeros((starts, pictures, 6, 6)), np.zeros((starts, points, 3, 3))
    gx, coupling = np.zeros((starts, points, 3)), np.zeros((starts, points, pictures, 6, 3))
    for s in range(starts):
        for k in range(points):
            xx = np.zeros((3, 3))
            for i in range(pictures):
                if marks.used[i, k] or marks.floor[i, k]:
                    _add_mark(marks, i, k, R[s, i], t[s, i], x_m[s, k], huber, xx, gx[s, k],
                              coupling[s, k, i], own[s, i], right[s, 6 * i : 6 * i + 6])  # fmt: skip
            for a in range(3):
                xx[a, a] = xx[a, a] * (1 + damping[s]) + 1e-9
            _invert(xx, inner[s, k])
            _eliminate(marks, k, inner[s, k], gx[s, k], coupling[s, k], S[s], right[s])
        for i in range(pictures):
            S[s, 6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += own[s, i]
    return Reduced(S, right, own, inner, gx, coupling)


@njit(cache=True, nogil=True, error_model="numpy")
def steps_of_points(reduced: Reduced, twist: np.ndarray) -> Float[np.ndarray, "start point 3"]:
    """Give each point's step once the pictures' twists, ``(start, picture, 6)``, are known."""
    starts, points, pictures = reduced.coupling.shape[:3]
    out = np.zeros((starts, points, 3))
    for s in range(starts):
        for k in range(points):
            left = -reduced.gx[s, k]
            for i in range(pictures):
                for a in range(6):
                    for b in range(3):
                        left[b] -= reduced.coupling[s, k, i, a, b] * twist[s, i, a]
            for a in range(3):
                for b in range(3):
                    out[s, k, a] += reduced.inner[s, k, a, b] * left[b]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _add_mark(  # noqa: C901, PLR0913 - numba unrolls these loops; arrays to be filled are arguments
    marks: Marks, i: int, k: int, R: np.ndarray, t: np.ndarray, X: np.ndarray, huber: float,
    xx: np.ndarray, gx: np.ndarray, coupling: np.ndarray, own: np.ndarray, right: np.ndarray,
) -> None:  # fmt: skip
    A = marks.R_cam[i]
    Y, d, r, slope = np.empty(3), np.empty(3), np.zeros(3), np.zeros((3, 3))
    for a in range(3):
        Y[a] = R[a, 0] * X[0] + R[a, 1] * X[1] + R[a, 2] * X[2] + t[a]
        d[a] = Y[a] - marks.o_m[i, a]
    if marks.used[i, k]:
        z = A[2, 0] * d[0] + A[2, 1] * d[1] + A[2, 2] * d[2]
        for row in range(2):
            along = (A[row, 0] * d[0] + A[row, 1] * d[1] + A[row, 2] * d[2]) / z
            r[row] = marks.f[i, row] * along - marks.uv[i, k, row]
            for a in range(3):
                slope[row, a] = marks.f[i, row] / z * (A[row, a] - along * A[2, a])
        size = np.sqrt(r[0] * r[0] + r[1] * r[1])
        if size > huber:  # a far mark counts linearly
            root = np.sqrt(huber / size)
            r[0] *= root
            r[1] *= root
            slope[:2] *= root
    if marks.floor[i, k]:
        r[2] = marks.plane[0] * Y[0] + marks.plane[1] * Y[1] + marks.plane[2] * Y[2] - marks.plane[3]
        slope[2] = marks.plane[:3]
    by_t, by_x = np.empty(6), np.empty(3)
    for row in range(3 if marks.floor[i, k] else 2):
        g = slope[row]
        # dY = w × Y + v: the slope by w is Y × g.
        by_t[0], by_t[1], by_t[2] = Y[1] * g[2] - Y[2] * g[1], Y[2] * g[0] - Y[0] * g[2], Y[0] * g[1] - Y[1] * g[0]
        by_t[3:] = g
        for a in range(3):
            by_x[a] = g[0] * R[0, a] + g[1] * R[1, a] + g[2] * R[2, a]
        for a in range(6):
            right[a] -= by_t[a] * r[row]
            for b in range(6):
                own[a, b] += by_t[a] * by_t[b]
            for b in range(3):
                coupling[a, b] += by_t[a] * by_x[b]
        for a in range(3):
            gx[a] += by_x[a] * r[row]
            for b in range(3):
                xx[a, b] += by_x[a] * by_x[b]


@njit(cache=True, nogil=True, error_model="numpy")
def _invert(m: np.ndarray, out: np.ndarray) -> None:
    """Invert a symmetric 3 × 3 matrix by its cofactors."""
    out[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    out[0, 1] = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    out[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    out[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    out[1, 2] = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    out[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    determinant = m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2]
    for a in range(3):
        for b in range(a, 3):
            out[a, b] /= determinant
            out[b, a] = out[a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(
    marks: Marks, k: int, inner: np.ndarray, gx: np.ndarray, coupling: np.ndarray, S: np.ndarray, right: np.ndarray
) -> None:
    pictures = len(coupling)
    half = np.empty((6, 3))
    for i in range(pictures):
        if not (marks.used[i, k] or marks.floor[i, k]):
            continue
        for a in range(6):
            for b in range(3):
                half[a, b] = (
                    coupling[i, a, 0] * inner[0, b] + coupling[i, a, 1] * inner[1, b] + coupling[i, a, 2] * inner[2, b]
                )
            right[6 * i + a] += half[a, 0] * gx[0] + half[a, 1] * gx[1] + half[a, 2] * gx[2]
        for j in range(pictures):
            if not (marks.used[j, k] or marks.floor[j, k]):
                continue
            for a in range(6):
                for b in range(6):
                    S[6 * i + a, 6 * j + b] -= (
                        half[a, 0] * coupling[j, b, 0] + half[a, 1] * coupling[j, b, 1] + half[a, 2] * coupling[j, b, 2]
                    )
