"""Linear elastic model of the gel: displacement of the markers under forces on the contact surface.

The gel is a block with a curved top, bonded at its base, free at its sides, of a nearly
incompressible body and a shading layer of another modulus (paper, V.D: a physical model of the
soft elastomer).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.block_elimination import inverse_product
from cmp_tactile_processing.disk_cache import cached_arrays
from cmp_tactile_processing.elastic_stiffness import stiffness
from cmp_tactile_processing.elastomer_mesh import BlockGeometry, BlockMesh, MeshDensity
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.mirror_symmetry import PARITIES, Parity
from cmp_tactile_processing.quadratic_line import fold, hat_loads, interpolation
from cmp_tactile_processing.sensor_description import SensorDescription

__all__ = ["ElasticModel", "ElasticProblem", "Progress", "SurfaceGrid"]

LOGGER = logging.getLogger(__name__)

# To be raised with every change that alters the compliance of the same sensor.
MODEL_VERSION = 1

# More force nodes than these add cost but no resolution: the markers' noise hides such detail.
MAX_NODES = 20

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class SurfaceGrid:
    """A regular grid centred on the gel frame's z axis; point (i, j) is number i * cols + j.

    extent: distance between the outermost points along x and y, m.
    """

    rows: int
    cols: int
    extent: tuple[float, float]

    @property
    def x(self) -> NDArray[np.float64]:
        """The columns' x, (cols,) m."""
        return np.linspace(-self.extent[0] / 2, self.extent[0] / 2, self.cols)

    @property
    def y(self) -> NDArray[np.float64]:
        """The rows' y, (rows,) m."""
        return np.linspace(-self.extent[1] / 2, self.extent[1] / 2, self.rows)

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance between neighbours along x and y, m."""
        return self.extent[0] / (self.cols - 1), self.extent[1] / (self.rows - 1)

    @property
    def points(self) -> NDArray[np.float64]:
        """All points in order, (rows * cols, 2) m."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return np.stack([x.ravel(), y.ravel()], axis=-1)


