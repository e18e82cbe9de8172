"""The gel under small strain."""

from __future__ import annotations

import logging
from pathlib import Path
from time import monotonic

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.cache.one_thread import one_thread
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, mirrored_response
from cmp_tactile_processing.elastic.model import Progress, quarter_count
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.gel.problem import ContactProblem, on_rim

LOGGER = logging.getLogger(__name__)


class LinearElastomer:
    """The gel of a sensor under small strain, bonded at its base, loaded on its contact surface.

    The nodes are a regular grid in x and y on the undeformed contact surface; node (i, j) is
    number i * cols + j, N = rows * cols.  A nodal force is spread as a bilinear hat over the
    neighbouring nodes' area, and the displacement of a node is the mean over the same hat, so
    that force times displacement is work.  Forces act on the gel, gel frame, N.

    nodes: contact nodes along the longer side of the contact patch, 5 to 64.
    cache_dir: folder of the cache; default $XDG_CACHE_HOME/cmp_tactile or ~/.cache/cmp_tactile.
    progress: called with a text and the fraction done, 0 to 1, while the compliance is built.
    Raises GeometryError where the surface of the sensor's block reaches its base, and
    SimulationError for a number of nodes out of range.
    """

    # Whether its shape depends on how long its forces have been there, see `advance`.
    creeps = False
    # Whether its compliance changes from step to step.
    softens = False

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
        """Points of the contact surface at rest outside the patch, where nothing may touch.

        (M, 3) m, gel frame.
        """
        xy = self.observers.points
        outside = (np.abs(xy) > np.array(self.nodes.extent) / 2).any(axis=1)
        return self._problem.geometry.contact_points(xy[outside])

    def advance(self, force: NDArray[np.float64], seconds: float) -> None:
        """Let time go on by `seconds`, from the state under `force` (N, 3) N, where it creeps."""

    def forget(self) -> None:
        """Be a gel that was never touched, where it creeps."""

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


class ParityResponse:
    """Displacement of nodes and markers of a block under forces on its nodes.

    nodes, markers: the grids, N and M points.
    of_nodes, of_markers: (4, 3 n, 3 n) and (4, 3 m, 3 n) m/N, per parity the response of the
    quarter grids to unit parts on the quarter's nodes; of_nodes is symmetric in each parity.
    """

    def __init__(
        self,
        nodes: SurfaceGrid,
        markers: SurfaceGrid,
        of_nodes: NDArray[np.float64],
        of_markers: NDArray[np.float64],
    ) -> None:
        self._of_nodes, self._of_markers = of_nodes, of_markers
        self._nodes, self._markers = nodes, markers
        self._image, self._sign = _images(_extensions(nodes))

    def compliance(self, active: NDArray[np.intp]) -> NDArray[np.float64]:
        """Displacement of the nodes `active` (k,) for unit forces on them, (3 k, 3 k) m/N."""
        rows = (3 * self._image[active][:, None] + np.arange(3)).ravel()
        signs = self._sign[:, active].reshape(len(PARITIES), -1)
        return np.asarray(_gather(self._of_nodes, rows, signs))

    def of_nodes(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the nodes (N, 3) m under forces (N, 3) N on them."""
        return self._apply(self._of_nodes, self._nodes, force)

    def of_markers(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers (M, 3) m under forces (N, 3) N on the nodes."""
        return self._apply(self._of_markers, self._markers, force)

    def _apply(
        self, responses: NDArray[np.float64], target: SurfaceGrid, force: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        # Reading memory is what takes the time; threads only wait for one another on loaded cores.
        with one_thread():
            moved = mirrored_response(responses, self._nodes, target, force.ravel())
        return moved.reshape(-1, 3)


def _extensions(grid: SurfaceGrid) -> list[sparse.csr_array]:
    return [parity.extension(grid.rows, grid.cols) for parity in PARITIES]


def _images(
    extensions: list[sparse.csr_array],
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number in the quarter of each point's image (N,), and the signs there (4, N, 3).

    A sign is 0 where a point is its own image and the component odd.
    """
    total = sum(abs(matrix) for matrix in extensions).tocsr()
    image = total.indices[total.indptr[:-1:3]] // 3
    sign = np.stack([np.asarray(matrix.sum(axis=1)).reshape(-1, 3) for matrix in extensions])
    return image.astype(np.intp), sign


@kernel
def _gather(
    response: NDArray[np.float64], row: NDArray[np.intp], sign: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Entry (i, j): sum over parities of sign[p, i] sign[p, j] response[p, row[i], row[j]]."""
    count = len(row)
    gathered = np.zeros((count, count))
    for i in range(count):
        out = gathered[i]
        for parity in range(4):
            one, signs = response[parity, row[i]], sign[parity]
            for j in range(count):
                out[j] += signs[i] * signs[j] * one[row[j]]
    return gathered
