"""Least squares with priors against closed forms."""

import numpy as np
import pytest

from cmp_tactile_processing.calibration.map_fit import map_fit
from cmp_tactile_processing.errors import CalibrationError

A = np.random.default_rng(1).normal(size=(40, 3))
PRIOR = np.array([1.0, 0.1, 10.0])


def test_linear_problem_has_the_posterior_of_its_closed_form():
    """A loss or prior that is scaled wrongly moves the mean or the covariance."""
    truth = np.array([0.5, -0.05, 3.0])
    noise = np.random.default_rng(2).normal(size=40)
    b = A @ truth + noise
    fit = map_fit(lambda x: A @ x - b, PRIOR, robust_scale=1e4)
    covariance = np.linalg.inv(A.T @ A + np.diag(PRIOR**-2.0))
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-6)
    np.testing.assert_allclose(fit.values, covariance @ A.T @ b, atol=1e-6)
    assert fit.converged


def test_what_the_data_do_not_show_keeps_its_prior():
    """Only the sum of the first two parameters is measured: their difference is held."""
    prior = np.ones(3)
    fit = map_fit(lambda x: np.array([100 * (x[0] + x[1] - 1), 100 * (x[2] - 2)]), prior)
    loose, *others = fit.combinations
    assert loose.held
    assert loose.share == pytest.approx(1.0)
    np.testing.assert_allclose(abs(loose.direction @ [1, -1, 0]), np.sqrt(2), rtol=1e-6)
    assert not any(item.held for item in others)
    assert fit.determined.tolist() == [False, False, True]
    assert fit.values[0] == pytest.approx(fit.values[1])


def test_outliers_count_little():
    """With squares alone, a fifth of wrong data would pull the mean by 20."""
    data = np.random.default_rng(3).normal(size=100)
    data[::5] += 100.0
    fit = map_fit(lambda x: x[0] - data, np.array([1e3]))
    assert abs(fit.values[0]) < 1.5
    assert fit.weights[::5].max() < 0.1
    assert np.median(fit.weights) > 0.9
    # Each residual counts by its weight, that of a loss that is linear beyond 3 deviations.
    residuals = fit.values[0] - data
    np.testing.assert_allclose(fit.weights, 1 / np.sqrt(1 + (residuals / 3) ** 2), rtol=1e-9)
    assert fit.covariance[0, 0] == pytest.approx(1 / (fit.weights.sum() + 1e-6), rel=1e-6)


def test_a_step_where_nothing_can_be_computed_is_refused():
    """The logarithm is not defined beyond 0, where the first full step would lead."""

    def residuals(x):
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(1e3 * np.log(x + 1.0) - 1e3 * np.log(0.02))

    fit = map_fit(residuals, np.array([10.0]))
    assert fit.values[0] == pytest.approx(-0.98, abs=1e-4)


def test_a_start_without_residuals_is_refused():
    with pytest.raises(CalibrationError, match="found 1 of 2 residuals that are not finite"):
        map_fit(lambda x: np.array([x[0], np.nan]), np.ones(1))
