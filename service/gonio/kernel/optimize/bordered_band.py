"""Solve large symmetric systems that are banded, with a border: a trial's frames, and what all frames share.

::

    | H   B | | x |   | g |     H: banded, positive definite (frames that know their neighbours)
    | B'  C | | y | = | h |     B, C: the border (parameters of the whole trial)

The cost is linear in the length of H. The band is kept as LAPACK keeps it, row by row transposed: ``rows[j, d]`` is the
element (j + d, j) of H, 0 ≤ d ≤ width. Cut into blocks of ``width`` rows such a band has full lower triangles on the
diagonal and upper triangles below them, each of which lies in memory as BLAS wants a matrix: no block is ever copied.

The inverse is wanted only near its diagonal, as covariances, and found there by Takahashi's recursion [Takahashi, Fagan &
Chin 1973; block form as in Rue & Held 2005, §2.4].
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.blas import dtrmm, dtrsm, get_blas_funcs
from scipy.linalg.lapack import dpbtrf, dpotrs, dtbtrs


@dataclass(frozen=True)
class BandFactor:
    """The Cholesky factor L of a band matrix, H = L L', laid out like the band."""

    rows: Float[np.ndarray, "unknown width_and_1"]

    @property
    def width(self) -> int:
        """How far from the diagonal the band reaches."""
        return self.rows.shape[1] - 1

    def solve(self, right: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " unknown"]:
        """Give ``H⁻¹ right``."""
        return self.solve_upper(self.solve_lower(right))

    def solve_lower(self, right: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " unknown"]:
        """Give ``L⁻¹ right``."""
        return dtbtrs(self.rows.T, right, uplo="L")[0]

    def solve_upper(self, right: Float[np.ndarray, " unknown"]) -> Float[np.ndarray, " unknown"]:
        """Give ``L⁻ᵀ right``."""
        return dtbtrs(self.rows.T, right, uplo="L", trans="T")[0]

    def overwrite_lower(self, right: Float[np.ndarray, "unknown column"]) -> None:
        """Replace many right sides, row-major, by ``L⁻¹ right``; single precision if they are."""
        trmm, trsm = get_blas_funcs(("trmm", "trsm"), dtype=right.dtype)
        factor = BandFactor(self.rows.astype(right.dtype, copy=False))
        blocks = self._cut(right)
        for i, own in enumerate(blocks):
            if i:
                own -= trmm(1.0, factor._below(i - 1), blocks[i - 1], side=1, lower=0, trans_a=1)
            trsm(1.0, factor._diagonal(i), own, side=1, lower=1, trans_a=1, overwrite_b=1)

    def overwrite_upper(self, right: Float[np.ndarray, "unknown column"]) -> None:
        """Replace many right sides, row-major, by ``L⁻ᵀ right``."""
        blocks = self._cut(right)
        for i in range(len(blocks) - 1, -1, -1):
            if i < len(blocks) - 1:
                blocks[i] -= dtrmm(1.0, self._below(i), blocks[i + 1], side=1, lower=0)
            dtrsm(1.0, self._diagonal(i), blocks[i], side=1, lower=1, overwrite_b=1)

    def inverse_blocks(self) -> Float[np.ndarray, "block width width"]:
        """Give the blocks of ``width`` rows on the diagonal of ``H⁻¹``.

        From the last to the first, ``P_i = L_i⁻ᵀ (1 + W_i' P_{i+1} W_i) L_i⁻¹`` with L_i on the diagonal, W_i below it.
        """
        count = len(self.rows) // self.width
        inverse = np.empty((count, self.width, self.width))
        for i in range(count - 1, -1, -1):
            own = np.eye(self.width, order="F")
            if i < count - 1:
                W = self._below(i)
                own += dtrmm(1.0, W, dtrmm(1.0, W, inverse[i + 1].T, side=1, lower=0), lower=0, trans_a=1)
            own = dtrsm(1.0, self._diagonal(i), own, lower=1, trans_a=1, overwrite_b=1)
            inverse[i] = dtrsm(1.0, self._diagonal(i), own, side=1, lower=1, overwrite_b=1).T  # symmetric
        return inverse

    def _cut(self, right: np.ndarray) -> list[np.ndarray]:
        """Cut right sides into blocks as BLAS, which counts by columns, sees them: transposed, in place."""
        return [right[start : start + self.width].T for start in range(0, len(right), self.width)]

    def _diagonal(self, block: int) -> np.ndarray:
        """Give a block on the diagonal; what stands above its diagonal is not part of it."""
        start = block * self.width * (self.width + 1)
        return self.rows.ravel()[start : start + self.width**2].reshape(self.width, self.width).T

    def _below(self, block: int) -> np.ndarray:
        """Give the block below one on the diagonal; what stands below its own diagonal is not part of it."""
        start = block * self.width * (self.width + 1) + self.width
        return self.rows.ravel()[start : start + self.width**2].reshape(self.width, self.width).T


def factorise(rows: Float[np.ndarray, "unknown width_and_1"]) -> BandFactor:
    """Factorise a band in place; its length is a multiple of its width.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    assert len(rows) % (rows.shape[1] - 1) == 0
    factor, trouble = dpbtrf(rows.T, lower=1, overwrite_ab=1)
    if trouble:
        raise np.linalg.LinAlgError(f"The leading minor of order {trouble} is not positive definite.")
    return BandFactor(factor.T)


@dataclass(frozen=True)
class BorderedFactor:
    """A factorised bordered system: ``carried = L⁻¹ B``, and the border's own factor, of Schur's complement."""

    inner: BandFactor
    carried: Float[np.ndarray, "unknown shared"]
    schur: Float[np.ndarray, "shared shared"]

    def solve(
        self, g: Float[np.ndarray, " unknown"], h: Float[np.ndarray, " shared"]
    ) -> tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, " shared"]]:
        """Give ``x`` and ``y``."""
        own, kind = self.inner.solve_lower(g), self.carried.dtype  # BLAS wants both sides of one kind
        y = dpotrs(self.schur, h - self.carried.T @ own.astype(kind), lower=1)[0]
        return self.inner.solve_upper(own - self.carried @ y.astype(kind)), y

    def border_inverse(self) -> Float[np.ndarray, "shared shared"]:
        """Give the border's block of the inverse."""
        own = solve_triangular(self.schur, np.eye(len(self.schur)), lower=True, check_finite=False)
        return own.T @ own


def factorise_bordered(
    rows: Float[np.ndarray, "unknown width_and_1"],
    border: Float[np.ndarray, "unknown shared"],
    corner: Float[np.ndarray, "shared shared"],
) -> BorderedFactor:
    """Factorise a bordered system; band and border are overwritten.

    A border of single precision halves the time, for nearly all of it is spent there; what is solved with it is good enough
    to go downhill by, not for a covariance.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    inner = factorise(rows)
    inner.overwrite_lower(border)
    left = corner - get_blas_funcs("syrk", dtype=border.dtype)(1.0, border.T, lower=1)  # the lower half alone is right
    return BorderedFactor(inner, border, cholesky(left, lower=True, check_finite=False, overwrite_a=True))
