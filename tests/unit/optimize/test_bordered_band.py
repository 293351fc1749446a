import numpy as np
import pytest

from gonio.kernel.optimize.bordered_band import factorise, factorise_bordered

BLOCKS, WIDTH, SHARED = 5, 4, 3
LENGTH = BLOCKS * WIDTH


def system(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A random positive definite bordered band: the whole as a dense matrix, and its parts."""
    rng = np.random.default_rng(seed)
    dense = np.zeros((LENGTH + SHARED, LENGTH + SHARED))
    for first in range(LENGTH):  # a sum of outer products, each of which touches what the band reaches, and the border
        touched = np.r_[first : min(first + WIDTH + 1, LENGTH), LENGTH : LENGTH + SHARED]
        root = rng.normal(size=(len(touched), 3))
        dense[np.ix_(touched, touched)] += root @ root.T
    rows = np.full((LENGTH, WIDTH + 1), np.nan)  # what lies beyond the end is nobody's
    for d in range(WIDTH + 1):
        rows[: LENGTH - d, d] = np.diagonal(dense[:LENGTH, :LENGTH], -d)
    return dense, rows, dense[:LENGTH, LENGTH:].copy(), dense[LENGTH:, LENGTH:].copy()


@pytest.mark.parametrize("seed", range(5))
def test_the_solution_and_the_border_of_the_inverse_are_those_of_the_dense_matrix(seed: int) -> None:
    dense, rows, border, corner = system(seed)
    right = np.random.default_rng(seed + 100).normal(size=LENGTH + SHARED)
    factor = factorise_bordered(rows, border, corner)
    x, y = factor.solve(right[:LENGTH], right[LENGTH:])
    np.testing.assert_allclose(np.r_[x, y], np.linalg.solve(dense, right), rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(factor.border_inverse(), np.linalg.inv(dense)[LENGTH:, LENGTH:], rtol=1e-7, atol=1e-10)


def test_without_a_border(seed: int = 3) -> None:
    dense, rows, *_ = system(seed)
    inverse = np.linalg.inv(dense[:LENGTH, :LENGTH])
    factor = factorise(rows)
    right = np.random.default_rng(1).normal(size=(LENGTH, 2))
    np.testing.assert_allclose(factor.solve(right[:, 0]), inverse @ right[:, 0], rtol=1e-8, atol=1e-10)
    many = right.copy()
    factor.overwrite_lower(many)
    factor.overwrite_upper(many)
    np.testing.assert_allclose(many, inverse @ right, rtol=1e-8, atol=1e-10)
    for block, found in enumerate(factor.inverse_blocks()):
        own = slice(block * WIDTH, (block + 1) * WIDTH)
        np.testing.assert_allclose(found, inverse[own, own], rtol=1e-8, atol=1e-12)


def test_what_is_not_positive_definite_is_refused() -> None:
    _, rows, *_ = system(1)
    with pytest.raises(np.linalg.LinAlgError):
        factorise(-rows)
