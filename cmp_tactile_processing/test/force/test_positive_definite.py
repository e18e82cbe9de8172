"""Cholesky factors and what is solved with them."""

import numpy as np
import pytest

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.positive_definite import backward, factor, forward

SIZE, ROWS = 37, 5
# Of a matrix with a condition number of some hundred.
RTOL = 1e-11


@pytest.fixture
def matrix() -> np.ndarray:
    half = np.random.default_rng(3).normal(size=(SIZE, 3 * SIZE))
    return half @ half.T


@pytest.fixture
def right() -> np.ndarray:
    return np.random.default_rng(4).normal(size=(ROWS, SIZE))


def test_only_the_upper_triangle_is_read_and_written(matrix):
    upper = np.triu(matrix) + np.tril(np.full(matrix.shape, np.nan), -1)
    factor(upper)
    assert np.isnan(upper[np.tril_indices(SIZE, -1)]).all()
    np.testing.assert_allclose(np.triu(upper).T, np.linalg.cholesky(matrix), rtol=RTOL, atol=RTOL)


def test_both_substitutions_solve_in_place(matrix, right):
    upper, found = matrix.copy(), right.copy()
    factor(upper)
    forward(upper, found)
    backward(upper, found)
    np.testing.assert_allclose(found @ matrix, right, rtol=RTOL, atol=RTOL)


def test_some_of_the_rows_alone(matrix, right):
    upper, found = matrix.copy(), right.copy()
    factor(upper)
    forward(upper, found[:2])
    np.testing.assert_array_equal(found[2:], right[2:])
    np.testing.assert_allclose(found[:2] @ np.triu(upper), right[:2], rtol=RTOL, atol=RTOL)


def test_what_is_not_definite_is_an_error(matrix):
    matrix[7, 7] = -1.0
    with pytest.raises(GeometryError, match="not definite"):
        factor(matrix)


def test_other_arrays_are_errors(matrix, right):
    for wrong in (right[:, :-1].copy(), right[:, ::-1], right.astype(np.float32)):
        with pytest.raises(GeometryError, match="another array"):
            forward(matrix, wrong)
    for wrong in (np.asfortranarray(matrix), matrix.astype(np.float32), matrix[:, :-1].copy()):
        with pytest.raises(GeometryError, match="another array"):
            factor(wrong)
