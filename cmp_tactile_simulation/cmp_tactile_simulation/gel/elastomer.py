"""What the contact solver and the renderer need to know of an elastomer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid

__all__ = ["Elastomer"]


class Elastomer(Protocol):
    """A gel bonded at its base, loaded by forces on the nodes of its contact surface.

    The nodes are a regular grid in x and y on the undeformed contact surface; node (i, j) is
    number i * cols + j, N = rows * cols.  A nodal force is spread as a bilinear hat over the
    neighbouring nodes' area, and the displacement of a node is the mean over the same hat, so
    that force times displacement is work.  Forces act on the gel, gel frame, N.
    """

    @property
    def nodes(self) -> SurfaceGrid:
        """The grid of contact nodes."""

    @property
    def observers(self) -> SurfaceGrid:
        """The grid on which the marker surface is observed; spans the whole top of the block."""

    @property
    def node_position(self) -> NDArray[np.float64]:
        """Contact nodes at rest, (N, 3) m, gel frame: on the contact surface, above the skin."""

    @property
    def node_area(self) -> NDArray[np.float64]:
        """Undeformed area that belongs to each node, (N,) m^2."""

    @property
    def on_rim(self) -> NDArray[np.bool_]:
        """Nodes on the patch's outer ring, (N,): contact there may go on outside the patch."""

    @property
    def beyond(self) -> NDArray[np.float64]:
        """Points of the contact surface at rest outside the patch, (M, 3) m, gel frame.

        Nothing may touch there.
        """

    @property
    def memory(self) -> dict[str, NDArray[np.float64]]:
        """All of the past that the next displacement depends on; empty where on none."""

    def recall(self, memory: Mapping[str, NDArray[np.float64]]) -> None:
        """Go on as from where `memory` was taken, to the last digits."""

    @property
    def creeps(self) -> bool:
        """Whether its shape depends on how long its forces have been there, see `advance`."""

    def advance(self, force: NDArray[np.float64], seconds: float) -> None:
        """Let time go on by `seconds`, from the state under `force` (N, 3) N; see `creeps`."""

    def forget(self) -> None:
        """Be a gel that was never touched, where it creeps."""

    def compliance(self, active: NDArray[np.intp]) -> NDArray[np.float64]:
        """Displacement of the active nodes for unit forces on them, (3 k, 3 k) m/N.

        Symmetric and positive definite; row and column 3 a + c is component c of active[a].
        For a non-linear material it is that of the gel at rest or of the latest state: the contact
        solver corrects with `displacement` what is left.
        """

    def displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N.

        Raises MaterialError where the material cannot follow.
        """

    def marker_displacement(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m.

        Raises MaterialError where the material cannot follow.
        """
