"""The most probable material for a set of known loads, and what they leave open of it.

The force of a load is sought only where the first look found contact.  The markers around it, which
nothing touches, then show whether the gel of a given Poisson's ratio and layer moves as they did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.ndimage import binary_dilation

from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit
from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily, MaterialOptions
from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.force.traction_spectrum import gradient_penalty
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription

# What the penalty of a load's own force adds to the sum of squares.  It holds what the markers do
# not show at all: at 1 the smoothness of the force already speaks for a thinner layer, by 0.8
# deviations of its prior at half a newton, while at 0.001 no value is off by more than its scatter.
PENALTY = 1e-3
# What mesh, optics and details of the force leave of a marker's displacement, relative to it.
MODEL_ERROR = 0.01
EVERYWHERE = np.ones((3, 3), dtype=bool)
# A component of a load that is small beside it is modelled as well as this share of the load.
CROSS_TALK = 0.2
# A millimetre: how far the place of a force may be wrong where its torque is compared.
LEVER = 1e-3
LARGEST_POISSON = 0.4995
# Components of a wrench that err together: of forces along z, and of forces sideways.
MODES = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [1, 0], [0, 1]], dtype=np.float64)


@dataclass(frozen=True)
class LoadView:
    """A load as a gel of E = 1 Pa shows it, and how that changes with the material's shape.

    misfit (k,): residuals of markers and penalty, in standard deviations of the noise, with
    misfit_slope (k, p).  resultant (6,): force N and torque N m for E = 1 Pa, resultant_slope
    (6, p).  covariance (6, 6): of the resultant, from a noise as the parameters say.
    """

    misfit: NDArray[np.float64]
    misfit_slope: NDArray[np.float64]
    resultant: NDArray[np.float64]
    resultant_slope: NDArray[np.float64]
    covariance: NDArray[np.float64]


class LoadInverse:
    """The linear inverse of one load's displacement, restricted to where it touches.

    noise_scale: of the markers, relative to what the parameters say; misfit_scale: that of what
    their movement shows of the material, which errors of the model make larger.
    field: what ForceModel makes of the sample; it shows where the contact is.
    """

    def __init__(
        self,
        sample: LoadSample,
        field: ForceField,
        elastic: ElasticModel,
        sensor: SensorDescription,
    ) -> None:
        nodes = elastic.nodes
        mask = binary_dilation(field.contact.reshape(nodes.rows, nodes.cols), EVERYWHERE).ravel()
        self.nodes = np.flatnonzero(mask)
        self._columns = (3 * self.nodes[:, None] + np.arange(3)).ravel()
        self._shape = (*np.shape(sample.status), 3)
        known, noise = sample.known, sensor.force
        if len(sensor.views) < 2:  # one view measures no depth
            known[..., 2] = False
        self._known = known.ravel()
        deviations = np.tile(
            [noise.noise_in_plane, noise.noise_in_plane, noise.noise_depth], sample.status.size
        )
        # Where the gel moves most, under the contact, meshes and details of the force show most.
        length = np.linalg.norm(np.nan_to_num(np.asarray(sample.displacement)), axis=-1)
        deviations = np.hypot(deviations, np.repeat(MODEL_ERROR * length.ravel(), 3))
        self._deviations = deviations[self._known]
        self._moved = np.asarray(sample.displacement).ravel()[self._known] / self._deviations
        penalty = gradient_penalty(nodes, noise.smoothing_length)
        self._penalty = penalty[np.ix_(self._columns, self._columns)]
        self._root = np.linalg.cholesky(self._penalty).T
        self._resultant = _resultant_rows(field.position[self.nodes])
        self._probe = field.force[self.nodes].ravel()
        self.noise_scale = self.misfit_scale = 1.0
        self._share = self._penalty_share()

    def adapt(
        self, family: ComplianceFamily, values: NDArray[np.float64], shape_error: float = 0.0
    ) -> None:
        """Take the noise for what the data show where the material is nearly right.

        shape_error: of the model, relative to the movement of all markers together.  The force
        follows most of such an error, so that what is left of the movement does not show it.
        """
        view = self.view(family, values)
        count = len(self._moved)
        residuals = view.misfit[:count]
        freedom = max(1, count - len(self._columns))
        white = np.sqrt(residuals @ residuals / freedom)
        self.noise_scale = float(white * self._clustering(residuals))
        # As for one direction of all those in which the markers can move: the direction in which
        # a value of the material shows.
        error = shape_error * float(np.linalg.norm(self._moved))
        self.misfit_scale = float(np.hypot(self.noise_scale, error))
        self._share = self._penalty_share()

    def view(self, family: ComplianceFamily, values: NDArray[np.float64]) -> LoadView:
        """The load as a gel of this shape, for E = 1 Pa, shows it."""
        matrix = self._matrix(family, values)
        probe, weight = matrix @ self._probe, self._weight(matrix)
        factor = cho_factor(matrix.T @ matrix + weight * self._penalty)
        force = cho_solve(factor, matrix.T @ self._moved)
        misfit = matrix @ force - self._moved
        rough = np.sqrt(weight) * (self._root @ force)
        # Derivatives: of the matrix, and of the weight that goes with it.
        turned = self._markers_slope(family, values, force)
        growth = 2 * (probe @ self._markers_slope(family, values, self._probe)) / (probe @ probe)
        rough_slope = 0.5 * rough[:, None] * growth
        pull = matrix.T @ turned + np.sqrt(weight) * (self._root.T @ rough_slope)
        step = cho_solve(factor, pull)
        misfit_slope = np.concatenate(
            [turned - matrix @ step, rough_slope - np.sqrt(weight) * (self._root @ step)]
        )
        whole = np.zeros(len(self._known))
        whole[self._known] = misfit / self._deviations
        back = family.slope_transposed(values, whole)[self._columns]
        bent = np.sqrt(weight) * (self._root.T @ rough_slope)
        force_slope = -step - cho_solve(factor, back + bent)
        half = solve_triangular(factor[0], self._resultant.T, trans="T", lower=factor[1])
        return LoadView(
            np.concatenate([misfit, rough]),
            misfit_slope,
            self._resultant @ force,
            self._resultant @ force_slope,
            half.T @ half,
        )

    def sensitivity(
        self, family: ComplianceFamily, values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Relative change of a force along x, y and z with the shape it is computed with, (3, p).

        The forces are spread as the load's own pressure, and moved the markers as this shape does.
        """
        matrix = self._matrix(family, values)
        normal = matrix.T @ matrix + self._weight(matrix) * self._penalty
        factor = cho_factor(normal)
        pressure = np.abs(self._probe[2::3])
        changes = []
        for axis in np.eye(3):
            force = (pressure[:, None] * axis).ravel()
            turned = self._markers_slope(family, values, force)
            changes.append(-axis @ self._resultant[:3] @ cho_solve(factor, matrix.T @ turned))
        return np.asarray(np.array(changes) / pressure.sum())

    def _matrix(self, family: ComplianceFamily, values: NDArray[np.float64]) -> NDArray[np.float64]:
        part = family.compliance(values)[np.ix_(self._known, self._columns)]
        return np.asarray(part / self._deviations[:, None])

    def _weight(self, matrix: NDArray[np.float64]) -> float:
        """Weight of the penalty, which goes with the gel's compliance."""
        probe = matrix @ self._probe
        size = (probe @ probe) / (self._probe @ self._penalty @ self._probe)
        return float(self._share * size)

    def _penalty_share(self) -> float:
        """Weight of the penalty relative to the answer of the markers to the load itself."""
        noise = self.noise_scale**2
        signal = self._moved @ self._moved - noise * len(self._moved)
        return float(PENALTY * noise / max(signal, noise))

    def _markers_slope(
        self, family: ComplianceFamily, values: NDArray[np.float64], force: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        whole = np.zeros(family.forces)
        whole[self._columns] = force
        slopes = family.slope(values, whole)[self._known]
        return np.asarray(slopes / self._deviations[:, None])

    def _clustering(self, residuals: NDArray[np.float64]) -> float:
        """Factor by which residuals that resemble their neighbours' say less than their number.

        A model that errs does so over whole regions: as for a process that is autoregressive
        along rows and along columns, the variance of a mean grows by ((1 + r) / (1 - r))^2.
        """
        grid = np.full(int(np.prod(self._shape)), np.nan)
        grid[self._known] = residuals
        grid = grid.reshape(self._shape)
        products = np.concatenate(
            [(grid[1:] * grid[:-1]).ravel(), (grid[:, 1:] * grid[:, :-1]).ravel()]
        )
        power = np.nanmean(residuals**2)
        if not power > 0 or not np.isfinite(products).any():
            return 1.0
        alike = float(np.clip(np.nanmean(products) / power, 0.0, 0.9))
        return (1 + alike) / (1 - alike)


def _resultant_rows(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (6, 3 n) from forces at places (n, 3) m to their sum and moment."""
    x, y, z = place.T
    zero = np.zeros_like(x)
    arm = np.stack(
        [
            np.stack([zero, -z, y], axis=-1),
            np.stack([z, zero, -x], axis=-1),
            np.stack([-y, x, zero], axis=-1),
        ]
    )
    force = np.broadcast_to(np.eye(3)[:, None, :], arm.shape)
    return np.concatenate([force, arm]).reshape(6, -1)


@dataclass(frozen=True)
class Load:
    """One load: its inverse and its reference.  reference, std (6,): N and N m, NaN if unknown."""

    inverse: LoadInverse
    reference: NDArray[np.float64]
    std: NDArray[np.float64]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which components (6,) the reference gives."""
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


def force_deviations(
    family: ComplianceFamily, loads: Sequence[Load], fit: MaterialFit
) -> tuple[float, float]:
    """Relative standard deviations of normal and tangential force computed with this material.

    They follow from how wrong modulus and shape can be together: a Poisson's ratio that is too low
    and a modulus that makes up for it give the right normal force and a wrong tangential one.
    Root mean squares over the contacts of the loads.
    """
    values = slice(0, 1 + len(family.names))
    covariance = fit.covariance[values, values]
    variances = []
    for load in loads:
        change = load.inverse.sensitivity(family, fit.shape)
        slope = np.concatenate([np.ones((3, 1)), change], axis=1)
        variances.append(np.einsum("ij,jk,ik->i", slope, covariance, slope))
    x, y, z = np.mean(variances, axis=0)
    return float(np.sqrt(z)), float(np.sqrt((x + y) / 2))
