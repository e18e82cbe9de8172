"""Compliance of the gel as a smooth function of what of its material may be wrong.

In Poisson's ratio itself, rather than in the bulk modulus that grows without limit, the response
of a nearly incompressible block is so smooth that a quadratic over 0.44 to 0.4995 errs by 2e-5.
The quadratic is that of a coarse mesh and shows only how the response changes: the response at the
description's values is that of the mesh which ForceModel uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.calibration.outcome import Progress, silent
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem, quarter_count
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.sensor.parts import Elastomer

# How the response to a smooth patch of 3 mm changes from Poisson's ratio 0.48 to 0.46, 6 % of it,
# comes out of this mesh to 0.014 % of the response.
COARSE = MeshDensity(across=12, rim=2, depth=3)
# The quadratic is taken over this many deviations of the prior to either side.
REACH = 2.0
# Range of Poisson's ratio that the quadratic covers at least, and its upper end.
USUAL_POISSON = 0.46
POISSON_MARGIN = 0.02
LARGEST_POISSON = 0.4995

NAMES = ("poisson", "layer_thickness", "thickness", "layer_ratio")


@dataclass(frozen=True)
class MaterialOptions(Parameters, section="material calibration"):
    """How well the material is known before, and when the result is good enough.

    What is not fitted is taken for exact: the dimensions unless they are asked for, and values with
    a factor of 1 or a deviation of 0.  Raises ParameterError for a value outside its range.
    """

    fit_thickness: bool = parameter(False, "fit the gel's thickness, too")
    fit_layer_thickness: bool = parameter(False, "fit the shading layer's thickness, too")
    fit_layer_young: bool = parameter(
        False, "fit the ratio of the shading layer's modulus to the gel's, too"
    )

    young_factor: float = parameter(
        3.0,
        "factor within which Young's modulus is right, for two standard deviations",
        within=(1.001, 100.0),
    )
    poisson: float = parameter(0.015, "standard deviation of Poisson's ratio", within=(0.0, 0.1))
    thickness: float = parameter(
        0.03, "standard deviation of the gel's thickness, relative to it", within=(0.0, 0.15)
    )
    layer_thickness: float = parameter(
        0.2,
        "standard deviation of the shading layer's thickness, relative to it",
        within=(0.0, 0.5),
    )
    layer_factor: float = parameter(
        3.0,
        "factor within which the ratio of the shading layer's modulus to the gel's is right, for "
        "two standard deviations",
        within=(1.0, 10.0),
    )
    offset: float = parameter(
        0.2,
        "standard deviation of the zero offset of a reference force sensor, each component",
        unit="N",
        within=(0.0, 100.0),
    )
    torque_offset: float = parameter(
        2e-3,
        "standard deviation of the zero offset of a reference sensor's torque, each component",
        unit="N m",
        within=(0.0, 10.0),
    )
    model_error: float = parameter(
        0.005,
        "standard deviation of a load's force as the model shows it, relative to the force; all "
        "loads have it in common",
        within=(0.0, 0.5),
    )
    shape_error: float = parameter(
        0.004,
        "standard deviation of how the model spreads the gel's movement, relative to it; all loads "
        "have it in common",
        within=(0.0, 0.5),
    )
    least_load: float = parameter(
        5.0,
        "standard deviations of the force that the noise alone would show, below which a load is "
        "left out",
        within=(1.0, 100.0),
    )
    strain_error: float = parameter(
        0.03,
        "share of the force by which large strain may change it before a linear gel is doubted",
        within=(1e-3, 1.0),
    )
    outlier: float = parameter(
        5.0, "standard deviations from the fit beyond which a load is left out", within=(2.0, 100.0)
    )
    held_share: float = parameter(
        0.5,
        "share of a value's prior deviation that the loads must fall below to change the value",
        within=(0.01, 1.0),
    )
    force_limit: float = parameter(
        0.2,
        "relative standard deviation of the normal force above which the result is not accepted",
        within=(1e-3, 10.0),
    )
    force_wanted: float = parameter(
        0.03,
        "relative standard deviation of normal and tangential force that a good result has",
        within=(1e-3, 10.0),
    )


@dataclass(frozen=True)
class MaterialShape:
    """What decides the shape of the response, while Young's modulus decides its size.

    poisson: absolute; layer_thickness, thickness, layer_ratio (of the layer's modulus to the
    gel's): logarithms of their ratios to the description's.
    """

    poisson: float
    layer_thickness: float = 0.0
    thickness: float = 0.0
    layer_ratio: float = 0.0

    def applied_to(self, elastomer: Elastomer, young: float) -> Elastomer:
        """The elastomer with this shape and this Young's modulus, Pa."""
        layer, size = elastomer.shading_layer, elastomer.size
        ratio = layer.young / elastomer.young * float(np.exp(self.layer_ratio))
        return replace(
            elastomer,
            size=(size[0], size[1], size[2] * float(np.exp(self.thickness))),
            young=young,
            poisson=self.poisson,
            shading_layer=replace(
                layer,
                thickness=layer.thickness * float(np.exp(self.layer_thickness)),
                young=ratio * young,
            ),
        )


class ComplianceFamily:
    """The compliance of a sensor's gel, for E = 1 Pa, as a function of its material's shape.

    elastic: the sensor's model.  names (p,): fields of MaterialShape that vary; prior_std (p,):
    their prior deviations; start (p,): the description's values.  The coarse responses, 15 for
    four values, are kept in the disk cache, see ElasticModel.
    """

    def __init__(  # noqa: PLR0913 - what it is built from, and how
        self,
        sensor: SensorDescription,
        elastic: ElasticModel,
        options: MaterialOptions,
        *,
        cache_dir: Path | None = None,
        on_progress: Progress = silent,
        density: MeshDensity = COARSE,
    ) -> None:
        self._sensor, self._density, self._on_progress = sensor, density, on_progress
        elastomer = sensor.elastomer
        stds = _prior_deviations(elastomer, options)
        self.names = tuple(name for name in NAMES if stds[name] > 0)
        self.prior_std = np.array([stds[name] for name in self.names])
        described = MaterialShape(elastomer.poisson)
        self.start = np.array([getattr(described, name) for name in self.names])
        self._centre, self._reach = self.start.copy(), REACH * self.prior_std
        if "poisson" in self.names:
            low = min(elastomer.poisson, USUAL_POISSON) - POISSON_MARGIN
            high = max(LARGEST_POISSON, elastomer.poisson)
            self._centre[0], self._reach[0] = (low + high) / 2, (high - low) / 2
        self._problem = ElasticProblem.from_sensor(sensor)
        self._described = elastic.compliance * elastomer.young
        self._coefficients = self._quadratic(cache_dir) if self.names else None
        self._last: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def forces(self) -> int:
        """Number of the components of force on the nodes."""
        return 3 * self._problem.nodes.rows * self._problem.nodes.cols

    def shape(self, values: NDArray[np.float64]) -> MaterialShape:
        """The material's shape of values (p,) in the order of `names`."""
        named = dict(zip(self.names, map(float, values), strict=True))
        return MaterialShape(**{"poisson": self._sensor.elastomer.poisson, **named})

    def compliance(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers for unit nodal forces, (3 markers, 3 nodes) m Pa / N."""
        if self._coefficients is None:
            return self._described
        if self._last is None or not np.array_equal(self._last[0], values):
            change = self._terms(values) - self._terms(self.start)
            responses = [np.tensordot(change, item, 1) for item in self._coefficients]
            self._last = np.array(values), self._described + self._problem.expand(responses)
        return self._last[1]

    def slope(self, values: NDArray[np.float64], force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of compliance @ force (3 nodes,) with respect to values, (3 markers, p)."""
        return self._slope(values, force, transposed=False)

    def slope_transposed(
        self, values: NDArray[np.float64], moved: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives of compliance.T @ moved (3 markers,), (3 nodes, p)."""
        return self._slope(values, moved, transposed=True)

    def _slope(
        self, values: NDArray[np.float64], vector: NDArray[np.float64], *, transposed: bool
    ) -> NDArray[np.float64]:
        if self._coefficients is None:
            grid = self._problem.nodes if transposed else self._problem.markers
            return np.zeros((3 * grid.rows * grid.cols, 0))
        slopes = _slopes_of_terms((values - self._centre) / self._reach) / self._reach
        total = np.zeros(())
        for parity, terms in zip(PARITIES, self._coefficients, strict=True):
            at_markers = parity.extension(self._problem.markers.rows, self._problem.markers.cols)
            at_nodes = parity.extension(self._problem.nodes.rows, self._problem.nodes.cols)
            if transposed:
                answers = np.einsum("tmn,m->nt", terms, at_markers.T @ vector)
                total = total + at_nodes @ (answers @ slopes)
            else:
                answers = np.einsum("tmn,n->mt", terms, at_nodes.T @ vector)
                total = total + at_markers @ (answers @ slopes)
        return total

    def _terms(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return _quadratic_terms((values - self._centre) / self._reach)

    def _quadratic(self, cache_dir: Path | None) -> list[NDArray[np.float64]]:
        """Coefficients (terms, 3 quarter markers, 3 quarter nodes) for each parity."""
        points = self._centre + self._reach * _design(len(self.names))
        problems = [self._at(point) for point in points]
        key = {"quadratic": 1, "problems": [problem.key for problem in problems]}
        markers, nodes = self._problem.markers, self._problem.nodes
        shape = len(points) - 1, 3 * quarter_count(markers), 3 * quarter_count(nodes)
        names = [f"coefficients_{index}" for index in range(len(PARITIES))]
        found = cached_arrays(
            cache_dir,
            "material_family",
            key,
            dict.fromkeys(names, shape),
            lambda: dict(zip(names, self._build(problems), strict=True)),
        )
        return [found[name] for name in names]

    def _build(self, problems: Sequence[ElasticProblem]) -> list[NDArray[np.float64]]:
        work, total = "solving the gel for other materials", len(problems)
        responses = []
        for done, problem in enumerate(problems):
            self._on_progress(work, done, total)
            responses.append(problem.solve())
        self._on_progress(work, total, total)
        terms = np.array([[1.0, *_quadratic_terms(x)] for x in _design(len(self.names))])
        inverse = np.linalg.inv(terms)[1:]
        return [
            np.tensordot(inverse, np.stack(response), 1)
            for response in zip(*responses, strict=True)
        ]

    def _at(self, values: NDArray[np.float64]) -> ElasticProblem:
        elastomer = self._sensor.elastomer
        changed = self.shape(values).applied_to(elastomer, elastomer.young)
        block = replace(
            self._problem.geometry, size=changed.size, layer=changed.shading_layer.thickness
        )
        ratio = changed.shading_layer.young / changed.young
        return replace(
            self._problem,
            geometry=block,
            poisson=changed.poisson,
            layer_ratio=ratio,
            density=self._density,
        )


def _prior_deviations(elastomer: Elastomer, options: MaterialOptions) -> dict[str, float]:
    """Deviations of the fields of MaterialShape; 0 where a value is held or means nothing."""
    has_layer = elastomer.shading_layer.thickness > 0
    layer, ratio = (
        has_layer and options.fit_layer_thickness,
        has_layer and options.fit_layer_young,
    )
    return {
        "poisson": options.poisson,
        "layer_thickness": options.layer_thickness if layer else 0.0,
        "thickness": options.thickness if options.fit_thickness else 0.0,
        "layer_ratio": float(np.log(options.layer_factor)) / 2 if ratio else 0.0,
    }


def _design(count: int) -> NDArray[np.float64]:
    """Points (terms, count) that determine a quadratic: centre, both ends, pairs of ends."""
    axes = np.eye(count)
    pairs = [axes[i] + axes[j] for i, j in combinations(range(count), 2)]
    return np.array([np.zeros(count), *axes, *-axes, *pairs])


def _quadratic_terms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The terms of a quadratic in x (count,) beyond its constant."""
    pairs = [x[i] * x[j] for i, j in combinations(range(len(x)), 2)]
    return np.array([*x, *x**2, *pairs])


def _slopes_of_terms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (terms, count) of `_quadratic_terms`."""
    axes = np.eye(len(x))
    pairs = [x[i] * axes[j] + x[j] * axes[i] for i, j in combinations(range(len(x)), 2)]
    return np.array([*axes, *(2 * np.diag(x)), *pairs])
