"""The gel under contact: linear, and relaxing.

In: `SensorDescription`, tractions on the contact nodes.
Out: displacements of contact nodes and markers.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.elastic.mesh import (
    BlockGeometry,
    BlockMesh,
    MeshDensity,
)
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, Fold, MirroredProduct
from cmp_tactile_processing.elastic.model import ElasticProblem, quarter_count
from cmp_tactile_processing.elastic.relaxation import step_weights
from cmp_tactile_processing.errors import ContactError
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import GelRelaxation

Array = NDArray[np.float64]
Index = NDArray[np.intp]
LOGGER = logging.getLogger(__name__)
# How far the patch reaches beyond the outer checkers of the pattern, m.
PATCH_MARGIN = 1e-3
# Fewer nodes do not make a contact; more ask for gigabytes of memory and minutes to build.
NODES_RANGE = (5, 64)
LEAST_ALONG_SHORTER = 4
# Distance of the observers, m, unless the block is so wide that there would be too many.
OBSERVER_SPACING, MAX_OBSERVERS = 0.4e-3, 64
# To be raised with every change that alters the compliance of the same sensor.
CONTACT_VERSION = 1
# The uppermost elements of the body are at most this many times as high as wide, as those of a
# body of 6 mm under 40 nodes are.
TALLEST = 2.2


def contact_nodes(sensor: SensorDescription, nodes: int) -> SurfaceGrid:
    """The contact nodes, over the pattern, its outer checkers and a margin as the block has room.

    nodes: along the longer side; the distance between neighbours is the same along the other.
    The outermost nodes keep one such distance from the block's side.
    Raises ContactError for a number of nodes out of range.
    """
    least, most = NODES_RANGE
    if not least <= nodes <= most:
        msg = f"{sensor.name}: contact nodes: found {nodes}, expected {least} to {most}"
        raise ContactError(msg)
    pattern = sensor.pattern
    size = sensor.elastomer.size[:2]
    wanted = [
        (count + 1) * pattern.pitch + 2 * PATCH_MARGIN for count in (pattern.cols, pattern.rows)
    ]
    extents = [
        min(want, side * (nodes - 1) / (nodes + 1)) for want, side in zip(wanted, size, strict=True)
    ]
    spacing = max(extents) / (nodes - 1)
    cols, rows = (
        min(
            max(math.ceil(extent / spacing - 1e-6) + 1, LEAST_ALONG_SHORTER),
            math.floor(side / spacing + 1e-6) - 1,
        )
        for extent, side in zip(extents, size, strict=True)
    )
    if min(rows, cols) < LEAST_ALONG_SHORTER:
        msg = (
            f"{sensor.name}: contact nodes: found {nodes} along the longer side and "
            f"{min(rows, cols)} along the shorter side, expected at least {LEAST_ALONG_SHORTER} "
            "along the shorter side"
        )
        raise ContactError(msg)
    return SurfaceGrid(rows, cols, ((cols - 1) * spacing, (rows - 1) * spacing))


def on_rim(nodes: SurfaceGrid) -> NDArray[np.bool_]:
    """Whether a node lies on the outer ring of the grid, (rows * cols,)."""
    rim = np.ones((nodes.rows, nodes.cols), dtype=bool)
    rim[1:-1, 1:-1] = False
    return rim.ravel()


def observers(sensor: SensorDescription) -> SurfaceGrid:
    """A grid over the whole top of the block, its edges included."""
    width, depth = sensor.elastomer.size[:2]
    spacing = max(OBSERVER_SPACING, max(width, depth) / (MAX_OBSERVERS - 1))
    cols, rows = (math.ceil(side / spacing - 1e-6) + 1 for side in (width, depth))
    return SurfaceGrid(rows, cols, (width, depth))


@dataclass(frozen=True)
class ContactProblem(ElasticProblem):
    """The problem of contact nodes and of observers of the marker surface.

    Elements are as wide as the nodes' distance and lie alike under each node: a mesh that lies
    differently under neighbours gives them another stiffness, which shows as ripples of pressure.

    For 40 nodes on a 22 x 22 x 6 mm block the displacement of the markers differs from that on
    elements half as wide by 0.05 % under a Hertzian patch of 3 mm radius, 0.12 % under one of
    1.5 mm and 0.5 % under four nodes; 5 elements of depth instead of 3, 2 of skin instead of 1
    and 5 of rim instead of 3 change as little.  What a single node yields is 1.7 % too little.
    """

    @classmethod
    def with_nodes(cls, sensor: SensorDescription, nodes: int) -> ContactProblem:
        """The problem that a sensor poses with so many contact nodes along the longer side.

        Raises InputError where its block cannot be meshed, ContactError for a number of
        nodes out of range.
        """
        elastomer, grid = sensor.elastomer, contact_nodes(sensor, nodes)
        layer = elastomer.shading_layer
        # Without a skin the body alone makes the mesh fine under the surface.
        depth = 3 if layer.thickness > 0 else 4
        density = MeshDensity(max(_elements_across(grid)), depth=depth, growth=2.0)
        width = max(grid.spacing)
        return cls(
            geometry=BlockGeometry.from_sensor(sensor),
            poisson=elastomer.poisson,
            layer_ratio=layer.young / elastomer.young,
            markers=observers(sensor),
            nodes=grid,
            density=density.deep_enough(elastomer.size[2] - layer.thickness, TALLEST * width),
        )

    @property
    def key(self) -> dict[str, Any]:
        """All that the compliance for a body of E = 1 Pa depends on, as numbers and text."""
        return {**super().key, "contact_version": CONTACT_VERSION}

    def mesh(self) -> BlockMesh:
        """The quarter block, its elements aligned with the contact nodes."""
        across, spacing = _elements_across(self.nodes), self.nodes.spacing
        loaded = across[0] * spacing[0] / 2, across[1] * spacing[1] / 2
        return BlockMesh.quarter(self.geometry, loaded, self.density)


def _elements_across(nodes: SurfaceGrid) -> tuple[int, int]:
    """Even numbers of elements along x and y that reach beyond the outermost nodes.

    An even number of nodes is centred on elements, an odd one on the edges between them.
    """
    return nodes.cols + nodes.cols % 2, nodes.rows + nodes.rows % 2


class LinearElastomer:
    """The gel of a sensor under small strain, bonded at its base, loaded on its contact surface.

    The nodes are a regular grid in x and y on the undeformed contact surface; node (i, j) is
    number i * cols + j, N = rows * cols.  A nodal force is spread as a bilinear hat over the
    neighbouring nodes' area, and the displacement of a node is the mean over the same hat, so
    that force times displacement is work.  Forces act on the gel, gel frame, N.

    nodes: contact nodes along the longer side of the contact patch, 5 to 64.
    cache_dir: folder of the cache; default $XDG_CACHE_HOME/cmp_tactile or ~/.cache/cmp_tactile.
    progress: called with a text and the fraction done, 0 to 1, while the compliance is built.
    Raises InputError where the surface of the sensor's block reaches its base, and
    ContactError for a number of nodes out of range.
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
        progress: OnProgress | None = None,
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

    @cached_property
    def node_position(self) -> Array:
        """Contact nodes at rest, (N, 3) m, gel frame: on the contact surface, above the skin."""
        return self._problem.geometry.contact_points(self.nodes.points)

    @cached_property
    def node_area(self) -> Array:
        """Undeformed area of the contact surface that belongs to each node, (N,) m^2."""
        x, y = self.nodes.spacing
        return x * y * self._problem.geometry.surface_stretch(self.nodes.points)

    @cached_property
    def on_rim(self) -> NDArray[np.bool_]:
        """Nodes on the patch's outer ring, (N,): contact there may go on outside the patch."""
        return on_rim(self.nodes)

    @cached_property
    def beyond(self) -> Array:
        """Points of the contact surface at rest outside the patch, where nothing may touch.

        (M, 3) m, gel frame.
        """
        xy = self.observers.points
        outside = (np.abs(xy) > np.array(self.nodes.extent) / 2).any(axis=1)
        return self._problem.geometry.contact_points(xy[outside])

    def advance(self, force: Array, seconds: float) -> None:
        """Let time go on by `seconds`, from the state under `force` (N, 3) N, where it creeps."""

    def forget(self) -> None:
        """Be a gel that was never touched, where it creeps."""

    def compliance(self, active: Index) -> Array:
        """Displacement of the active nodes for unit forces on them, (3 k, 3 k) m/N.

        Symmetric and positive definite; row and column 3 a + c is component c of active[a].
        """
        compliance = self._response.compliance(active)
        compliance /= self._young
        return compliance

    def displacement(self, force: Array) -> Array:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N."""
        return self._response.of_nodes(self._unit(force))

    def marker_displacement(self, force: Array) -> Array:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m."""
        moved = self._response.of_markers(self._unit(force))
        return moved.reshape(self.observers.rows, self.observers.cols, 3)

    def _unit(self, force: Array) -> Array:
        """The forces for a body of E = 1 Pa."""
        return np.asarray(force, dtype=np.float64) / self._young


