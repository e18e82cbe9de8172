"""The elastic problem of a gel in contact: a mesh that is as fine as the contact nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cmp_tactile_processing.elastic.elastomer_mesh import BlockGeometry, BlockMesh, MeshDensity
from cmp_tactile_processing.elastic.problem import ElasticProblem
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.gel.contact_patch import contact_nodes, observers

__all__ = ["ContactProblem"]

# To be raised with every change that alters the compliance of the same sensor.
CONTACT_VERSION = 1
# The uppermost elements of the body are at most this many times as high as wide, as those of a
# body of 6 mm under 40 nodes are.
TALLEST = 2.2


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
