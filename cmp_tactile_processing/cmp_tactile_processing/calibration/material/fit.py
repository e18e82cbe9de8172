"""The most probable material for a set of known loads, and what they leave open of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit
from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily
from cmp_tactile_processing.calibration.material.load import LoadInverse, LoadView
from cmp_tactile_processing.calibration.material.parameters import MaterialOptions

__all__ = ["Load", "MaterialFit", "fit_loads"]

# A component of a load that is small beside it is modelled as well as this share of the load.
CROSS_TALK = 0.2
# A millimetre: how far the place of a force may be wrong where its torque is compared.
LEVER = 1e-3
LARGEST_POISSON = 0.4995
# Components of a wrench that err together: of forces along z, and of forces sideways.
MODES = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [1, 0], [0, 1]], dtype=np.float64)


@dataclass(frozen=True)
class Load:
    """One load: its inverse and its reference.  reference, std (6,): N and N m, NaN if unknown."""

    inverse: LoadInverse
    reference: NDArray[np.float64]
    std: NDArray[np.float64]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which components (6,) the reference tells."""
        return np.isfinite(self.reference)

    def root(self, view: LoadView, young: float, model_error: float) -> NDArray[np.float64]:
        """Cholesky factor of the covariance of sensor minus reference, known components."""
        known = self.known
        covariance = (young * self.inverse.noise_scale) ** 2 * view.covariance
        shown = np.abs(young * view.resultant)
        floor = CROSS_TALK * np.linalg.norm(shown[:3]) * np.array([1, 1, 1, *3 * [LEVER]])
        model = model_error * np.hypot(shown, floor)
        variance = np.where(known, self.std, 1.0) ** 2 + model**2
        total = covariance + np.diag(variance)
        return np.asarray(np.linalg.cholesky(total[np.ix_(known, known)]), dtype=np.float64)


@dataclass(frozen=True)
class MaterialFit:
    """The material that explains the loads best.

    young: Pa.  shape (p,): values of the family's names.  offset (6,): of the reference.
    covariance: of (log young, shape, offset), what was held included.  prior_std: the same.
    held (p,): which of the shape kept the description's values.  misfits (loads,): root mean
    square of sensor minus reference in standard deviations, components known.
    signal (loads,): force in standard deviations of what the noise alone shows.
    open_share (1 + p,): what the loads leave of each prior deviation, offset excluded.
    """

    young: float
    shape: NDArray[np.float64]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]
    prior_std: NDArray[np.float64]
    held: NDArray[np.bool_]
    open_share: NDArray[np.float64]
    misfits: NDArray[np.float64]
    signal: NDArray[np.float64]
    converged: bool

    def scaled(self, factor: float, std: float) -> MaterialFit:
        """The same with another Young's modulus, less certain by a relative deviation."""
        covariance = self.covariance.copy()
        covariance[0, 0] += std**2
        return replace(self, young=factor * self.young, covariance=covariance)


def fit_loads(
    family: ComplianceFamily,
    loads: Sequence[Load],
    options: MaterialOptions,
    young: float,
    offsets: NDArray[np.float64],
) -> MaterialFit:
    """Fit Young's modulus, the shape, and offsets of the reference.

    young: Pa, known within options.young_factor.  offsets (6,): prior deviations of the offset of
    the reference, 0 where it has none.
    """
    problem = _Problem(family, loads, options, young, offsets)
    free = np.ones(problem.count, dtype=bool)
    shapes = slice(1, 1 + len(family.names))
    free[shapes] = [name == "poisson" for name in family.names]
    x = np.zeros(problem.count)
    problem.weigh(x)
    # The noise is what the data show where the material is nearly right.
    for _ in range(2):
        x = problem.whole(free, problem.fit(free, x).values)
        problem.weigh(x)
    # What is held is decided here: far from the description, noise that the inverse takes for
    # detail of the force would pass for knowledge of the layer.
    share = problem.open_shares(x)
    free[shapes] = share[shapes] <= options.held_share
    free = problem.within(free, x)
    fit = problem.fit(free, problem.whole(free, x[free]))
    x = problem.whole(free, fit.values)
    free = problem.within(free, x)
    problem.weigh(x)
    fit = problem.fit(free, problem.whole(free, x[free]))
    return problem.result(free, fit, share)