def _build(problem: ContactProblem, name: str, progress: OnProgress | None) -> dict[str, Array]:
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
        of_nodes: Array,
        of_markers: Array,
    ) -> None:
        self._of_nodes = of_nodes
        extensions = _extensions(nodes)
        self._image, self._sign = _images(extensions)
        source, target = Fold.into(extensions), Fold.into(_extensions(markers))
        self._node_product = MirroredProduct(of_nodes, source, source)
        self._marker_product = MirroredProduct(of_markers.transpose(0, 2, 1), source, target)

    def compliance(self, active: Index) -> Array:
        """Displacement of the nodes `active` (k,) for unit forces on them, (3 k, 3 k) m/N."""
        rows = (3 * self._image[active][:, None] + np.arange(3)).ravel()
        signs = self._sign[:, active].reshape(len(PARITIES), -1)
        return np.asarray(_gather(self._of_nodes, rows, signs))

    def of_nodes(self, force: Array) -> Array:
        """Displacement of the nodes (N, 3) m under forces (N, 3) N on them."""
        return self._node_product.of_vector(force.ravel()).reshape(-1, 3)

    def of_markers(self, force: Array) -> Array:
        """Displacement of the markers (M, 3) m under forces (N, 3) N on the nodes."""
        return self._marker_product.of_vector(force.ravel()).reshape(-1, 3)