@dataclass(frozen=True)
class ElasticProblem:
    """All that the compliance depends on: block, material, markers, force nodes and mesh.

    layer_ratio: Young's modulus of the shading layer over that of the body.
    """

    geometry: BlockGeometry
    poisson: float
    layer_ratio: float
    markers: SurfaceGrid
    nodes: SurfaceGrid
    density: MeshDensity = field(default_factory=MeshDensity)

    @classmethod
    def of(cls, sensor: SensorDescription) -> ElasticProblem:
        """The problem that a sensor poses; GeometryError where its block cannot be meshed."""
        pattern, elastomer = sensor.pattern, sensor.elastomer
        extent = (pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch
        return cls(
            geometry=BlockGeometry.of(sensor),
            poisson=elastomer.poisson,
            layer_ratio=elastomer.shading_layer.young / elastomer.young,
            markers=SurfaceGrid(pattern.rows, pattern.cols, extent),
            nodes=SurfaceGrid(min(pattern.rows, MAX_NODES), min(pattern.cols, MAX_NODES), extent),
        )

    @property
    def key(self) -> dict[str, Any]:
        """All that the compliance for a body of E = 1 Pa depends on, as numbers and text."""
        return {"version": MODEL_VERSION, **asdict(self)}

    def mesh(self) -> BlockMesh:
        """The quarter block, fine under the hats of the force nodes."""
        loaded = [
            extent / 2 + spacing
            for extent, spacing in zip(self.nodes.extent, self.nodes.spacing, strict=True)
        ]
        return BlockMesh.quarter(self.geometry, (loaded[0], loaded[1]), self.density)

    def solve(
        self, forces: NDArray[np.float64] | None = None, progress: Progress | None = None
    ) -> list[NDArray[np.float64]]:
        """Response of the quarter grid of markers, one matrix per parity, for a body of E = 1 Pa.

        forces: (3 nodes, k) N, columns of nodal forces on the whole grid; without it, unit
        parts on each node of the quarter grid.
        """
        mesh = self.mesh()
        matrix = 4 * stiffness(mesh, self.poisson, layer_young=self.layer_ratio)
        responses = []
        for done, parity in enumerate(PARITIES):
            if progress is not None:
                progress("building the elastic model", (done + 0.5) / (len(PARITIES) + 0.5))
            loads = self._loads(mesh, parity)
            if forces is not None:
                quarter = self.nodes
                loads = loads @ (parity.extension(quarter.rows, quarter.cols).T @ forces)
            responses.append(_respond(mesh, matrix, parity, self._observers(mesh, parity), loads))
        if progress is not None:
            progress("building the elastic model", 1.0)
        return responses

    def expand(
        self, responses: list[NDArray[np.float64]], of_nodes: bool = True
    ) -> NDArray[np.float64]:
        """Response of all markers (3 markers, ...) from that of the quarter grid."""
        total = np.zeros(())
        for parity, response in zip(PARITIES, responses, strict=True):
            part = parity.extension(self.markers.rows, self.markers.cols) @ response
            if of_nodes:
                part = (parity.extension(self.nodes.rows, self.nodes.cols) @ part.T).T
            total = total + part
        return total

    def _observers(self, mesh: BlockMesh, parity: Parity) -> sparse.csc_array:
        x_line = interpolation(_whole(mesh.x_edges), self.markers.x[self.markers.cols // 2 :])
        y_line = interpolation(_whole(mesh.y_edges), self.markers.y[self.markers.rows // 2 :])
        return _surface_columns(mesh, parity, mesh.marker_level, x_line, y_line)

    def _loads(self, mesh: BlockMesh, parity: Parity) -> sparse.csc_array:
        x_line = hat_loads(_whole(mesh.x_edges), self.nodes.x).T[self.nodes.cols // 2 :]
        y_line = hat_loads(_whole(mesh.y_edges), self.nodes.y).T[self.nodes.rows // 2 :]
        return _surface_columns(mesh, parity, mesh.lattice[2] - 1, x_line, y_line)


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
        self._problem = problem = ElasticProblem.of(sensor)
        self._young = sensor.elastomer.young
        self.markers, self.nodes = problem.markers, problem.nodes
        self._responses = cached_arrays(
            cache_dir,
            "elastic_model",
            problem.key,
            _response_shapes(problem),
            lambda: _build(problem, sensor.name, progress),
        )

    @property
    def node_position(self) -> NDArray[np.float64]:
        """Force nodes on the undeformed contact surface, (nodes, 3) m, gel frame."""
        xy, geometry = self.nodes.points, self._problem.geometry
        z = geometry.surface.height(xy) + geometry.layer
        return np.concatenate([xy, z[:, None]], axis=1)

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
        responses = [self._responses[name] for name in sorted(self._responses)]
        return self._problem.expand(responses) / self._young

    def displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers (rows, cols, 3) m under nodal forces (nodes, 3) N."""
        count = self.nodes.rows * self.nodes.cols
        if np.shape(force) != (count, 3):
            msg = f"force: found shape {np.shape(force)}, expected {(count, 3)}"
            raise GeometryError(msg)
        moved = self.compliance @ np.asarray(force, dtype=np.float64).ravel()
        return moved.reshape(self.markers.rows, self.markers.cols, 3)


def _build(
    problem: ElasticProblem, name: str, progress: Progress | None
) -> dict[str, NDArray[np.float64]]:
    LOGGER.info("building the elastic model of %s, about 15 s, cached afterwards", name)
    start = monotonic()
    # On two loaded cores the factors took 65 s on two BLAS threads, and 19 s on one.
    with threadpool_limits(1):
        responses = problem.solve(progress=progress)
    LOGGER.info("built the elastic model of %s in %.1f s", name, monotonic() - start)
    return {f"response_{index}": response for index, response in enumerate(responses)}


def _response_shapes(problem: ElasticProblem) -> dict[str, tuple[int, int]]:
    counts = [
        3 * (grid.rows - grid.rows // 2) * (grid.cols - grid.cols // 2)
        for grid in (problem.markers, problem.nodes)
    ]
    return {f"response_{index}": (counts[0], counts[1]) for index in range(len(PARITIES))}


def _whole(edges: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([-edges[:0:-1], edges])


def _surface_columns(
    mesh: BlockMesh,
    parity: Parity,
    level: int,
    x_line: NDArray[np.float64],
    y_line: NDArray[np.float64],
) -> sparse.csc_array:
    """Columns (dofs, 3 points) at one level of the quarter, from factors on whole lines."""
    nx, ny, nz = mesh.lattice
    rows, cols, values = [], [], []
    for component in range(3):
        points = sparse.coo_array(
            sparse.kron(
                fold(y_line, parity.sign_y(component)), fold(x_line, parity.sign_x(component))
            )
        )
        iy, ix = np.divmod(points.col.astype(np.intp), nx)
        rows.append(3 * ((ix * ny + iy) * nz + level) + component)
        cols.append(3 * points.row.astype(np.intp) + component)
        values.append(points.data)
    shape = 3 * nx * ny * nz, 3 * len(x_line) * len(y_line)
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return sparse.coo_array(entries, shape=shape).tocsc()


def _respond(
    mesh: BlockMesh,
    matrix: sparse.csr_array,
    parity: Parity,
    observers: sparse.csc_array,
    loads: sparse.csc_array | NDArray[np.float64],
) -> NDArray[np.float64]:
    """What the observers see of the quarter block under the loads, held as the parity demands."""
    order, slices = _elimination_order(mesh, parity)
    return inverse_product(
        matrix[order][:, order], slices, observers[order], sparse.csc_array(loads[order])
    )


def _elimination_order(mesh: BlockMesh, parity: Parity) -> tuple[NDArray[np.intp], list[int]]:
    """Free degrees of freedom in slices along x, from the side inwards, and the slices' bounds.

    A slice is one column of elements: its middle plane of nodes, then the plane towards x = 0,
    which alone touches the next slice.
    """
    nx, ny, nz = mesh.lattice
    free = np.ones((nx, ny, nz, 3), dtype=bool)
    free[:, :, 0] = False
    for component in range(3):
        if parity.sign_x(component) < 0:
            free[0, :, :, component] = False
        if parity.sign_y(component) < 0:
            free[:, 0, :, component] = False
    numbers = np.arange(free.size).reshape(nx, -1)
    planes = [numbers[ix][free[ix].ravel()] for ix in range(nx - 1, -1, -1)]
    counts = np.cumsum([len(plane) for plane in planes])
    return np.concatenate(planes), [0, *(int(count) for count in counts[::2])]
