"""Both passes of the inverse against the same problems solved in full, by other means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.contact_factor import DirectFactor, UpdatedFactor
from cmp_tactile_processing.force.contact_traction import ContactTraction, Weights
from cmp_tactile_processing.force.traction_spectrum import (
    TANGENTIAL_SHARE,
    TractionScale,
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
    return TractionSpectrum(MARKERS, NODES, response, precision, nodal_force_matrix(NODES))


@pytest.fixture(scope="module")
def prior(precision):
    """Precision of all coefficients in the first pass, for a weight of 1."""
    return np.kron(precision, np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0]))


@pytest.fixture
def second(spectrum, response, precision):
    return ContactTraction(spectrum, response, precision)


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
def test_first_pass_is_the_regularised_least_squares(response, prior, spectrum, missing):
    """Missing data drop out as if they had never been part of the problem."""
    data, _ = data_of(response)
    known = known_but(missing)
    found = spectrum.solve(np.where(known, data, np.nan), known, weight=1e-3)
    weight = found.weight * spectrum.scale * prior
    rows = response[known]
    expected = np.linalg.solve(rows.T @ rows + weight, rows.T @ data[known])
    # Filled in to 5 % of the noise, which is 1; from modes to coefficients in single precision.
    wrong = response @ (found.coefficient - expected)
    assert np.sqrt(np.mean(wrong**2)) < (0.05 if MISSING[missing] else 1e-4)


def test_evidence_is_that_of_the_gaussian(response, prior, spectrum):
    """Differences of the logarithm of the likelihood, with the noise that each weight implies."""
    data, _ = data_of(response)
    found = spectrum.solve(data, known_but("none"))
    spread = np.linalg.inv(found.weight * spectrum.scale * prior)
    covariance = found.noise_squared * (response @ spread @ response.T + np.eye(DATA))
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


def test_noise_covariance(response, prior, spectrum):
    """That of a functional of the filtered noise, worked out in full."""
    functionals = np.random.default_rng(1).normal(size=(2, UNKNOWNS))
    weight = 1e-3 * spectrum.scale * prior
    inverse = np.linalg.solve(response.T @ response + weight, response.T)
    expected = functionals @ inverse @ inverse.T @ functionals.T
    np.testing.assert_allclose(
        spectrum.noise_covariance(functionals, 1e-3), expected, rtol=1e-6, atol=1e-12
    )


# Few nodes are factored by themselves, many by what is beside them.
MASKS = {"few": np.array([2, 3, 6, 7, 11]), "many": np.delete(np.arange(20), [0, 5, 13])}
WEIGHTS = Weights(12.0, 3.0)


def posterior_of(response, precision, known, nodes):
    """Columns of the response, and the covariance for noise of 1, worked out in full."""
    unknowns = (3 * nodes[:, None] + np.arange(3)).ravel()
    rows = response[np.ix_(known, unknowns)]
    components = np.diag([WEIGHTS.tangential, WEIGHTS.tangential, WEIGHTS.normal])
    smooth = np.kron(precision[np.ix_(nodes, nodes)], components)
    return rows, np.linalg.inv(rows.T @ rows + smooth)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("missing", MISSING)
def test_second_pass_is_the_posterior_on_its_nodes(second, response, precision, missing, mask):
    """Coefficients, noise and covariances of the Gaussian posterior."""
    data, _ = data_of(response)
    known, nodes = known_but(missing), MASKS[mask]
    found = second.solve(second.seen(data, known), nodes, WEIGHTS)
    rows, covariance = posterior_of(response, precision, known, nodes)
    expected = covariance @ rows.T @ data[known]
    np.testing.assert_allclose(found.coefficient, expected, rtol=1e-6, atol=1e-9)
    likelihood = np.eye(len(rows)) - rows @ covariance @ rows.T
    noise_squared = data[known] @ likelihood @ data[known] / len(rows)
    assert found.noise_squared == pytest.approx(noise_squared, rel=1e-6)
    functionals = np.random.default_rng(2).normal(size=(3, rows.shape[1]))
    np.testing.assert_allclose(
        found.covariances(functionals)[0],
        noise_squared * functionals @ covariance @ functionals.T,
        rtol=1e-6,
    )
    chosen = np.array([0, 4, 8])
    np.testing.assert_allclose(
        found.factor.variance(chosen), np.diag(covariance)[chosen], rtol=1e-6
    )


def test_no_nodes_are_an_error(second, response):
    seen = second.seen(data_of(response)[0], known_but("none"))
    with pytest.raises(GeometryError, match="nodes: found none"):
        second.solve(seen, np.arange(0), WEIGHTS)


def test_scale_follows_from_the_data(response, precision, spectrum, second):
    """Noise and size of the forces come out of a frame as they went in.

    60 unknowns show a size to a tenth, 66 degrees of freedom the noise's square to 17 %; one step
    from where tangential and normal share a weight leaves twice the size at most.
    """
    rng = np.random.default_rng(4)
    root = np.linalg.inv(np.linalg.cholesky(precision)).T
    force = (root @ rng.normal(size=(20, 3))) * [0.5, 0.5, 3.0]
    data = response @ force.ravel() + 2 * rng.normal(size=DATA)
    first = spectrum.solve(data, known_but("none"))
    scale = spectrum.scale_of_first(first)
    assert scale.normal == pytest.approx(3, rel=0.5)
    assert 0.25 < scale.tangential < 1.0
    weights = second.weights(scale, first.noise_squared)
    # On its grid the weight is off by a factor of 1.6 at most.
    wanted = first.noise_squared / np.array([scale.tangential, scale.normal]) ** 2
    assert np.abs(np.log(np.array(weights) / wanted)).max() < 0.5
    found = second.solve(second.seen(data, known_but("none")), np.arange(20), weights)
    assert found.noise_squared == pytest.approx(4, rel=0.5)


def test_tangential_forces_are_never_expected_to_be_none(second):
    alone = second.weights(TractionScale(1.0, 0.0), 1.0)
    assert alone.tangential < 1e4 * alone.normal


def test_nodal_variance_is_that_of_the_whole_surface(response, precision, spectrum):
    """Were tangential and normal traction of the size that their weight stands for."""
    found = spectrum.nodal_variance(4 * 2.0, 2.0)
    components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
    covariance = np.linalg.inv(response.T @ response + 2.0 * np.kron(precision, components))
    collect = np.kron(nodal_force_matrix(NODES), np.eye(3))
    expected = np.diag(collect @ covariance @ collect.T).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_what_the_weights_and_the_edge_leave_open_is_in_the_covariance(second, response):
    """A weight off by its own deviation, and a node of the edge left out, change no more."""
    data, _ = data_of(response)
    nodes, seen = np.arange(4, 16), second.seen(data, known_but("none"))
    found = second.solve(seen, nodes, WEIGHTS)
    total = np.kron(np.ones(12), np.eye(3))
    noise, doubt = found.covariances(total)
    std = np.sqrt(np.diag(doubt))
    assert (std > 0).all()
    for part in Weights._fields:
        off = WEIGHTS._replace(**{part: 1.1 * getattr(WEIGHTS, part)})
        moved = total @ (second.solve(seen, nodes, off).coefficient - found.coefficient)
        assert (np.abs(moved) < std).all()
    edge = np.zeros(12, dtype=bool)
    edge[0] = True
    doubted = np.sqrt(np.diag(noise + replace(found, edge=edge).covariances(total)[1]))
    without = second.solve(seen, nodes[1:], WEIGHTS)
    moved = total[:, 3:] @ without.coefficient - total @ found.coefficient
    assert (np.abs(moved) < doubted).all()


@pytest.mark.parametrize("missing", MISSING)
def test_other_data_of_the_same_markers(second, response, missing):
    """Solved again on the same nodes it is what it would be by itself."""
    data, _ = data_of(response)
    other = data + np.random.default_rng(5).normal(size=DATA)
    known, nodes = known_but(missing), MASKS["few"]
    first = second.solve(second.seen(data, known), nodes, WEIGHTS)
    found = second.again(first, second.seen(other, known))
    expected = second.solve(second.seen(other, known), nodes, WEIGHTS)
    np.testing.assert_array_equal(found.coefficient, expected.coefficient)


def test_prior_is_smooth_and_of_unit_variance():
    """Variance 1 in the middle; correlation x K_1(x) over x lengths, as a Matern field has it."""
    grid = SurfaceGrid(31, 31, (30e-3, 30e-3))
    covariance = np.linalg.inv(smoothness(grid, 3e-3))
    middle = 15 * 31 + 15
    assert covariance[middle, middle] == pytest.approx(1, rel=1e-9)
    # 0.602 at x = 1; hats of a third of the length change it little.
    assert covariance[middle, middle + 3] == pytest.approx(0.602, abs=0.03)


def test_a_factor_serves_where_a_few_data_are_missing():
    rng = np.random.default_rng(5)
    rows, right, some = rng.normal(size=(60, 30)), rng.normal(size=(30, 2)), np.array([3, 20])
    factor = DirectFactor(rows.T @ rows + np.eye(30))
    found = UpdatedFactor(factor, rows[:4])
    inverse = np.linalg.inv(rows[4:].T @ rows[4:] + np.eye(30))
    product, solved = found.joint(right, some)
    close = {"rtol": 0, "atol": 1e-10}
    np.testing.assert_allclose(found.solve(right), inverse @ right, **close)
    np.testing.assert_allclose(product, right.T @ inverse @ right, **close)
    np.testing.assert_allclose(solved, (inverse @ right)[some], **close)
    np.testing.assert_allclose(found.variance(some), np.diag(inverse)[some], **close)
