"""Cholesky factors and what is solved with them."""

import numpy as np
import pytest

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.contact_traction import factor, forward, solve

SIZE, COLUMNS = 37, 5
# Of a matrix with a condition number of some hundred.
RTOL = 1e-11


@pytest.fixture
def matrix() -> np.ndarray:
    half = np.random.default_rng(3).normal(size=(SIZE, 3 * SIZE))
    return np.asfortranarray(half @ half.T)


@pytest.fixture
def right() -> np.ndarray:
    return np.asfortranarray(np.random.default_rng(4).normal(size=(SIZE, COLUMNS)))


def test_only_the_lower_triangle_is_read_and_written(matrix):
    torn = np.asfortranarray(np.tril(matrix) + np.triu(np.full(matrix.shape, np.nan), 1))
    lower = factor(torn)
    assert lower is torn
    assert np.isnan(lower[np.triu_indices(SIZE, 1)]).all()
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(matrix), rtol=RTOL, atol=RTOL)


def test_both_substitutions_solve_in_place(matrix, right):
    lower, found = factor(matrix.copy(order="F")), right.copy(order="F")
    assert solve(lower, forward(lower, found)) is found
    np.testing.assert_allclose(matrix @ found, right, rtol=RTOL, atol=RTOL)


def test_some_of_the_columns_alone(matrix, right):
    lower, found = factor(matrix.copy(order="F")), right.copy(order="F")
    forward(lower, found[:, :2])
    np.testing.assert_array_equal(found[:, 2:], right[:, 2:])
    np.testing.assert_allclose(np.tril(lower) @ found[:, :2], right[:, :2], rtol=RTOL, atol=RTOL)


def test_what_is_not_definite_is_an_error(matrix):
    matrix[7, 7] = -1.0
    with pytest.raises(GeometryError, match="not definite at unknown 8"):
        factor(matrix)


def test_wrong_shapes_are_errors(matrix, right):
    with pytest.raises(GeometryError, match="contiguous columns"):
        factor(np.ascontiguousarray(np.triu(matrix))[:, ::2])
    with pytest.raises(GeometryError, match="right: found shape"):
        forward(matrix, np.asfortranarray(right[:-1]))
    with pytest.raises(GeometryError, match="of float32, expected"):
        factor(matrix.astype(np.float32))
    with pytest.raises(GeometryError, match="of float32, expected"):
        solve(matrix, right.astype(np.float32))
