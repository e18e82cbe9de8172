"""Where the gel is loaded and observed: contact nodes, observers, and the mesh that fits both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.mesh import BlockGeometry, BlockMesh, MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import SimulationError

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
    Raises SimulationError for a number of nodes out of range.
    """
    least, most = NODES_RANGE
    if not least <= nodes <= most:
        msg = f"{sensor.name}: contact nodes: found {nodes}, expected {least} to {most}"
        raise SimulationError(msg)
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
        raise SimulationError(msg)
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

        Raises GeometryError where its block cannot be meshed, SimulationError for a number of
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
