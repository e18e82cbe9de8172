"""The elastic problem of a gel block: what it depends on, and its solution by finite elements.

The gel is a block with a curved top, bonded at its base, free at its sides, of a nearly
incompressible body and a shading layer of another modulus (paper, V.D: a physical model of the
soft elastomer).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.elastic.block_elimination import Block, inverse_product
from cmp_tactile_processing.elastic.elastomer_mesh import BlockGeometry, BlockMesh, MeshDensity
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, Parity
from cmp_tactile_processing.elastic.nested_dissection import dissected
from cmp_tactile_processing.elastic.quadratic_line import fold, hat_loads, interpolation
from cmp_tactile_processing.elastic.stiffness import stiffness
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "ElasticProblem",
    "Progress",
    "QuarterResponse",
    "QuarterSystem",
    "mesh_under",
    "quarter_count",
]

# To be raised with every change that alters the compliance of the same sensor.
MODEL_VERSION = 2

# The uppermost elements of the body are at most this many times as high as wide.
TALLEST = 1.3

# More force nodes than these add cost but no resolution: the markers' noise hides such detail.
MAX_NODES = 20

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class QuarterResponse:
    """What one parity's part of the loads does to the quarter block, for a body of E = 1 Pa.

    markers (3 quarter markers, k): their displacement under each of k loads, m.
    work (k, k): load times displacement in the sense of that same load, symmetric, J; for unit
    forces on the nodes it is the nodes' own displacement, as seen through their hats.
    """

    markers: NDArray[np.float64]
    work: NDArray[np.float64]


@dataclass(frozen=True)
class QuarterSystem:
    """Equations of the quarter block, held as one parity demands, unknowns in order of elimination.

    matrix: stiffness, N/m.  blocks: for `inverse_product`.
    observers, loads: columns (unknowns, 3 quarter markers) and (unknowns, 3 quarter nodes).
    """

    matrix: sparse.csr_array
    blocks: Sequence[Block]
    observers: sparse.csc_array
    loads: sparse.csc_array

    def respond(self, part: NDArray[np.float64] | None = None) -> QuarterResponse:
        """Response to combinations `part` (3 quarter nodes, k) of the loads, or to each of them."""
        loads = self.loads
        if part is not None:
            if not part.any():
                seen, count = self.observers.shape[1], part.shape[1]
                return QuarterResponse(np.zeros((seen, count)), np.zeros((count, count)))
            loads = sparse.csc_array(loads @ part)
        return QuarterResponse(*inverse_product(self.matrix, self.blocks, self.observers, loads))


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
    def from_sensor(cls, sensor: SensorDescription) -> ElasticProblem:
        """The problem that a sensor poses; GeometryError where its block cannot be meshed."""
        pattern, elastomer = sensor.pattern, sensor.elastomer
        extent = (pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch
        geometry = BlockGeometry.from_sensor(sensor)
        nodes = SurfaceGrid(min(pattern.rows, MAX_NODES), min(pattern.cols, MAX_NODES), extent)
        density = MeshDensity()
        width = 2 * max(_loaded_half_widths(nodes)) / density.across
        return cls(
            geometry=geometry,
            poisson=elastomer.poisson,
            layer_ratio=elastomer.shading_layer.young / elastomer.young,
            markers=SurfaceGrid(pattern.rows, pattern.cols, extent),
            nodes=nodes,
            density=density.deep_enough(geometry.size[2] - geometry.layer, TALLEST * width),
        )

    @property
    def key(self) -> dict[str, Any]:
        """All that the compliance for a body of E = 1 Pa depends on, as numbers and text."""
        return {"version": MODEL_VERSION, **asdict(self)}

    def mesh(self) -> BlockMesh:
        """The quarter block, fine under the hats of the force nodes."""
        return mesh_under(self.nodes, self.geometry, self.density)

    def solve(
        self, forces: NDArray[np.float64] | None = None, progress: Progress | None = None
    ) -> list[NDArray[np.float64]]:
        """Displacement of the quarter grid of markers, as in `responses`, one matrix per parity."""
        return [response.markers for response in self.responses(forces, progress)]

    def responses(
        self, forces: NDArray[np.float64] | None = None, progress: Progress | None = None
    ) -> list[QuarterResponse]:
        """Response of the quarter block to forces on the nodes, one per parity, for E = 1 Pa.

        forces: (3 nodes, k) N, columns of nodal forces on the whole grid; without it, unit
        parts on each node of the quarter grid.
        """
        responses = []
        for done, (parity, system) in enumerate(self.systems()):
            if progress is not None:
                progress("building the elastic model", (done + 0.5) / (len(PARITIES) + 0.5))
            part = None
            if forces is not None:
                part = parity.extension(self.nodes.rows, self.nodes.cols).T @ forces
            responses.append(system.respond(part))
        if progress is not None:
            progress("building the elastic model", 1.0)
        return responses

    def systems(self) -> Iterator[tuple[Parity, QuarterSystem]]:
        """The equations of the quarter block for a body of E = 1 Pa, one system per parity."""
        mesh = self.mesh()
        matrix = 4 * stiffness(mesh, self.poisson, layer_young=self.layer_ratio)
        for parity in PARITIES:
            order, blocks = _elimination_order(mesh, parity)
            observers, loads = self._observers(mesh, parity), self._loads(mesh, parity)
            yield (
                parity,
                QuarterSystem(matrix[order][:, order], blocks, observers[order], loads[order]),
            )

    def expand(
        self, responses: Sequence[NDArray[np.float64]], of_nodes: bool = True
    ) -> NDArray[np.float64]:
        """Response of all markers (3 markers, ...) from those of the quarter grid, by parity."""
        total = np.zeros(())
        for parity, response in zip(PARITIES, responses, strict=True):
            part = parity.extension(self.markers.rows, self.markers.cols) @ response
            if of_nodes:
                part = (parity.extension(self.nodes.rows, self.nodes.cols) @ part.T).T
            total = total + part
        return total

    def _observers(self, mesh: BlockMesh, parity: Parity) -> sparse.csc_array:
        whole = mesh.mirrored()
        x_line = interpolation(whole.x_edges, self.markers.x[self.markers.cols // 2 :])
        y_line = interpolation(whole.y_edges, self.markers.y[self.markers.rows // 2 :])
        return _surface_columns(mesh, parity, mesh.marker_level, x_line, y_line)

    def _loads(self, mesh: BlockMesh, parity: Parity) -> sparse.csc_array:
        whole = mesh.mirrored()
        x_line = hat_loads(whole.x_edges, self.nodes.x).T[self.nodes.cols // 2 :]
        y_line = hat_loads(whole.y_edges, self.nodes.y).T[self.nodes.rows // 2 :]
        return _surface_columns(mesh, parity, mesh.lattice[2] - 1, x_line, y_line)


def mesh_under(nodes: SurfaceGrid, geometry: BlockGeometry, density: MeshDensity) -> BlockMesh:
    """The quarter block, uniform as far as the hats of the nodes reach."""
    return BlockMesh.quarter(geometry, _loaded_half_widths(nodes), density)


def _loaded_half_widths(nodes: SurfaceGrid) -> tuple[float, float]:
    """How far the hats of the nodes reach from the middle along x and y, m."""
    (width, depth), (x, y) = nodes.extent, nodes.spacing
    return width / 2 + x, depth / 2 + y


def quarter_count(grid: SurfaceGrid) -> int:
    """Number of points on the quarter of a grid, those on its axes of symmetry included."""
    return (grid.rows - grid.rows // 2) * (grid.cols - grid.cols // 2)


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


def _elimination_order(mesh: BlockMesh, parity: Parity) -> tuple[NDArray[np.intp], Sequence[Block]]:
    """Free degrees of freedom in the order of their elimination, and its blocks."""
    nx, ny, nz = mesh.lattice
    free = np.ones((nx, ny, nz, 3), dtype=bool)
    free[:, :, 0] = False
    for component in range(3):
        if parity.sign_x(component) < 0:
            free[0, :, :, component] = False
        if parity.sign_y(component) < 0:
            free[:, 0, :, component] = False
    free_of_column = free.reshape(nx * ny, 3 * nz)
    numbers = np.arange(free.size).reshape(free_of_column.shape)
    order, blocks, start = [], [], 0
    for region in dissected(mesh.elements[:2]):
        unknowns = numbers[region.columns][free_of_column[region.columns]]
        order.append(unknowns)
        blocks.append(Block(start, start + len(unknowns), region.children))
        start += len(unknowns)
    return np.concatenate(order), blocks
