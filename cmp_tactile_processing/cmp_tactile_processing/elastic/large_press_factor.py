"""The inverse of a gel block's stiffness at rest, held in single precision for quick use.

The block's four parities (mirror_symmetry) are eliminated one by one on a quarter of the mesh, in
the order of nested dissection with dense blocks. Every block of unknowns keeps the inverse of its
own matrix and its link to later ones, so that a solution is a row of dense products, as quick as
memory gives them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.elastic.elastomer_mesh import BlockMesh
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, Parity
from cmp_tactile_processing.elastic.nested_dissection import Region, dissected
from cmp_tactile_processing.elastic.stiffness import stiffness

__all__ = ["Elimination", "Front", "ParityFactor"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Front:
    """Unknowns from `start` to `stop` and the later ones on their `rim` (k,), ascending."""

    start: int
    stop: int
    rim: Index

    @property
    def own(self) -> int:
        """Number of unknowns that are eliminated here."""
        return self.stop - self.start

    @property
    def size(self) -> int:
        """Numbers that are kept of it: the inverse of its own block, and the link to the rim."""
        return self.own * (self.own + len(self.rim))


@dataclass(frozen=True)
class Elimination:
    """In which order the unknowns of a quarter block are eliminated, one parity after another.

    quarter: the mesh.
    """

    quarter: BlockMesh

    @cached_property
    def orders(self) -> list[Index]:
        """Per parity the free unknowns 3 n + c of the quarter's nodes n, in their order."""
        nx, ny, nz = self.quarter.lattice
        numbers = np.arange(3 * nx * ny * nz).reshape(nx * ny, 3 * nz)
        columns = np.concatenate([region.columns for region in self._regions])
        return [numbers[columns][self._free(parity)[columns]] for parity in PARITIES]

    @cached_property
    def fronts(self) -> list[list[Front]]:
        """Per parity the steps of the elimination; unknowns count from 0 in each parity."""
        columns = np.concatenate([region.columns for region in self._regions])
        place = np.empty(len(columns), dtype=np.intp)
        place[columns] = np.arange(len(columns))
        found = []
        for parity in PARITIES:
            ends = np.concatenate([[0], self._free(parity)[columns].sum(axis=1).cumsum()])
            fronts, done = [], 0
            for region, rim in zip(self._regions, self._rims, strict=True):
                later = np.sort(place[rim])
                unknowns = [np.arange(ends[at], ends[at + 1]) for at in later]
                stop = done + len(region.columns)
                known = np.concatenate([np.zeros(0, dtype=np.intp), *unknowns])
                fronts.append(Front(int(ends[done]), int(ends[stop]), known))
                done = stop
            found.append(fronts)
        return found

    @cached_property
    def size(self) -> int:
        """Numbers that a factor keeps."""
        return sum(front.size for fronts in self.fronts for front in fronts)

    @cached_property
    def parts(self) -> sparse.csr_array:
        """Matrix from nodal values of the whole block to the sums that each parity sees.

        (unknowns of all parities, 3 nodes); its transpose takes solutions back.
        """
        nx, ny, nz = self.quarter.lattice
        lattice = 2 * nx - 1, 2 * ny - 1, nz, 3
        whole = np.arange(np.prod(lattice)).reshape(lattice)
        rows = []
        for parity, order in zip(PARITIES, self.orders, strict=True):
            ix, iy, iz, component = np.unravel_index(order, (nx, ny, nz, 3))
            signs_x = np.array([parity.sign_x(c) for c in range(3)])[component]
            signs_y = np.array([parity.sign_y(c) for c in range(3)])[component]
            index, values = [], []
            for x_way, y_way in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
                at = whole[nx - 1 + x_way * ix, ny - 1 + y_way * iy, iz, component]
                twice = ((x_way < 0) & (ix == 0)) | ((y_way < 0) & (iy == 0))
                sign = (signs_x if x_way < 0 else 1) * (signs_y if y_way < 0 else 1)
                index.append(at)
                values.append(np.where(twice, 0.0, sign * np.ones(len(at))))
            row = np.broadcast_to(np.arange(len(order)), (4, len(order)))
            entries = np.concatenate(values), (row.ravel(), np.concatenate(index))
            rows.append(sparse.coo_array(entries, shape=(len(order), whole.size)))
        parts = sparse.vstack(rows, format="csr")
        parts.eliminate_zeros()
        return parts

    def factor(self, poisson: float, layer_ratio: float) -> Array:
        """All fronts' numbers, for a body of E = 1 Pa, one after the other, (size,)."""
        matrix = 4 * stiffness(self.quarter, poisson, layer_young=layer_ratio)
        kept: list[Array] = []
        with one_blas_thread():
            for order, fronts in zip(self.orders, self.fronts, strict=True):
                kept += _eliminated(matrix[order][:, order], fronts, self._regions)
        return np.concatenate(kept)

    @cached_property
    def _regions(self) -> Sequence[Region]:
        return dissected(self.quarter.elements[:2])

    @cached_property
    def _rims(self) -> list[Index]:
        """Columns of later regions that each region and its children are coupled to."""
        nx, ny, _ = self.quarter.lattice
        region_of = np.empty(nx * ny, dtype=np.intp)
        for number, region in enumerate(self._regions):
            region_of[region.columns] = number
        numbers = np.arange(nx * ny).reshape(nx, ny)
        cells = np.lib.stride_tricks.sliding_window_view(numbers, (3, 3))[::2, ::2].reshape(-1, 9)
        rims: list[Index] = []
        for number, region in enumerate(self._regions):
            # The column amid an element belongs to no other: it tells the element's region.
            met = [cells[region_of[cells[:, 4]] == number].ravel()]
            met += [rims[child] for child in region.children]
            rims.append(np.setdiff1d(np.concatenate(met), region.columns))
        return rims

    def _free(self, parity: Parity) -> NDArray[np.bool_]:
        """What is not held, by the base or by the parity, (columns, 3 levels)."""
        nx, ny, nz = self.quarter.lattice
        free = np.ones((nx, ny, nz, 3), dtype=bool)
        free[:, :, 0] = False
        for component in range(3):
            free[0, :, :, component] &= parity.sign_x(component) > 0
            free[:, 0, :, component] &= parity.sign_y(component) > 0
        return free.reshape(nx * ny, 3 * nz)


