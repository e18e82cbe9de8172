"""A linear elastic gel, condensed to its contact nodes and its marker surface."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.disk import cached_arrays
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.elastic.problem import Progress, quarter_count
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.gel.contact_patch import on_rim
from cmp_tactile_simulation.gel.contact_problem import ContactProblem
from cmp_tactile_simulation.gel.parity_response import ParityResponse

__all__ = ["LinearElastomer"]

LOGGER = logging.getLogger(__name__)


class LinearElastomer:
    """The gel of a sensor under small strain: an `Elastomer` whose displacement is proportional.

    nodes: contact nodes along the longer side of the contact patch, 5 to 64.
    cache_dir: folder of the cache; default $XDG_CACHE_HOME/cmp_tactile or ~/.cache/cmp_tactile.
    progress: called with a text and the fraction done, 0 to 1, while the compliance is built.
    Raises GeometryError where the surface of the sensor's block reaches its base, and
    SimulationError for a number of nodes out of range.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        nodes: int = 40,
        cache_dir: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._problem = problem = ContactProblem.with_nodes(sensor, nodes)
        self._young = sensor.elastomer.young
        of_nodes, of_markers = 3 * quarter_count(problem.nodes), 3 * quarter_count(problem.markers)
        arrays = cached_arrays(
            cache_dir,
            "linear_elastomer",
            problem.key,
            {
                "nodes": (len(PARITIES), of_nodes, of_nodes),
                "markers": (len(PARITIES), of_markers, of_nodes),
            },
            lambda: _build(problem, sensor.name, progress),
        )
        self._response = ParityResponse(
            problem.nodes, problem.markers, arrays["nodes"], arrays["markers"]
        )

    @property
    def nodes(self) -> SurfaceGrid:
        """The grid of contact nodes."""
        return self._problem.nodes

    @property
    def observers(self) -> SurfaceGrid:
        """The grid on which the marker surface is observed; spans the whole top of the block."""
        return self._problem.markers

    @property
    def node_position(self) -> NDArray[np.float64]:
        """Contact nodes at rest, (N, 3) m, gel frame: on the contact surface, above the skin."""
        return self._problem.geometry.contact_points(self.nodes.points)

    @property
    def node_area(self) -> NDArray[np.float64]:
        """Undeformed area of the contact surface that belongs to each node, (N,) m^2."""
        x, y = self.nodes.spacing
        return x * y * self._problem.geometry.surface_stretch(self.nodes.points)

    @property
    def on_rim(self) -> NDArray[np.bool_]:
        """Nodes on the patch's outer ring, (N,): contact there may go on outside the patch."""
        return on_rim(self.nodes)

    @property
    def beyond(self) -> NDArray[np.float64]:
        """Points of the contact surface at rest outside the patch, (M, 3) m, gel frame."""
        xy = self.observers.points
        outside = (np.abs(xy) > np.array(self.nodes.extent) / 2).any(axis=1)
        return self._problem.geometry.contact_points(xy[outside])

    @property
    def memory(self) -> dict[str, NDArray[np.float64]]:
        """Empty: a linear gel forgets."""
        return {}

    def recall(self, memory: Mapping[str, NDArray[np.float64]]) -> None:
        """Nothing to do."""

    @property
    def creeps(self) -> bool:
        """False: its shape follows from the forces of the moment."""
        return False

    def advance(self, force: NDArray[np.float64], seconds: float) -> None:
        """Nothing to do."""

    def forget(self) -> None:
        """Nothing to do."""

    def compliance(self, active: NDArray[np.intp]) -> NDArray[np.float64]:
        """Displacement of the active nodes for unit forces on them, (3 k, 3 k) m/N.

        Symmetric and positive definite; row and column 3 a + c is component c of active[a].
        """
        compliance = self._response.compliance(active)
        compliance /= self._young
        return compliance

    def displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N."""
        return self._response.of_nodes(self._unit(force))

    def marker_displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m."""
        moved = self._response.of_markers(self._unit(force))
        return moved.reshape(self.observers.rows, self.observers.cols, 3)

    def _unit(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """The forces for a body of E = 1 Pa."""
        expected = self.nodes.rows * self.nodes.cols, 3
        if np.shape(force) != expected:
            msg = f"force: found shape {np.shape(force)}, expected {expected}"
            raise SimulationError(msg)
        return np.asarray(force, dtype=np.float64) / self._young


def _build(
    problem: ContactProblem, name: str, progress: Progress | None
) -> dict[str, NDArray[np.float64]]:
    LOGGER.info("building the elastomer of %s, about 20 s, cached afterwards", name)
    start = monotonic()
    responses = problem.responses(progress=progress)
    LOGGER.info("built the elastomer of %s in %.1f s", name, monotonic() - start)
    return {
        "nodes": np.stack([(part.work + part.work.T) / 2 for part in responses]),
        "markers": np.stack([part.markers for part in responses]),
    }
