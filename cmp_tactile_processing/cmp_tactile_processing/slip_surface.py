"""Where the deformed contact surface lies and which way it faces, at the force nodes.

What slides, slides along the contact surface, which lies above the markers by the shading layer.
A layer of 0.3 mm under a sliding ball of 8 mm radius turns the mean normal by 0.03 rad against
that of the marker surface, which would make an error of 0.03 of the friction coefficient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic_problem import ElasticProblem
from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.surface import Surface
from cmp_tactile_processing.surface_grid import SurfaceGrid

__all__ = ["ContactSurface", "DeformedNodes"]

# Rounds in which unknown markers take the mean of their known neighbours: the largest gap, in
# markers from its rim to its middle, that is bridged.
FILL_ROUNDS = 4


@dataclass(frozen=True)
class DeformedNodes:
    """The force nodes of a frame, gel frame.

    rest (M, 2) m: undeformed.  place (M, 3) m: on the deformed contact surface.  normal (M, 3):
    its unit normal, out of the gel; both NaN amid more missing markers than can be bridged.
    known (M,): share of the markers around a node that are measured, 0 to 1.
    spacing: mean distance of neighbours, m.
    """

    rest: NDArray[np.float64]
    place: NDArray[np.float64]
    normal: NDArray[np.float64]
    known: NDArray[np.float64]
    spacing: float


class ContactSurface:
    """The contact surface of a sensor, from its markers and the traction on it."""

    def __init__(self, sensor: SensorDescription) -> None:
        problem, elastomer = ElasticProblem.of(sensor), sensor.elastomer
        self.nodes, self._markers = problem.nodes, problem.markers
        self._rest, self._rest_nodes = sensor.pattern.corners(), problem.nodes.points
        layer, poisson = elastomer.shading_layer, elastomer.poisson
        self._height = layer.thickness
        self._shear_compliance = 2 * (1 + poisson) / layer.young if layer.thickness > 0 else 0.0
        # What is stretched along the surface becomes thinner; pressure alone hardly matters.
        self._thinning = poisson / (1 - poisson)
        self._area = self.nodes.spacing[0] * self.nodes.spacing[1]
        self._corner, self._weight = _interpolation(self._markers, self.nodes)

    def at_nodes(self, surface: Surface, force: NDArray[np.float64]) -> DeformedNodes:
        """The nodes of a frame.  force: (M, 3) N, 0 outside of contact."""
        moved = np.asarray(surface.displacement, np.float64)
        known = np.isfinite(moved).all(axis=-1) & (surface.status != Status.MISSING)
        moved = _filled(np.where(known[..., None], moved, 0.0), known)
        spread = _slope(moved[..., 0], self._markers.x, 1) + _slope(
            moved[..., 1], self._markers.y, 0
        )
        values = np.concatenate(
            [self._rest + moved, spread[..., None], known[..., None]], axis=-1
        ).reshape(-1, 5)
        values = np.einsum("mk,mkc->mc", self._weight, values[self._corner])
        place, spread = values[:, :3], values[:, 3]
        normal = self._normal(place)
        along = force - (force * normal).sum(axis=1)[:, None] * normal
        height = self._height * (1 - self._thinning * spread)
        sheared = self._height * self._shear_compliance / self._area * along
        place = place + height[:, None] * normal + sheared
        spacing = float(np.mean(self.nodes.spacing))
        return DeformedNodes(self._rest_nodes, place, self._normal(place), values[:, 4], spacing)

    def _normal(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        grid = place.reshape(self.nodes.rows, self.nodes.cols, 3)
        along_x, along_y = _slope(grid, None, 1), _slope(grid, None, 0)
        normal = np.cross(along_x, along_y).reshape(-1, 3)
        return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])


def _slope(
    values: NDArray[np.float64], at: NDArray[np.float64] | None, axis: int
) -> NDArray[np.float64]:
    """Derivative along an axis, central inside; per step where `at` is not given."""
    steps = () if at is None else (at,)
    return np.asarray(np.gradient(values, *steps, axis=axis))


def _filled(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Values (rows, cols, 3), the unknown (0 there) replaced by the mean of their neighbours."""
    if known.all():
        return values
    for _ in range(FILL_ROUNDS):
        total = np.concatenate([values, known[..., None]], axis=-1)
        padded = np.pad(total, ((1, 1), (1, 1), (0, 0)))
        total = padded[:-2] + padded[1:-1] + padded[2:]
        total = total[:, :-2] + total[:, 1:-1] + total[:, 2:]
        new = ~known & (total[..., 3] > 0)
        values[new] = total[new][:, :3] / total[new][:, 3:]
        known = known | new
    values[~known] = np.nan
    return values


def _interpolation(
    markers: SurfaceGrid, nodes: SurfaceGrid
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Numbers (M, 4) and weights (M, 4) of the markers around each node; clamped outside."""
    points = nodes.points
    at = [(points[:, axis] + markers.extent[axis] / 2) / markers.spacing[axis] for axis in (0, 1)]
    counts = markers.cols, markers.rows
    first = [np.clip(a.astype(np.intp), 0, n - 2) for a, n in zip(at, counts, strict=True)]
    u, v = (np.clip(a - f, 0.0, 1.0) for a, f in zip(at, first, strict=True))
    corner = first[1] * markers.cols + first[0]
    numbers = np.stack([corner, corner + 1, corner + markers.cols, corner + markers.cols + 1], 1)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
    return numbers, weights
