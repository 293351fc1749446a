from itertools import pairwise

import numpy as np
import pytest

from gonio.kernel.optimize.block_tridiagonal import factorise, factorise_bordered

BLOCKS, SIZE, SHARED = 6, 4, 3


def system(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A random positive definite bordered system: its parts, and the whole as a dense matrix."""
    rng = np.random.default_rng(seed)
    n = BLOCKS * SIZE
    dense = np.zeros((n + SHARED, n + SHARED))
    for i in range(BLOCKS):  # a sum of outer products, each of which touches two neighbouring blocks and the border
        rows = slice(i * SIZE, min((i + 2) * SIZE, n))
        touched = np.r_[np.arange(n)[rows], np.arange(n, n + SHARED)]
        root = rng.normal(size=(len(touched), len(touched) + 2))
        dense[np.ix_(touched, touched)] += root @ root.T
    blocks = [slice(i * SIZE, (i + 1) * SIZE) for i in range(BLOCKS)]
    diagonal = np.stack([dense[b, b] for b in blocks])
    below = np.stack([dense[b, a] for a, b in pairwise(blocks)])
    border = np.stack([dense[b, n:] for b in blocks])
    return dense, diagonal, below, border, dense[n:, n:]


@pytest.mark.parametrize("seed", range(5))
def test_the_solution_and_the_border_of_the_inverse_are_those_of_the_dense_matrix(seed: int) -> None:
    dense, diagonal, below, border, corner = system(seed)
    n = BLOCKS * SIZE
    right = np.random.default_rng(seed + 100).normal(size=n + SHARED)
    factor = factorise_bordered(diagonal, below, border, corner)
    x, y = factor.solve(right[:n].reshape(BLOCKS, SIZE), right[n:])
    np.testing.assert_allclose(np.r_[x.ravel(), y], np.linalg.solve(dense, right), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(factor.border_inverse(), np.linalg.inv(dense)[n:, n:], rtol=1e-7, atol=1e-10)


def test_without_a_border(seed: int = 3) -> None:
    dense, diagonal, below, *_ = system(seed)
    n = BLOCKS * SIZE
    inner = dense[:n, :n]
    factor = factorise(diagonal, below)
    right = np.random.default_rng(1).normal(size=(BLOCKS, SIZE, 2))
    np.testing.assert_allclose(
        factor.solve(right).reshape(n, 2), np.linalg.solve(inner, right.reshape(n, 2)), rtol=1e-8, atol=1e-10
    )
    inverse = np.linalg.inv(inner)
    np.testing.assert_allclose(factor.inverse_diagonal()[2], inverse[8:12, 8:12], rtol=1e-8)


def test_what_is_not_positive_definite_is_refused() -> None:
    _, diagonal, below, *_ = system(1)
    with pytest.raises(np.linalg.LinAlgError):
        factorise(-diagonal, below)
