"""The factor of Young's modulus that makes known loads right, and what they leave open.

The force that an elastic inverse shows goes with Young's modulus, also under large strain, where
strain goes with force over modulus.  So the loads are shown once, and the rest is linear: a factor,
and for a reference sensor the offset of its zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.options import MaterialOptions
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.sensor.description import SensorDescription

# Sideways force below this share of the normal force says nothing of sideways forces.
LEAST_SIDEWAYS = 0.1
# A component of a load that is small beside it is modelled as well as this share of the load.
CROSS_TALK = 0.2
# How the response to a patch of 3 mm changes from Poisson's ratio 0.48 to 0.46, 6 % of it, comes
# out of this mesh to 0.014 % of the response.
COARSE = MeshDensity(across=12, rim=2, depth=3)
LARGEST_POISSON = 0.4995
# The deviations depend a little on the factor itself.
ROUNDS = 3
Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoissonDoubt:
    """What a Poisson's ratio that is wrong by one standard deviation changes at most, relative.

    normal: of normal forces; Young's modulus makes up for it.  sideways: of sideways forces beside
    the normal ones; nothing makes up for that.
    """

    normal: float
    sideways: float


def poisson_doubt(
    sensor: SensorDescription, model: ForceModel, pressure: Array, std: float
) -> PoissonDoubt:
    """How far a Poisson's ratio that is wrong by std changes the forces of a contact.

    pressure: normal forces (nodes,) N of it.  Forces of that distribution, normal and sideways,
    move the markers of a gel with the other ratio, and the model reads them; it is one without
    large strain.
    """
    if not std > 0:
        return PoissonDoubt(0.0, 0.0)
    problem = replace(ElasticProblem.from_sensor(sensor), density=COARSE)
    forces = np.zeros((2, len(pressure), 3))
    forces[0, :, 2], forces[1, :, 0] = -pressure, pressure
    # The coarse mesh shows how the displacement changes, that of the model what changes.
    described = _displacements(problem, forces)
    status = np.full(described.shape[1:3], Status.MEASURED, dtype=np.uint8)
    moved = [model.elastic.displacement(force) for force in forces]
    before = [model.reconstruct(u, status).wrench for u in moved]
    normal = sideways = 0.0
    for poisson in (problem.poisson - std, min(problem.poisson + std, LARGEST_POISSON)):
        changed = _displacements(replace(problem, poisson=poisson), forces)
        change = (changed - described) / sensor.elastomer.young
        after = [model.reconstruct(u, status).wrench for u in moved + change]
        press, push = (float(a @ b / (b @ b)) - 1 for a, b in zip(after, before, strict=True))
        normal, sideways = max(normal, abs(press)), max(sideways, abs(push - press))
    return PoissonDoubt(normal, sideways)


def _displacements(problem: ElasticProblem, forces: Array) -> Array:
    """Displacements (2, rows, cols, 3) m Pa of the markers under forces (2, nodes, 3) N."""
    columns = forces.reshape(len(forces), -1).T
    moved = problem.expand(problem.solve(columns), of_nodes=False)
    shape = len(forces), problem.markers.rows, problem.markers.cols, 3
    return np.asarray(moved.T.reshape(shape), dtype=np.float64)


@dataclass(frozen=True)
class Readings:
    """Loads as the sensor shows them beside what they are, gel frame, N; all (n, 3).

    shown, shown_std: with the description's modulus, and what noise makes of them.  reference,
    reference_std: NaN where not known.
    """

    shown: Array
    shown_std: Array
    reference: Array
    reference_std: Array

    def std(self, factor: float, options: MaterialOptions, doubt: PoissonDoubt) -> Array:
        """Standard deviations (n, 3) of shown times factor less reference, offset apart."""
        size = factor * np.abs(self.shown)
        least = CROSS_TALK * np.linalg.norm(size, axis=1, keepdims=True)
        model = options.model_error * np.hypot(size, least)
        sideways = doubt.sideways * size * (1.0, 1.0, 0.0)
        noise = np.hypot(factor * self.shown_std, self.reference_std)
        return np.asarray(np.hypot(np.hypot(noise, model), sideways))


@dataclass(frozen=True)
class ScaleFit:
    """factor: of Young's modulus, std relative, of what differs between loads and of the model.

    offset, offset_std (3,) N: of the reference, NaN where it has none.  misfits (n,): root mean
    square of shown minus reference in standard deviations.
    sideways_spread: relative error of known sideways forces beyond their noise, 0 without any;
    sideways_std: how well their noise lets its mean be known, inf without any.
    """

    factor: float
    std: float
    offset: Array
    offset_std: Array
    misfits: Array
    sideways_spread: float
    sideways_std: float

    def force_std(self, doubt: PoissonDoubt) -> tuple[float, float]:
        """Relative standard deviations of normal and sideways forces with the new modulus.

        Normal ones of any contact: where the loads' own hangs on Poisson's ratio, so does the
        modulus, with which a smaller contact is read.  Sideways loads show how right sideways
        forces are, or else Poisson's ratio is as doubtful as before.
        """
        sideways = min(doubt.sideways, self.sideways_std)
        return (
            float(np.hypot(self.std, doubt.normal)),
            float(np.sqrt(self.std**2 + sideways**2 + self.sideways_spread**2)),
        )


def fit_scale(
    readings: Readings, options: MaterialOptions, doubt: PoissonDoubt, *, has_offset: bool
) -> ScaleFit:
    """The factor that makes the loads right on the whole."""
    known = np.isfinite(readings.reference)
    prior_std = np.array([np.log(options.young_factor) / 2] + 3 * [options.offset * has_offset])
    free = prior_std > 0
    prior = np.diag(prior_std[free] ** -2)
    columns = np.zeros((*known.shape, 4))
    columns[..., 0], columns[..., 1:] = readings.shown, np.eye(3)
    x = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(ROUNDS):
        weight = 1 / readings.std(float(x[0]), options, doubt)[known]
        A = (columns[known] * weight[:, None])[:, free]
        covariance = np.linalg.inv(A.T @ A + prior)
        x[free] = covariance @ (A.T @ (weight * readings.reference[known]) + prior[:, 0])
    off = np.where(known, columns @ x - readings.reference, np.nan)
    std = readings.std(float(x[0]), options, doubt)
    variance = np.full(4, np.nan)
    variance[free] = np.diag(covariance)
    # What the model errs by in all loads alike is not averaged out.
    common = options.model_error * np.sqrt(1 - 1 / len(known))
    noise = np.hypot(x[0] * readings.shown_std, readings.reference_std)
    normal = _Errors.along(slice(2, 3), off, noise, readings.reference)
    sideways = _Errors.along(slice(0, 2), off, noise, readings.reference)
    # One of the normal forces is as good as used up: the modulus makes it right.
    normal_spread = normal.spread(used=1)
    return ScaleFit(
        factor=float(x[0]),
        std=float(np.sqrt(variance[0] / x[0] ** 2 + common**2 + normal_spread**2)),
        offset=np.where(free[1:], x[1:], np.nan),
        offset_std=np.sqrt(variance[1:]),
        misfits=np.sqrt(np.nanmean((off / std) ** 2, axis=1)),
        sideways_spread=sideways.spread(used=0),
        sideways_std=sideways.mean_std,
    )


@dataclass(frozen=True)
class _Errors:
    """Errors (m,) N of one kind of force in the loads that show it, their noise, and the force."""

    off: Array
    noise: Array
    force: Array

    @classmethod
    def along(cls, axes: slice, off: Array, noise: Array, reference: Array) -> _Errors:
        """Of residuals off (n, 3) N with their noise, in axes that are a good part of a load."""
        size = np.linalg.norm(np.nan_to_num(reference), axis=1)
        force = np.linalg.norm(reference[:, axes], axis=1)
        large = force > LEAST_SIDEWAYS * size
        errors, spread = (np.linalg.norm(values[large, axes], axis=1) for values in (off, noise))
        return cls(errors, spread, force[large])

    def spread(self, used: int) -> float:
        """Relative standard deviation beyond the noise, by which small loads say little.

        used: of the loads, by what was fitted to them.
        """
        count = len(self.off) - used
        if count <= 0:
            return 0.0
        beyond = max(0.0, float((self.off**2 - self.noise**2).sum())) / count
        return float(np.sqrt(beyond / np.mean(self.force**2)))

    @property
    def mean_std(self) -> float:
        """What noise makes of their mean; inf without any."""
        noise = self.noise / self.force
        return float(1 / np.sqrt((noise**-2).sum())) if noise.size else np.inf