class _Problem:
    """Residuals of all loads as a function of x = (log young, shape, offset), 0 = description."""

    def __init__(
        self,
        family: ComplianceFamily,
        loads: Sequence[Load],
        options: MaterialOptions,
        young: float,
        offsets: NDArray[np.float64],
    ) -> None:
        self._family, self._loads, self._options = family, loads, options
        self._young = young
        self._shapes = len(family.names)
        self._offsets = np.flatnonzero(offsets > 0)
        self.prior_std = np.concatenate(
            [[np.log(options.young_factor) / 2], family.prior_std, offsets[self._offsets]]
        )
        self.count = len(self.prior_std)
        self._fixed = np.zeros(self.count)
        self._roots: list[NDArray[np.float64]] = []
        self._seen: tuple[NDArray[np.float64], list[LoadView]] | None = None

    def weigh(self, x: NDArray[np.float64]) -> None:
        """Set the weights of the residuals to what they are at x."""
        young, model_error = self._young * float(np.exp(x[0])), self._options.model_error
        for load in self._loads:
            # More loads make an error that they have in common no smaller.
            error = self._options.shape_error * np.sqrt(len(self._loads))
            load.inverse.adapt(self._family, self._shape(x), error)
        self._seen = None
        self._roots = [
            load.root(view, young, model_error)
            for load, view in zip(self._loads, self._views(x), strict=True)
        ]

    def _shape(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self._family.start + x[1 : 1 + self._shapes])

    def _views(self, x: NDArray[np.float64]) -> list[LoadView]:
        shape = self._shape(x)
        if self._seen is not None and np.array_equal(self._seen[0], shape):
            return self._seen[1]
        views = [load.inverse.view(self._family, shape) for load in self._loads]
        self._seen = shape, views
        return views

    def whole(self, free: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """All of x from what of it is free."""
        x: NDArray[np.float64] = self._fixed.copy()
        x[free] = values
        return x

    def within(self, free: NDArray[np.bool_], x: NDArray[np.float64]) -> NDArray[np.bool_]:
        """What stays free where a Poisson's ratio beyond what a solid can have is held at it."""
        if "poisson" in self._family.names and free[1]:
            beyond = self._family.start[0] + x[1] > LARGEST_POISSON
            if beyond:
                self._fixed[1] = LARGEST_POISSON - self._family.start[0]
                free = free.copy()
                free[1] = False
        return free

    def fit(self, free: NDArray[np.bool_], start: NDArray[np.float64]) -> MapFit:
        """Fit what is free, from start (all of x)."""
        return map_fit(
            lambda y: self._residuals(self.whole(free, y)),
            self.prior_std[free],
            start=start[free],
            jacobian=lambda y: self._jacobian(self.whole(free, y))[:, free],
        )

    def open_shares(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the loads would leave open of each prior deviation, were all of x fitted."""
        slope = self._jacobian(x) * self.prior_std
        information = slope.T @ slope + np.eye(self.count)
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))

    def _residuals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        views = self._views(x)
        return np.concatenate([self._misfits(views), self._contrasts(x, views)])

    def _misfits(self, views: Sequence[LoadView]) -> NDArray[np.float64]:
        return np.concatenate(
            [
                view.misfit / load.inverse.misfit_scale
                for load, view in zip(self._loads, views, strict=True)
            ]
        )

    def _contrasts(self, x: NDArray[np.float64], views: Sequence[LoadView]) -> NDArray[np.float64]:
        """Sensor minus reference, whitened."""
        young, offset = self._young * np.exp(x[0]), np.zeros(6)
        offset[self._offsets] = x[1 + self._shapes :]
        parts = []
        for load, view, root in zip(self._loads, views, self._roots, strict=True):
            off = (young * view.resultant + offset - load.reference)[load.known]
            parts.append(solve_triangular(root, off, lower=True))
        return np.concatenate(parts)

    def _jacobian(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        views = self._views(x)
        young = self._young * np.exp(x[0])
        misfits, contrasts = [], []
        for load, view, root in zip(self._loads, views, self._roots, strict=True):
            count, shapes = len(view.misfit), slice(1, 1 + self._shapes)
            misfit = np.zeros((count, self.count))
            misfit[:, shapes] = view.misfit_slope / load.inverse.misfit_scale
            misfits.append(misfit)
            slope = np.zeros((6, self.count))
            slope[:, 0] = young * view.resultant
            slope[:, shapes] = young * view.resultant_slope
            slope[self._offsets, 1 + self._shapes + np.arange(len(self._offsets))] = 1.0
            contrasts.append(solve_triangular(root, slope[load.known], lower=True))
        return np.concatenate([*misfits, *contrasts])

    def result(
        self, free: NDArray[np.bool_], fit: MapFit, share: NDArray[np.float64]
    ) -> MaterialFit:
        """The fit with the uncertainty of what was held in it."""
        x = self.whole(free, fit.values)
        shapes = slice(1, 1 + self._shapes)
        offset = np.full(6, np.nan)
        offset[self._offsets] = x[1 + self._shapes :]
        misfits = self._contrast_sizes(x)
        return MaterialFit(
            young=float(self._young * np.exp(x[0])),
            shape=self._shape(x),
            offset=offset,
            covariance=self._covariance(x, free, fit),
            prior_std=self.prior_std,
            held=~free[shapes],
            open_share=share[: 1 + self._shapes],
            misfits=misfits,
            signal=self._signals(x),
            converged=fit.converged,
        )

    def _signals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        signals = []
        for load, view in zip(self._loads, self._views(x), strict=True):
            std = load.inverse.noise_scale * np.sqrt(np.diag(view.covariance))
            signals.append(float(np.max(np.abs(view.resultant[:3]) / std[:3])))
        return np.array(signals)

    def _contrast_sizes(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        contrasts = self._contrasts(x, self._views(x))
        sizes, first = [], 0
        for load in self._loads:
            count = int(load.known.sum())
            sizes.append(np.sqrt(np.mean(contrasts[first : first + count] ** 2)))
            first += count
        return np.array(sizes)

    def _common_shift(
        self, x: NDArray[np.float64], free: NDArray[np.bool_], fit: MapFit
    ) -> NDArray[np.float64]:
        """By what the free values go astray where the model errs alike for all loads, (free, 2).

        Columns: an error of the forces along z, and one of those sideways.  The residuals have
        `model_error` for each load on its own; this is what more loads do not make smaller.
        """
        modes = []
        for load, view, root in zip(self._loads, self._views(x), self._roots, strict=True):
            shown = self._young * np.exp(x[0]) * view.resultant[load.known]
            modes.append(solve_triangular(root, shown[:, None] * MODES[load.known], lower=True))
        mode = self._options.model_error * np.concatenate(modes)
        weight = fit.weights[-len(mode) :, None]
        slope = self._jacobian(x)[-len(mode) :, free]
        share = 1 - 1 / len(self._loads)
        return np.asarray(np.sqrt(share) * fit.covariance @ (slope.T @ (weight * mode)))

    def _covariance(
        self, x: NDArray[np.float64], free: NDArray[np.bool_], fit: MapFit
    ) -> NDArray[np.float64]:
        """Of all of x: what is held is as uncertain as before, and the rest follows its errors."""
        covariance = np.zeros((self.count, self.count))
        common = self._common_shift(x, free, fit)
        covariance[np.ix_(free, free)] = fit.covariance + common @ common.T
        held = np.flatnonzero(~free)
        if not len(held):
            return covariance
        jacobian = self._jacobian(x) * np.sqrt(fit.weights)[:, None]
        pull = -fit.covariance @ (jacobian[:, free].T @ jacobian[:, held])
        prior = self.prior_std[held] ** 2
        covariance[held, held] = prior
        covariance[np.ix_(free, held)] = pull * prior
        covariance[np.ix_(held, free)] = (pull * prior).T
        covariance[np.ix_(free, free)] += (pull * prior) @ pull.T
        return covariance
