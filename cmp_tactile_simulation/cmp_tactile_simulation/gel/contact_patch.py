"""Where the gel can be touched and where its marker surface is observed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import SimulationError

__all__ = ["NODES_RANGE", "contact_nodes", "observers", "on_rim"]

# How far the patch reaches beyond the outer checkers of the pattern, m.
PATCH_MARGIN = 1e-3

# Fewer nodes do not make a contact; more ask for gigabytes of memory and minutes to build.
NODES_RANGE = (5, 64)
LEAST_ALONG_SHORTER = 4

# Distance of the observers, m, unless the block is so wide that there would be too many.
OBSERVER_SPACING, MAX_OBSERVERS = 0.4e-3, 64


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
            f"{sensor.name}: contact nodes: found {nodes} along the longer side, which are "
            f"{min(rows, cols)} along the shorter, expected at least {LEAST_ALONG_SHORTER} there"
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
