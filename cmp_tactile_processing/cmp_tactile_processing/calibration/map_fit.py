"""Least squares with priors: what do the data say of parameters that are known roughly before?

Parameters are counted in standard deviations of their priors inside, so that shifts in metres and
turns in radians weigh alike, and directions that the data leave open show by their length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from cmp_tactile_processing.errors import CalibrationError

# A parameter of which the data leave more than this share of the prior's deviation is held.
HELD_SHARE = 0.25
# The way over which a derivative is taken, in standard deviations of the prior.
STEP = 1e-3
# The fit ends where the sum of squares falls by less than this share of it, or after so many steps.
LEAST_GAIN = 1e-7
MOST_STEPS = 100

Residuals = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Combination:
    """A direction in the space of the parameters and what the data left open of it.

    direction (n,): unit vector, parameters in standard deviations of their priors.
    share: standard deviation along it after the fit, relative to that of the prior, 0 to 1.
    """

    direction: NDArray[np.float64]
    share: float

    @property
    def held(self) -> bool:
        """Whether it kept, mostly, what was known before."""
        return self.share > HELD_SHARE


@dataclass(frozen=True)
class MapFit:
    """The most probable parameters, given the data and Gaussian priors about zero.

    values (n,), covariance (n, n); prior_std (n,).  residuals (m,): whitened ones of the data;
    weights (m,): what the robust loss leaves of each, 0 to 1.  converged: False where the steps
    ran out first.
    """

    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    prior_std: NDArray[np.float64]
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    converged: bool

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviations (n,) after the fit."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(n,): whether the data, rather than the prior, determine a parameter."""
        return np.asarray(self.std <= HELD_SHARE * self.prior_std)

    @property
    def deviations(self) -> NDArray[np.float64]:
        """How far each parameter (n,) went, in standard deviations of its prior."""
        return np.asarray(np.abs(self.values) / self.prior_std)

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Eigenvectors of the posterior relative to the prior, what is least determined first."""
        relative = self.covariance / np.outer(self.prior_std, self.prior_std)
        variances, directions = np.linalg.eigh((relative + relative.T) / 2)
        shares = np.sqrt(variances.clip(0.0, 1.0))
        return tuple(Combination(directions[:, k], float(shares[k])) for k in np.argsort(-shares))


def map_fit(
    residuals: Residuals,
    prior_std: NDArray[np.float64],
    *,
    start: NDArray[np.float64] | None = None,
    robust_scale: float | None = 3.0,
) -> MapFit:
    """Fit parameters x (n,) to whitened residuals(x) (m,), each with the prior N(0, prior_std^2).

    The data's loss is soft (from `robust_scale` standard deviations on it grows linearly, of None
    never), the priors' is not.  Derivatives are differences: one-sided on the way, central ones for
    the covariance.  start: default zero.
    Residuals may be NaN away from the start: such steps are refused.  A prior_std of 0 is no
    prior: leave the parameter out instead.  Raises CalibrationError where residuals at the start
    are not finite.
    """
    scale = np.asarray(prior_std, dtype=np.float64)
    first = np.zeros(len(scale)) if start is None else np.asarray(start, dtype=np.float64) / scale
    count = len(_checked(residuals(first * scale)))

    def whole(y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([residuals(y * scale), y])

    def whole_slope(y: NDArray[np.float64]) -> NDArray[np.float64]:
        slope = _forward_jacobian(residuals, y * scale, STEP * scale)
        return np.concatenate([slope * scale, np.eye(len(y))])

    def loss(z: NDArray[np.float64]) -> NDArray[np.float64]:
        rho = soft_loss(z, None)
        rho[:, :count] = soft_loss(z[:count], robust_scale)
        return rho

    found = least_squares(
        whole,
        first,
        whole_slope,
        method="trf",
        loss=loss,
        max_nfev=MOST_STEPS,
        ftol=LEAST_GAIN,
        xtol=1e-9,
    )
    data = residuals(found.x * scale)
    weights = soft_loss(data**2, robust_scale)[1]
    slope = central_jacobian(residuals, found.x * scale, STEP * scale)
    weighted = slope * scale * np.sqrt(weights)[:, None]
    information = weighted.T @ weighted + np.eye(len(scale))
    covariance = np.linalg.inv(information) * np.outer(scale, scale)
    return MapFit(found.x * scale, covariance, scale, data, weights, bool(found.status > 0))


def central_jacobian(
    function: Residuals, x: NDArray[np.float64], step: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives (m, n) of function (n,) -> (m,) at x by central differences over +-step (n,)."""
    columns = []
    for k, width in enumerate(step):
        off = np.zeros_like(x)
        off[k] = width
        columns.append((function(x + off) - function(x - off)) / (2 * width))
    return np.stack(columns, axis=1)


def _forward_jacobian(
    function: Residuals, x: NDArray[np.float64], step: NDArray[np.float64]
) -> NDArray[np.float64]:
    at = function(x)
    moved = [function(x + off) for off in np.diag(step)]
    return np.asarray((np.stack(moved, axis=1) - at[:, None]) / step)


def soft_loss(z: NDArray[np.float64], scale: float | None) -> NDArray[np.float64]:
    """Loss of squared whitened residuals z (m,) and its two derivatives, (3, m).

    z itself where z is small, or everywhere for None; the first derivative is the weight that it
    leaves, 0 to 1.
    """
    if scale is None:
        return np.stack([z, np.ones_like(z), np.zeros_like(z)])
    root = np.sqrt(1 + z / scale**2)
    return np.stack([2 * scale**2 * (root - 1), 1 / root, -0.5 / (scale**2 * root**3)])


def _checked(values: NDArray[np.float64]) -> NDArray[np.float64]:
    lost = int(np.count_nonzero(~np.isfinite(values)))
    if lost or not values.size:
        msg = f"fit: found {lost} of {values.size} residuals that are not finite, expected none"
        raise CalibrationError(msg)
    return values
