"""Both passes of the inverse against the same problems solved in full, by other means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.contact_traction import ContactTraction, TractionScale
from cmp_tactile_processing.force.traction_spectrum import (
    TractionSpectrum,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid

MARKERS = SurfaceGrid(7, 6, (5e-3, 6e-3))
NODES = SurfaceGrid(5, 4, (3e-3, 4e-3))
DATA, UNKNOWNS = 3 * 42, 3 * 20


@pytest.fixture(scope="module")
def response():
    """Any response that is its own mirror image in x and in y, some of it hardly felt."""
    rng, total = np.random.default_rng(3), 0.0
    for parity in PARITIES:
        out = parity.extension(MARKERS.rows, MARKERS.cols).toarray()
        into = parity.extension(NODES.rows, NODES.cols).toarray()
        middle = rng.normal(size=(out.shape[1], into.shape[1]))
        total = total + out @ middle @ np.diag(np.logspace(2, 0, into.shape[1])) @ into.T
    return total


@pytest.fixture(scope="module")
def precision():
    return smoothness(NODES, 1e-3)


@pytest.fixture(scope="module")
def spectrum(response, precision):
    nodal = sparse.csr_array(sparse.kron(nodal_force_matrix(NODES), np.eye(3)))
    return TractionSpectrum(MARKERS, NODES, response, np.kron(precision, np.eye(3)), nodal)


def data_of(response, seed=0):
    rng = np.random.default_rng(seed)
    force = rng.normal(size=UNKNOWNS)
    return response @ force + rng.normal(size=DATA), force


MISSING = {
    "none": [],
    "one component": [40],
    "a row of markers": list(range(18)),
    "no depth at all": list(range(2, DATA, 3)),
}


def known_but(name):
    known = np.ones(DATA, dtype=bool)
    known[MISSING[name]] = False
    return known


@pytest.mark.parametrize("missing", MISSING)
def test_first_pass_is_the_regularised_least_squares(response, precision, spectrum, missing):
    """Missing data drop out as if they had never been part of the problem."""
    data, _ = data_of(response)
    known = known_but(missing)
    found = spectrum.solve(np.where(known, data, np.nan), known, weight=1e-3)
    weight = found.weight * spectrum.scale * np.kron(precision, np.eye(3))
    rows = response[known]
    expected = np.linalg.solve(rows.T @ rows + weight, rows.T @ data[known])
    # Filled in to 5 % of the noise, which is 1; from modes to coefficients in single precision.
    wrong = response @ (found.coefficient - expected)
    assert np.sqrt(np.mean(wrong**2)) < (0.05 if MISSING[missing] else 1e-4)


def test_evidence_is_that_of_the_gaussian(response, precision, spectrum):
    """Differences of the logarithm of the likelihood, with the noise that each weight implies."""
    data, _ = data_of(response)
    found = spectrum.solve(data, known_but("none"))
    prior = np.linalg.inv(found.weight * spectrum.scale * np.kron(precision, np.eye(3)))
    covariance = found.noise_squared * (response @ prior @ response.T + np.eye(DATA))
    _, volume = np.linalg.slogdet(covariance)
    likelihood = -0.5 * (volume + data @ np.linalg.solve(covariance, data))
    alone = np.mean(data**2)
    nothing = -0.5 * DATA * (np.log(alone) + 1)
    assert found.evidence == pytest.approx(likelihood - nothing, rel=1e-6)


def test_products_by_parity(response, spectrum):
    data, force = data_of(response)
    moved = response @ force
    # In single precision: 1e-7 of the largest.
    np.testing.assert_allclose(spectrum.respond(force), moved, rtol=0, atol=1e-6 * moved.max())
    np.testing.assert_allclose(spectrum.pull(data), response.T @ data, atol=1e-8)


def test_noise_covariance(response, precision, spectrum):
    """That of a functional of the filtered noise, worked out in full."""
    functionals = np.random.default_rng(1).normal(size=(2, UNKNOWNS))
    weight = 1e-3 * spectrum.scale * np.kron(precision, np.eye(3))
    inverse = np.linalg.solve(response.T @ response + weight, response.T)
    expected = functionals @ inverse @ inverse.T @ functionals.T
    np.testing.assert_allclose(
        spectrum.noise_covariance(functionals, 1e-3), expected, rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize("missing", MISSING)
def test_second_pass_is_the_posterior_on_its_nodes(response, precision, spectrum, missing):
    """Coefficients and covariances of the Gaussian posterior; draws spread as it does."""
    data, _ = data_of(response)
    known, nodes = known_but(missing), np.array([2, 3, 6, 7, 11])
    scale = TractionScale(0.8, 0.3, 1.7)
    second = ContactTraction(response, spectrum.pull, precision)
    found = second.posterior(data, known, nodes, scale)
    unknowns = (3 * nodes[:, None] + np.arange(3)).ravel()
    rows = response[np.ix_(known, unknowns)]
    prior = np.kron(precision[np.ix_(nodes, nodes)], np.diag(np.array([0.3, 0.3, 0.8]) ** -2.0))
    covariance = np.linalg.inv(rows.T @ rows / 1.7 + prior)
    expected = covariance @ rows.T @ data[known] / 1.7
    np.testing.assert_allclose(found.coefficient, expected, rtol=1e-6, atol=1e-9)
    functionals = np.random.default_rng(2).normal(size=(3, len(unknowns)))
    np.testing.assert_allclose(
        found.covariances(functionals)[0], functionals @ covariance @ functionals.T, rtol=1e-6
    )
    drawn = (found.draws**2).mean(axis=0) / np.diag(covariance)
    assert drawn.mean() == pytest.approx(1, abs=0.3)


def test_scale_follows_from_the_data(response, precision, spectrum):
    """Noise and size of the forces come out of a frame as they went in, whatever one begins with.

    60 unknowns show a size to a tenth, 66 degrees of freedom the noise's square to 17 %.
    """
    rng, nodes = np.random.default_rng(4), np.arange(20)
    root = np.linalg.inv(np.linalg.cholesky(precision)).T
    force = (root @ rng.normal(size=(20, 3))) * [0.5, 0.5, 3.0]
    data = response @ force.ravel() + 2 * rng.normal(size=DATA)
    second = ContactTraction(response, spectrum.pull, precision)
    with pytest.raises(GeometryError, match="nodes: found none"):
        second.solve(data, known_but("none"), nodes[:0], TractionScale(1, 1, 1))
    for begin in (TractionScale(0.1, 0.1, 1.0), TractionScale(30.0, 10.0, 0.1)):
        scale = second.solve(data, known_but("none"), nodes, begin).scale
        assert scale.normal == pytest.approx(3, rel=0.35)
        assert scale.tangential == pytest.approx(0.5, rel=0.35)
        assert scale.noise_squared == pytest.approx(4, rel=0.5)


def test_what_the_scale_and_the_edge_leave_open_is_in_the_covariance(response, precision, spectrum):
    """A scale off by its own deviation, and a node of the edge left out, change no more."""
    data, _ = data_of(response)
    nodes, known = np.arange(4, 16), known_but("none")
    second = ContactTraction(response, spectrum.pull, precision)
    found = second.solve(data, known, nodes, TractionScale(0.5, 0.5, 1.0))
    total = np.kron(np.ones(12), np.eye(3))
    alone = total @ np.linalg.inv(np.triu(found.factor).T @ np.triu(found.factor)) @ total.T
    np.testing.assert_allclose(found.covariances(total)[0], alone, rtol=1e-6, atol=1e-9)
    std = np.sqrt(np.diag(found.covariances(total)[1]))
    assert (std > 0).all()
    for part in ("normal", "tangential"):
        off = replace(found.scale, **{part: 1.05 * getattr(found.scale, part)})
        moved = total @ (second.posterior(data, known, nodes, off).coefficient - found.coefficient)
        assert (np.abs(moved) < std).all()
    edge = np.zeros(12, dtype=bool)
    edge[0] = True
    doubted = np.sqrt(np.diag(alone + replace(found, edge=edge).covariances(total)[1]))
    without = second.posterior(data, known, nodes[1:], found.scale)
    moved = total[:, 3:] @ without.coefficient - total @ found.coefficient
    assert (np.abs(moved) < doubted).all()


@pytest.mark.parametrize("missing", MISSING)
def test_other_data_of_the_same_markers(response, precision, spectrum, missing):
    """Solved again on the same nodes it is what it would be by itself, for the scale of before."""
    data, _ = data_of(response)
    other = data + np.random.default_rng(5).normal(size=DATA)
    known, nodes, scale = known_but(missing), np.array([2, 3, 6, 7, 11]), TractionScale(1, 0.4, 2)
    second = ContactTraction(response, spectrum.pull, precision)
    first = second.posterior(data, known, nodes, scale)
    found = second.again(first, other, known)
    expected = second.posterior(other, known, nodes, scale)
    np.testing.assert_allclose(found.coefficient, expected.coefficient, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found.draws, expected.draws)


def test_prior_is_smooth_and_of_unit_variance():
    """Variance 1 in the middle; correlation x K_1(x) over x lengths, as a Matern field has it."""
    grid = SurfaceGrid(31, 31, (30e-3, 30e-3))
    covariance = np.linalg.inv(smoothness(grid, 3e-3))
    middle = 15 * 31 + 15
    assert covariance[middle, middle] == pytest.approx(1, rel=1e-9)
    # 0.602 at x = 1; hats of a third of the length change it little.
    assert covariance[middle, middle + 3] == pytest.approx(0.602, abs=0.03)
