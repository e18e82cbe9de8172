"""The regularised inverse against plain least squares."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.traction_inverse import TikhonovInverse, hat_penalty

COUNT = 60, 24
REGULARIZATION = 1e-2


@pytest.fixture(scope="module")
def parts():
    rng = np.random.default_rng(5)
    compliance = rng.normal(size=COUNT) * np.logspace(0, -3, COUNT[1])
    noise = np.tile([2e-6, 2e-6, 5e-6], COUNT[0] // 3)
    return compliance, noise, hat_penalty((2, 4), (1e-3, 2e-3), 3e-3), rng.normal(size=COUNT[0])


def least_squares(parts, known):
    """The definition: stacked rows of the known measurements and of the penalty."""
    compliance, noise, penalty, moved = parts
    root = np.linalg.cholesky(penalty).T
    weighted = compliance / noise[:, None]
    scale = np.linalg.svd(weighted @ np.linalg.inv(root), compute_uv=False)[0]
    rows = np.concatenate([weighted[known], REGULARIZATION * scale * root])
    values = np.concatenate([(moved / noise)[known], np.zeros(len(root))])
    return np.linalg.lstsq(rows, values, rcond=None)[0]


def known_but(unknown):
    known = np.ones(COUNT[0], dtype=bool)
    known[unknown] = False
    return known


@pytest.mark.parametrize(
    "unknown",
    [
        pytest.param([], id="none"),
        pytest.param([7], id="one component"),
        pytest.param(list(range(2, 60, 3)), id="no depth at all"),
        pytest.param(list(range(10, 40)), id="more than there are forces"),
        pytest.param(list(range(57)), id="all but one marker"),
    ],
)
def test_unknown_components_drop_out(parts, unknown):
    """Zeros or means in their place would move the solution far from the least squares."""
    compliance, noise, penalty, moved = parts
    inverse = TikhonovInverse(compliance, noise, penalty, REGULARIZATION)
    known = known_but(unknown)
    spoilt = np.where(known, moved, np.nan)
    expected = least_squares(parts, known)
    for _ in range(2):  # the second time by what the first has prepared
        found = inverse.solve(spoilt, known)
        assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


def test_a_change_of_what_is_unknown_is_noticed(parts):
    compliance, noise, penalty, moved = parts
    inverse = TikhonovInverse(compliance, noise, penalty, REGULARIZATION)
    for unknown in ([1, 2], [1, 3], list(range(30)), [], [1, 2]):
        known = known_but(unknown)
        expected = least_squares(parts, known)
        found = inverse.solve(moved, known)
        assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("factor", [1e-6, 1e3])
def test_regularization_means_the_same_for_any_stiffness(parts, factor):
    """A gel `factor` times as soft: the same displacement tells forces `factor` times smaller."""
    compliance, noise, penalty, moved = parts
    known = known_but([4])
    stiff = TikhonovInverse(compliance, noise, penalty, REGULARIZATION).solve(moved, known)
    soft = TikhonovInverse(factor * compliance, noise, penalty, REGULARIZATION)
    assert soft.solve(moved, known) * factor == pytest.approx(stiff, rel=1e-6)


def test_deviation_is_that_of_the_noise(parts):
    """2,000 draws: a standard deviation is known to 1.6 %, and 24 of them to about 4.5 %."""
    compliance, noise, penalty, _ = parts
    inverse = TikhonovInverse(compliance, noise, penalty, REGULARIZATION)
    rng, known = np.random.default_rng(6), known_but([])
    draws = [inverse.solve(rng.normal(size=COUNT[0]) * noise, known) for _ in range(2000)]
    assert np.std(draws, axis=0) == pytest.approx(inverse.deviation, rel=0.08)


def test_penalty_is_the_integral_of_traction_and_slope():
    """Midpoint rule on a fine raster of the hats, against the closed integrals."""
    counts, spacing, smoothing = (3, 4), (2e-3, 1e-3), 1.5e-3
    force = np.random.default_rng(7).normal(size=(3, 4, 3))
    step = 1e-2
    y, x = np.arange(-1 + step / 2, 3, step), np.arange(-1 + step / 2, 4, step)
    hats_y = np.maximum(0, 1 - np.abs(y[:, None] - np.arange(3)))
    hats_x = np.maximum(0, 1 - np.abs(x[:, None] - np.arange(4)))
    area = spacing[0] * spacing[1]
    traction = np.einsum("yi,xj,ijc->yxc", hats_y, hats_x, force) / area
    slope_y = np.diff(traction, axis=0) / (step * spacing[1])
    slope_x = np.diff(traction, axis=1) / (step * spacing[0])
    slope = (slope_x**2).sum() + (slope_y**2).sum()
    integral = ((traction**2).sum() + smoothing**2 * slope) * step**2 * area
    closed = force.ravel() @ hat_penalty(counts, spacing, smoothing) @ force.ravel()
    assert closed == pytest.approx(integral, rel=2e-2)
