"""Solve large symmetric systems that are block tridiagonal with a border: a trial's frames, and what all frames share.

::

    | H   B | | x |   | g |     H: block tridiagonal, positive definite (frames that know their neighbours)
    | B'  C | | y | = | h |     B, C: the border (parameters of the whole trial)

The cost is linear in the number of blocks. The inverse is wanted only near its diagonal, as covariances, and found there by
Takahashi's recursion [Takahashi, Fagan & Chin 1973; block form as in Rue & Held 2005, §2.4].
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.blas import dtrsm


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor of a block tridiagonal matrix: ``L_i`` on the diagonal, ``W_i`` below it."""

    diagonal: Float[np.ndarray, "block size size"]
    below: Float[np.ndarray, "blocks_less_1 size size"]

    def solve(self, right: Float[np.ndarray, "block size column"]) -> Float[np.ndarray, "block size column"]:
        """Give ``H⁻¹ right``."""
        return self.solve_upper(self.solve_lower(right))

    def solve_lower(self, right: Float[np.ndarray, "block size column"]) -> Float[np.ndarray, "block size column"]:
        """Give ``L⁻¹ right``, with ``H = L L'``."""
        x = np.array(right, order="C")
        for i in range(len(x)):
            if i:
                x[i] -= self.below[i - 1] @ x[i - 1]
            _solve_lower(self.diagonal[i], x[i])
        return x

    def solve_upper(self, right: Float[np.ndarray, "block size column"]) -> Float[np.ndarray, "block size column"]:
        """Give ``L⁻ᵀ right``."""
        x, last = np.array(right, order="C"), len(right) - 1
        for i in range(last, -1, -1):
            if i < last:
                x[i] -= self.below[i].T @ x[i + 1]
            _solve_lower(self.diagonal[i], x[i], transposed=True)
        return x

    def inverse_diagonal(self) -> Float[np.ndarray, "block size size"]:
        """Give the diagonal blocks of ``H⁻¹``."""
        blocks, size = self.diagonal.shape[:2]
        inverse = np.empty_like(self.diagonal)
        identity = np.eye(size)
        for i in range(blocks - 1, -1, -1):
            own = solve_triangular(self.diagonal[i], identity, lower=True, check_finite=False)
            inverse[i] = own.T @ own
            if i < blocks - 1:
                gain = own.T @ self.below[i].T  # L_i⁻ᵀ W_iᵀ
                inverse[i] += gain @ inverse[i + 1] @ gain.T
        return inverse


def factorise(
    diagonal: Float[np.ndarray, "block size size"], below: Float[np.ndarray, "blocks_less_1 size size"]
) -> Factor:
    """Factorise; ``below[i]`` is the block of rows i + 1 and columns i.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    L, W = np.empty_like(diagonal), np.array(below, order="C")
    for i in range(len(diagonal)):
        carried = diagonal[i] - W[i - 1] @ W[i - 1].T if i else diagonal[i]
        L[i] = cholesky(carried, lower=True, check_finite=False)
        if i < len(below):  # W L' = below
            dtrsm(1.0, L[i].T, W[i].T, lower=0, trans_a=1, overwrite_b=1)
    return Factor(L, W)


def _solve_lower(L: np.ndarray, right: np.ndarray, *, transposed: bool = False) -> None:
    """Replace ``right`` by ``L⁻¹ right``, or by ``L⁻ᵀ right``; both are row-major.

    BLAS itself, without checks and copies: the blocks are so small that those take longer. BLAS counts by columns, so what it
    sees of a row-major matrix is its transpose: it solves ``xᵀ Lᵀ = rightᵀ``, in place.
    """
    dtrsm(1.0, L.T, right.T, side=1, lower=0, trans_a=1 if transposed else 0, overwrite_b=1)


@dataclass(frozen=True)
class BorderedFactor:
    """A factorised bordered system: ``carried = L⁻¹ B``, and the border's own factor, of Schur's complement."""

    inner: Factor
    carried: Float[np.ndarray, "block size shared"]
    schur: Float[np.ndarray, "shared shared"]

    def solve(
        self, g: Float[np.ndarray, "block size"], h: Float[np.ndarray, " shared"]
    ) -> tuple[Float[np.ndarray, "block size"], Float[np.ndarray, " shared"]]:
        """Give ``x`` and ``y``."""
        own = self.inner.solve_lower(g[..., None])[..., 0]
        rest = h - self.carried.reshape(-1, len(h)).T @ own.ravel()
        y = solve_triangular(self.schur, rest, lower=True, check_finite=False)
        y = solve_triangular(self.schur, y, lower=True, trans="T", check_finite=False)
        return self.inner.solve_upper((own - self.carried @ y)[..., None])[..., 0], y

    def border_inverse(self) -> Float[np.ndarray, "shared shared"]:
        """Give the border's block of the inverse."""
        own = solve_triangular(self.schur, np.eye(len(self.schur)), lower=True, check_finite=False)
        return own.T @ own


def factorise_bordered(
    diagonal: Float[np.ndarray, "block size size"],
    below: Float[np.ndarray, "blocks_less_1 size size"],
    border: Float[np.ndarray, "block size shared"],
    corner: Float[np.ndarray, "shared shared"],
) -> BorderedFactor:
    """Factorise a bordered system.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    inner = factorise(diagonal, below)
    carried = inner.solve_lower(border)
    flat = carried.reshape(-1, len(corner))
    return BorderedFactor(inner, carried, cholesky(corner - flat.T @ flat, lower=True, check_finite=False))
