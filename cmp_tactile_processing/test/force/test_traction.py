"""Both passes of the inverse against the same problems solved in full, by other means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.force.contact_factor import DirectFactor, UpdatedFactor
from cmp_tactile_processing.force.contact_traction import ContactTraction, Weights
from cmp_tactile_processing.force.traction_spectrum import (
    TANGENTIAL_SHARE,
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
    doubted = np.sqrt(np.diag(noise + replace(found, edge=1).covariances(total)[1]))
    without = second.solve(seen, nodes[:-1], WEIGHTS)
    moved = total[:, :-3] @ without.coefficient - total @ found.coefficient
    assert (np.abs(moved) < doubted).all()


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
