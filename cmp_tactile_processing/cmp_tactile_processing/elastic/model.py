"""Linear elastic model of the gel: displacement of the markers under forces on the contact surface.

It is the problem of `elastic_problem` for the markers and force nodes of one sensor, kept on disk.
"""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.disk import cached_arrays
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, mirrored_response
from cmp_tactile_processing.elastic.problem import ElasticProblem, Progress, quarter_count
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["ElasticModel", "ElasticProblem", "Progress", "SurfaceGrid"]

LOGGER = logging.getLogger(__name__)


class ElasticModel:
    """Compliance of a sensor's gel, built in some seconds or loaded from the disk cache.

    cache_dir: folder of the cache; default $XDG_CACHE_HOME/cmp_tactile or ~/.cache/cmp_tactile.
    progress: called with a text and the fraction done, 0 to 1, while the model is built.
    Raises GeometryError where the surface of the sensor's block reaches its base.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._problem = problem = ElasticProblem.from_sensor(sensor)
        self._young = sensor.elastomer.young
        self.markers, self.nodes = problem.markers, problem.nodes
        self._responses = cached_arrays(
            cache_dir,
            "elastic_model",
            problem.key,
            _response_shapes(problem),
            lambda: _build(problem, sensor.name, progress),
        )
        # For where forces have moved to, 1e-7 of the way will do, in half the time.
        self._of_nodes = self._responses["nodes"].astype(np.float32)

    @property
    def node_position(self) -> NDArray[np.float64]:
        """Force nodes on the undeformed contact surface, (nodes, 3) m, gel frame."""
        return self._problem.geometry.contact_points(self.nodes.points)

    @property
    def node_stretch(self) -> NDArray[np.float64]:
        """Area of the contact surface per area seen along z, at the force nodes, (nodes,)."""
        return self._problem.geometry.surface_stretch(self.nodes.points)

    @cached_property
    def compliance(self) -> NDArray[np.float64]:
        """Displacement of the markers for unit nodal forces, (3 markers, 3 nodes) m/N.

        Each nodal force is spread over the contact surface as a bilinear hat, which reaches to
        the neighbouring nodes and keeps the force and its centre.
        """
        markers = self._responses["markers"]
        return self._problem.expand(list(markers)) / self._young

    def node_displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the contact surface at the force nodes, (nodes, 3) m.

        force (nodes, 3) N: nodal forces, spread as hats; the displacement is the mean over the
        same hat, so that force times displacement is work.
        """
        flat = self._checked(force).ravel() / self._young
        if not flat.any():
            return np.zeros((len(flat) // 3, 3))
        moved = mirrored_response(self._of_nodes, self.nodes, self.nodes, flat)
        return moved.reshape(-1, 3)

    def displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers (rows, cols, 3) m under nodal forces (nodes, 3) N."""
        moved = self.compliance @ self._checked(force).ravel()
        return moved.reshape(self.markers.rows, self.markers.cols, 3)

    def _checked(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        count = self.nodes.rows * self.nodes.cols
        if np.shape(force) != (count, 3):
            msg = f"force: found shape {np.shape(force)}, expected {(count, 3)}"
            raise GeometryError(msg)
        return np.asarray(force, dtype=np.float64)


def _build(
    problem: ElasticProblem, name: str, progress: Progress | None
) -> dict[str, NDArray[np.float64]]:
    LOGGER.info("building the elastic model of %s, about 5 s, cached afterwards", name)
    start = monotonic()
    responses = problem.responses(progress=progress)
    LOGGER.info("built the elastic model of %s in %.1f s", name, monotonic() - start)
    return {
        "markers": np.stack([part.markers for part in responses]),
        "nodes": np.stack([(part.work + part.work.T) / 2 for part in responses]),
    }


def _response_shapes(problem: ElasticProblem) -> dict[str, tuple[int, ...]]:
    of_markers, of_nodes = 3 * quarter_count(problem.markers), 3 * quarter_count(problem.nodes)
    count = len(PARITIES)
    return {"markers": (count, of_markers, of_nodes), "nodes": (count, of_nodes, of_nodes)}
