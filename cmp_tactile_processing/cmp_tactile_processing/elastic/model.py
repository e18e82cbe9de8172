"""Linear elastic model of the gel: displacement of the markers under forces on the contact surface.

The gel is a block with a curved top, bonded at its base, free at its sides, of a nearly
incompressible body and a shading layer of another modulus (paper, V.D: a physical model of the
soft elastomer).  `ElasticProblem` solves it by finite elements, `ElasticModel` keeps the solution
for the markers and force nodes of one sensor on disk.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.elastic.cholesky import Dissection
from cmp_tactile_processing.elastic.mesh import (
    BlockGeometry,
    BlockMesh,
    MeshDensity,
    element_stiffness,
    fold,
    hat_loads,
    interpolation,
)
from cmp_tactile_processing.elastic.mirror_symmetry import (
    PARITIES,
    Fold,
    MirroredProduct,
    Parity,
)
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription

# To be raised with every change that alters the compliance of the same sensor.
MODEL_VERSION = 2

# The uppermost elements of the body are at most this many times as high as wide.
TALLEST = 1.3

# Farther apart than this, m, force nodes blur small contacts: at twice the distance a ball that
# touches over 2 mm weighs 3 % too much.  More nodes along a side than MAX_NODES cost too much time.
NODE_SPACING, MAX_NODES = 0.6e-3, 20
# The response of the markers to the nodes is kept whole: 104 MB for so many.
MAX_MARKERS = 60 * 60


LOGGER = logging.getLogger(__name__)


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
    """Equations of the quarter block, held as one parity demands.

    stiffness (elements, 81, 81) N/m.  observers, loads: columns (unknowns, 3 quarter markers) and
    (unknowns, 3 quarter nodes).
    """

    dissection: Dissection
    stiffness: NDArray[np.float64]
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
        products = self.dissection.inverse_product(self.stiffness, self.observers, loads)
        return QuarterResponse(*products)


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
        """The problem that a sensor poses.

        Raises InputError where its block cannot be meshed, or has too many markers.
        """
        pattern, elastomer = sensor.pattern, sensor.elastomer
        if pattern.rows * pattern.cols > MAX_MARKERS:
            msg = (
                f"{sensor.origin}: pattern.rows, pattern.cols: found {pattern.rows} x "
                f"{pattern.cols}, expected at most {MAX_MARKERS} corners for forces"
            )
            raise InputError(msg)
        extent = (pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch
        geometry = BlockGeometry.from_sensor(sensor)
        rows, cols = _node_count(pattern.rows, extent[1]), _node_count(pattern.cols, extent[0])
        nodes = SurfaceGrid(rows, cols, extent)
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
        self, forces: NDArray[np.float64] | None = None, progress: OnProgress | None = None
    ) -> list[NDArray[np.float64]]:
        """Displacement of the quarter grid of markers, as in `responses`, one matrix per parity."""
        return [response.markers for response in self.responses(forces, progress)]

    def responses(
        self, forces: NDArray[np.float64] | None = None, progress: OnProgress | None = None
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
        local = 4 * element_stiffness(mesh, self.poisson, layer_young=self.layer_ratio)
        nodes = mesh.element_nodes()
        for parity in PARITIES:
            dissection = Dissection(mesh.lattice, nodes, parity.free(mesh.lattice))
            observers, loads = self._observers(mesh, parity), self._loads(mesh, parity)
            yield parity, QuarterSystem(dissection, local, observers, loads)

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


def _node_count(markers: int, extent: float) -> int:
    """Force nodes along a side of so many markers, m long: at the markers where these are close."""
    # Rounded: 10.8 mm are 18 spacings, and a last digit more.
    return min(max(markers, math.ceil(round(extent / NODE_SPACING, 6)) + 1), MAX_NODES)


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


class ElasticModel:
    """Compliance of a sensor's gel, built in some seconds or loaded from the disk cache.

    cache_dir: folder of the cache; default $XDG_CACHE_HOME/cmp_tactile or ~/.cache/cmp_tactile.
    progress: called with a text and the fraction done, 0 to 1, while the model is built.
    Raises InputError where the surface of the sensor's block reaches its base.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
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
        fold = Fold.into(parity.extension(self.nodes.rows, self.nodes.cols) for parity in PARITIES)
        # The parts are symmetric.
        parts = self._responses["nodes"].astype(np.float32)
        self._of_nodes = MirroredProduct(parts, fold, fold)

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
        return self._of_nodes.of_vector(flat).reshape(-1, 3)

    def displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers (rows, cols, 3) m under nodal forces (nodes, 3) N."""
        moved = self.compliance @ self._checked(force).ravel()
        return moved.reshape(self.markers.rows, self.markers.cols, 3)

    def _checked(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        count = self.nodes.rows * self.nodes.cols
        if np.shape(force) != (count, 3):
            msg = f"force: found shape {np.shape(force)}, expected {(count, 3)}"
            raise InputError(msg)
        return np.asarray(force, dtype=np.float64)


def _build(
    problem: ElasticProblem, name: str, progress: OnProgress | None
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
