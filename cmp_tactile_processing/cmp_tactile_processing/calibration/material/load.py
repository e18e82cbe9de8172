"""What one known load tells of the material: its force, and whether the gel moved as it should.

The force is sought only where the first look found contact.  The markers around it, which nothing
touches, then tell whether the gel of a given Poisson's ratio and layer moves as the markers did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.ndimage import binary_dilation

from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily
from cmp_tactile_processing.calibration.material.sample import LoadSample
from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.force.traction_prior import gradient_penalty
from cmp_tactile_processing.measured.force_field import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["LoadInverse", "LoadView"]

# What the penalty of a load's own force adds to the sum of squares.  It holds what the markers do
# not show at all: at 1 the smoothness of the force already speaks for a thinner layer, by 0.8
# deviations of its prior at half a newton, while at 0.001 no value is off by more than its scatter.
PENALTY = 1e-3
# What mesh, optics and details of the force leave of a marker's displacement, relative to it.
MODEL_ERROR = 0.01
EVERYWHERE = np.ones((3, 3), dtype=bool)


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
    their movement tells of the material, which errors of the model make larger.
    field: what ForceModel makes of the sample; it tells where the contact is.
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
        follows most of such an error, so that what is left of the movement does not tell it.
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
        """Factor by which residuals that resemble their neighbours' tell less than their number.

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