class ParityFactor:
    """Solves with the stiffness at rest of a whole block.

    numbers: from Elimination.factor.
    """

    def __init__(self, elimination: Elimination, numbers: Array) -> None:
        self._elimination = elimination
        self._parts = elimination.parts
        self._back = self._parts.T.tocsr()
        self._numbers = numbers.astype(np.float32)
        steps, rims, first = [], [], 0
        for fronts, order in zip(elimination.fronts, elimination.orders, strict=True):
            for front in fronts:
                steps.append((front.start + first, front.own, len(front.rim)))
                rims.append(front.rim + first)
            first += len(order)
        self._steps = np.array(steps, dtype=np.intp)
        self._rims = np.concatenate(rims)
        self._room = np.zeros(max(own + rim for _, own, rim in steps), dtype=np.float32)

    def solve(self, load: Array) -> Array:
        """Displacement (nodes, 3) of a body of E = 1 Pa under a load (nodes, 3), to 1e-5 or so."""
        solution = (self._parts @ load.ravel()).astype(np.float32)
        _solve(self._numbers, self._steps, self._rims, self._room, solution)
        moved = self._back @ solution.astype(np.float64)
        return np.asarray(moved.reshape(load.shape))


def _eliminated(
    matrix: sparse.csr_array, fronts: Sequence[Front], regions: Sequence[Region]
) -> list[Array]:
    """Inverse and link of every front, each flat."""
    kept: list[Array] = []
    rests: dict[int, Array] = {}
    for number, front in enumerate(fronts):
        own = front.own
        unknowns = np.concatenate([np.arange(front.start, front.stop), front.rim])
        dense = np.zeros((len(unknowns), len(unknowns)))
        rows = matrix[front.start : front.stop]
        later = rows.indices >= front.start
        row = np.repeat(np.arange(own), np.diff(rows.indptr))[later]
        dense[row, np.searchsorted(unknowns, rows.indices[later])] = rows.data[later]
        for child in regions[number].children:
            at = np.searchsorted(unknowns, fronts[child].rim)
            dense[np.ix_(at, at)] += rests.pop(child)
        factor = cho_factor(dense[:own, :own], lower=False)
        link = cho_solve(factor, dense[:own, own:])
        rests[number] = dense[own:, own:] - dense[:own, own:].T @ link
        kept += [cho_solve(factor, np.eye(own)).ravel(), link.ravel()]
    return kept


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _solve(  # noqa: C901 - two sweeps of plain loops
    numbers: NDArray[np.float32],
    steps: Index,
    rims: Index,
    room: NDArray[np.float32],
    x: NDArray[np.float32],
) -> None:
    """Turn the load x of all parities' unknowns into their displacement."""
    at, at_rim = 0, 0
    for f in range(len(steps)):
        start, own, rim = steps[f]
        at += own * own
        room[:rim] = 0
        for row in range(own):
            value = x[start + row]
            link = numbers[at : at + rim]
            for k in range(rim):
                room[k] += value * link[k]
            at += rim
        for k in range(rim):
            x[rims[at_rim + k]] -= room[k]
        at_rim += rim
    for f in range(len(steps) - 1, -1, -1):
        start, own, rim = steps[f]
        at -= own * (own + rim)
        at_rim -= rim
        for k in range(rim):
            room[k] = x[rims[at_rim + k]]
        for row in range(own):
            room[rim + row] = x[start + row]
        for row in range(own):
            inverse = numbers[at + own * row : at + own * (row + 1)]
            link = numbers[at + own * own + rim * row : at + own * own + rim * (row + 1)]
            total = np.float32(0.0)
            for k in range(own):
                total += inverse[k] * room[rim + k]
            for k in range(rim):
                total -= link[k] * room[k]
            x[start + row] = total
