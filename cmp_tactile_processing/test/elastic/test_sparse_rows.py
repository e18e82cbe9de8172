"""Products of sparse matrices, against SciPy's."""

import numpy as np
import pytest
from scipy import sparse

from cmp_tactile_processing.elastic.mirror_symmetry import SparseRows


@pytest.fixture(params=["csr", "csc", "coo"])
def matrix(request):
    """Seven rows, of which one is empty, and eleven columns."""
    dense = np.random.default_rng(1).normal(size=(7, 11))
    dense[np.abs(dense) < 1] = 0
    dense[3] = 0
    return sparse.coo_array(dense).asformat(request.param)


def test_products(matrix):
    rows = SparseRows(matrix)
    values = np.random.default_rng(2).normal(size=(11, 3))
    np.testing.assert_allclose(rows.of_columns(values), matrix @ values, rtol=1e-12)
    np.testing.assert_allclose(rows.of_vector(values[:, 1]), matrix @ values[:, 1], rtol=1e-12)
    np.testing.assert_allclose(rows.of_columns(values.T.copy().T), matrix @ values, rtol=1e-12)


def test_wrong_sizes(matrix):
    with pytest.raises(ValueError, match="found shape"):
        SparseRows(matrix).of_vector(np.zeros(10))
    with pytest.raises(ValueError, match="found shape"):
        SparseRows(matrix).of_columns(np.zeros((7, 2)))