def _extensions(grid: SurfaceGrid) -> list[sparse.csr_array]:
    return [parity.extension(grid.rows, grid.cols) for parity in PARITIES]


def _images(
    extensions: list[sparse.csr_array],
) -> tuple[Index, Array]:
    """Number in the quarter of each point's image (N,), and the signs there (4, N, 3).

    A sign is 0 where a point is its own image and the component odd.
    """
    total = sum(abs(matrix) for matrix in extensions).tocsr()
    image = total.indices[total.indptr[:-1:3]] // 3
    sign = np.stack([np.asarray(matrix.sum(axis=1)).reshape(-1, 3) for matrix in extensions])
    return image.astype(np.intp), sign


@kernel
def _gather(response: Array, row: Index, sign: Array) -> Array:
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


class RelaxingElastomer:
    """An elastomer with one Prony term: its forces fade while its shape stays.

    Quasi-linear viscoelasticity: the elastic forces g, which would hold a shape at once, and the
    forces f, which hold it after its history, differ by what the gel has given up,

        f(t) = g(t) - share q(t),    dq/dt = (g - q) / time.

    For a linear gel this is exact linear viscoelasticity with a common relaxation of all moduli:
    contact area, friction and shape follow from the contact solver, loading and unloading alike.
    For a neo-Hookean one it takes the relaxation to act on the nodal forces.

    Time goes on by `advance`; all displacements between two calls are those at the end of the
    step, over which g grows along a straight line.  A gel that was let go keeps a dent that
    fades: its displacement without force is not zero.
    """

    creeps = True
    softens = True

    def __init__(self, elastic: LinearElastomer, relaxation: GelRelaxation) -> None:
        self.elastic, self.relaxation = elastic, relaxation
        # What does not change with time is that of the inner one; see LinearElastomer.
        self.nodes, self.observers = elastic.nodes, elastic.observers
        self.node_position, self.node_area = elastic.node_position, elastic.node_area
        self.on_rim, self.beyond = elastic.on_rim, elastic.beyond
        nothing = np.zeros_like(elastic.node_position)
        self._lag, self._before, self._step_s = nothing, nothing, 0.0

    def advance(self, force: Array, seconds: float) -> None:
        """Let time go on by `seconds`; force (N, 3) N: what the step that ends was solved for."""
        reached = self._elastic_force(force)
        kept, before, now = self._weights()
        self._lag = kept * self._lag + before * self._before + now * reached
        self._before, self._step_s = reached, float(seconds)

    def forget(self) -> None:
        """Be a gel that was never touched."""
        nothing = np.zeros_like(self._lag)
        self._lag, self._before, self._step_s = nothing, nothing, 0.0

    def compliance(self, active: Index) -> Array:
        """Displacement of the active nodes for unit forces on them, (3 k, 3 k) m/N.

        What a force does that is there only at the end of the step: a gel that relaxes within a
        step is softer.
        """
        return self.elastic.compliance(active) / self._instant_share()

    def displacement(self, force: Array) -> Array:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N.

        Raises ContactError where the material cannot follow.
        """
        return self.elastic.displacement(self._elastic_force(force))

    def marker_displacement(self, force: Array) -> Array:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m.

        Raises ContactError where the material cannot follow.
        """
        return self.elastic.marker_displacement(self._elastic_force(force))

    def _elastic_force(self, force: Array) -> Array:
        """The forces that would hold the shape at once, (N, 3) N, of those that hold it now."""
        kept, before, _ = self._weights()
        remembered = kept * self._lag + before * self._before
        return (force + self.relaxation.share * remembered) / self._instant_share()

    def _instant_share(self) -> float:
        """What of a force that grew over the step is not relaxed at its end."""
        return 1.0 - self.relaxation.share * self._weights()[2]

    def _weights(self) -> tuple[float, float, float]:
        kept, before, now = step_weights(np.array(self._step_s / self.relaxation.time))
        return float(kept), float(before), float(now)
