import numpy as np
import pytest

from gonio.kernel.optimize.banded import factorise, invert_within, substitute, substitute_back, substitute_forward


@pytest.mark.parametrize(("rows", "width"), [(1, 1), (5, 2), (40, 7), (30, 30)])
def test_factor_solution_and_inverse_are_those_of_the_dense_matrix(rows: int, width: int) -> None:
    rng = np.random.default_rng(rows)
    root = np.tril(rng.normal(size=(rows, rows)), 0)
    root[np.subtract.outer(np.arange(rows), np.arange(rows)) >= width] = 0.0
    root[np.diag_indices(rows)] = 1.0 + rng.random(rows)
    dense = root @ root.T
    band = np.zeros((rows, width))
    for i in range(rows):
        for d in range(min(i, width - 1) + 1):
            band[i, d] = dense[i, i - d]
    right = rng.normal(size=rows)
    expected = np.linalg.solve(dense, right)
    assert factorise(band)
    substitute(band, right)
    np.testing.assert_allclose(right, expected, rtol=1e-8, atol=1e-10)
    columns = rng.normal(size=(rows, 3))
    solved = np.linalg.solve(dense, columns)
    squares = columns.T @ solved
    substitute_forward(band, columns)
    np.testing.assert_allclose(columns.T @ columns, squares, rtol=1e-8, atol=1e-10)
    substitute_back(band, columns)
    np.testing.assert_allclose(columns, solved, rtol=1e-8, atol=1e-10)
    inverse = np.zeros_like(band)
    invert_within(band, inverse)
    whole = np.linalg.inv(dense)
    for i in range(rows):
        for d in range(min(i, width - 1) + 1):
            assert inverse[i, d] == pytest.approx(whole[i, i - d], rel=1e-7, abs=1e-9)


def test_what_is_not_positive_definite_is_refused() -> None:
    assert not factorise(np.array([[1.0, 0.0], [1.0, 2.0]]))
