"""Symmetric positive definite systems with a narrow band, compiled: factorise, solve, and the inverse within the band.

A matrix is kept by its lower band: ``band[i, d]`` is the entry of row i and column i − d. The cost is linear in the number of
rows. The inverse's entries within the band follow from the factor by Takahashi's recursion [Takahashi, Fagan & Chin 1973].
"""

import numpy as np
from numba import njit

from gonio.kernel.body.tree import Array


@njit(cache=True, nogil=True, error_model="numpy")
def factorise(band: Array) -> bool:
    """Replace a band by its Cholesky factor's; False if the matrix is not positive definite."""
    rows, width = band.shape
    for i in range(rows):
        for d in range(min(i, width - 1), -1, -1):
            j = i - d
            entry = band[i, d]
            for k in range(max(0, i - width + 1), j):
                entry -= band[i, i - k] * band[j, j - k]
            if d > 0:
                band[i, d] = entry / band[j, 0]
            elif entry > 0.0:
                band[i, 0] = np.sqrt(entry)
            else:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def substitute(factor: Array, right: Array) -> None:
    """Solve with a factor, in place."""
    rows, width = factor.shape
    for i in range(rows):
        entry = right[i]
        for d in range(1, min(i, width - 1) + 1):
            entry -= factor[i, d] * right[i - d]
        right[i] = entry / factor[i, 0]
    for i in range(rows - 1, -1, -1):
        entry = right[i]
        for d in range(1, min(rows - 1 - i, width - 1) + 1):
            entry -= factor[i + d, d] * right[i + d]
        right[i] = entry / factor[i, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def substitute_forward(factor: Array, right: Array) -> None:
    """Multiply columns (row, column) by the inverse of a factor, in place: the first half of solving."""
    rows, width = factor.shape
    for i in range(rows):
        for d in range(1, min(i, width - 1) + 1):
            for c in range(right.shape[1]):
                right[i, c] -= factor[i, d] * right[i - d, c]
        for c in range(right.shape[1]):
            right[i, c] /= factor[i, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def substitute_back(factor: Array, right: Array) -> None:
    """Multiply columns (row, column) by the inverse of a factor's transpose, in place: the second half."""
    rows, width = factor.shape
    for i in range(rows - 1, -1, -1):
        for d in range(1, min(rows - 1 - i, width - 1) + 1):
            for c in range(right.shape[1]):
                right[i, c] -= factor[i + d, d] * right[i + d, c]
        for c in range(right.shape[1]):
            right[i, c] /= factor[i, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def invert_within(factor: Array, inverse: Array) -> None:
    """Fill the entries of the inverse that lie within the band."""
    rows, width = factor.shape
    for i in range(rows - 1, -1, -1):
        reach = min(width - 1, rows - 1 - i)
        for d in range(reach, -1, -1):
            j = i + d  # the entry of row j and column i
            total = 1.0 / factor[i, 0] if d == 0 else 0.0
            for k in range(1, reach + 1):
                row = i + k
                low, high = min(row, j), max(row, j)
                total -= factor[row, k] * inverse[high, high - low]
            inverse[j, d] = total / factor[i, 0]
