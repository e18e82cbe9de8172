"""Cholesky factors of the stiffness of a block of second-order hexahedra.

Columns of nodes are eliminated region by region: small ones first, the seams between them last
(nested dissection, George 1973).  Each region is one dense matrix, its front, that gathers what
earlier ones left behind (multifrontal method, Duff and Reid 1983).  For a block of 18 x 18 x 4
elements this takes a ninth of the time of CHOLMOD (by cholespy) and a tenth of that of scipy's
splu, which know nothing of the block.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import blas, cho_solve, lapack

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.mesh import BlockMesh, element_stiffness
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Regions of so many elements or fewer, along both sides, are not cut any further.
LEAF_ELEMENTS = 2


@dataclass(frozen=True)
class Region:
    """Lattice columns that are eliminated together, once the regions `children` are.

    columns: numbers ix * ny + iy.  children: numbers of earlier regions; what these and the
    columns of a region are coupled to lies in later regions alone.
    """

    columns: Index
    children: tuple[int, ...]


@dataclass(frozen=True)
class Front:
    """One step of the elimination: a dense matrix over the unknowns of a region and its rim.

    unknowns: their numbers; the first `own` are eliminated here, those on the rim later.
    children: pairs of an earlier front and the places of its rim's unknowns in this one.
    elements: pairs of an element and the places of its unknowns in this one, -1 where held.
    """

    unknowns: Index
    own: int
    children: tuple[tuple[int, Index], ...]
    elements: tuple[tuple[int, Index], ...]

    @property
    def eliminated(self) -> Index:
        """Numbers of the unknowns that are eliminated here."""
        return self.unknowns[: self.own]

    @property
    def rim(self) -> Index:
        """Numbers of the later unknowns that they are coupled to."""
        return self.unknowns[self.own :]


# A front, the lower factor (own, own) of its own unknowns and their link (own, rim) to the others.
Step = tuple[Front, Array, Array]


def dissected(elements: tuple[int, int]) -> Sequence[Region]:
    """Regions of the columns of nodes under elements x by elements y second-order hexahedra.

    The seam between two halves is one column of nodes wide, and is what is left of them when
    both are eliminated; each half is cut likewise across its longer side.
    """
    nx, ny = (2 * count + 1 for count in elements)
    unclaimed = np.ones((nx, ny), dtype=bool)
    numbers = np.arange(nx * ny).reshape(nx, ny)
    regions: list[Region] = []

    def claim(x: slice, y: slice) -> Index:
        claimed = numbers[x, y][unclaimed[x, y]]
        unclaimed[x, y] = False
        return claimed

    def cut(x: tuple[int, int], y: tuple[int, int]) -> int:
        """The number of the region of the elements x[0]..x[1] by y[0]..y[1]."""
        whole = [slice(2 * start, 2 * stop + 1) for start, stop in (x, y)]
        widths = x[1] - x[0], y[1] - y[0]
        children: tuple[int, ...] = ()
        if max(widths) <= LEAF_ELEMENTS:
            columns = claim(*whole)
        elif widths[0] >= widths[1]:
            middle = sum(x) // 2
            columns = claim(slice(2 * middle, 2 * middle + 1), whole[1])
            children = cut((x[0], middle), y), cut((middle, x[1]), y)
        else:
            middle = sum(y) // 2
            columns = claim(whole[0], slice(2 * middle, 2 * middle + 1))
            children = cut(x, (y[0], middle)), cut(x, (middle, y[1]))
        regions.append(Region(columns, children))
        return len(regions) - 1

    cut((0, elements[0]), (0, elements[1]))
    return regions


class Dissection:
    """The order of elimination for one mesh, found once for all its matrices.

    lattice: numbers of nodes along x, y and z, node n = (ix * ny + iy) * nz + iz.
    nodes (elements, 27): lattice nodes of each element.
    free (nx, ny, nz, 3): unknowns that are not held; without it all but those with iz = 0.
    Unknown 3 n + c is component c of node n.
    """

    def __init__(
        self,
        lattice: tuple[int, int, int],
        nodes: Index,
        free: NDArray[np.bool_] | None = None,
    ) -> None:
        nx, ny, height = lattice
        self.unknowns = 3 * nx * ny * height
        if free is None:
            free = np.ones((*lattice, 3), dtype=bool)
            free[:, :, 0] = False
        free = free.reshape(nx * ny, 3 * height)
        numbers = np.arange(self.unknowns).reshape(nx * ny, 3 * height)
        regions = dissected((nx // 2, ny // 2))
        of_region = np.empty(nx * ny, dtype=np.intp)
        for number, region in enumerate(regions):
            of_region[region.columns] = number
        columns = nodes // height
        # The column amid an element belongs to no other, so that it shows the element's region.
        home = of_region[(columns.min(axis=1) + columns.max(axis=1)) // 2]
        self.fronts: list[Front] = []
        rims: list[Index] = []
        place = np.full(self.unknowns, -1)
        for number, region in enumerate(regions):
            elements = np.flatnonzero(home == number)
            met = [columns[elements].ravel(), *(rims[child] for child in region.children)]
            rims.append(np.setdiff1d(np.concatenate(met), region.columns))
            order = np.concatenate([region.columns, rims[-1]])
            unknowns = numbers[order][free[order]]
            place[unknowns] = np.arange(len(unknowns))
            self.fronts.append(
                Front(
                    unknowns,
                    int(np.count_nonzero(free[region.columns])),
                    tuple((child, place[self.fronts[child].rim]) for child in region.children),
                    tuple((e, place[_unknowns(nodes[e])]) for e in elements.tolist()),
                )
            )
            place[unknowns] = -1

    def steps(self, stiffness: Array) -> Iterator[Step]:
        """Eliminate the matrix assembled from (elements, 81, 81), front after front.

        What a front leaves on its rim is kept only until its parent has taken it.
        Raises LinAlgError where there is none: the block is unstable in this state.
        """
        rests: dict[int, Array] = {}
        for number, front in enumerate(self.fronts):
            size, own = len(front.unknowns), front.own
            matrix = np.zeros((size, size), order="F")
            for element, places in front.elements:
                _add_lower(matrix, stiffness[element].T, places)
            for child, places in front.children:
                _add_lower(matrix, rests.pop(child), places)
            factor, info = lapack.dpotrf(matrix[:own, :own], lower=1, clean=0)
            if info != 0:
                msg = f"pivot {front.unknowns[info - 1]} is not positive"
                raise np.linalg.LinAlgError(msg)
            link = blas.dtrsm(1.0, factor, matrix[own:, :own].T, lower=1)
            rest = np.asfortranarray(matrix[own:, own:])
            if rest.size > 0:
                rest = blas.dsyrk(-1.0, link, beta=1.0, c=rest, trans=1, lower=1, overwrite_c=1)
            rests[number] = rest
            yield front, factor, link

    def factor(self, stiffness: Array) -> BlockFactor:
        """Factor of the matrix assembled from (elements, 81, 81).

        Raises LinAlgError where there is none: the block is unstable in this state.
        """
        return BlockFactor(self.unknowns, list(self.steps(stiffness)))

    def inverse_product(
        self, stiffness: Array, observers: sparse.sparray, loads: sparse.sparray
    ) -> tuple[Array, Array]:
        """Response of observers (unknowns, o) to loads (unknowns, k), and of the loads themselves.

        `observers`.T @ inverse(matrix) @ `loads` and `loads`.T @ inverse(matrix) @ `loads`, which
        is symmetric.  No factor is kept, which a general solver of many right-hand sides cannot
        do without.
        """
        columns = sparse.hstack([observers, loads], format="csr")
        seen = observers.shape[1]
        # The blocks are too small for more BLAS threads, which on loaded cores wait for another.
        with one_thread():
            product = _products(self.steps(stiffness), columns, seen)
        return product[:seen], product[seen:]


class BlockFactor:
    """Cholesky factor of one matrix; see Dissection.factor."""

    def __init__(self, unknowns: int, steps: Sequence[Step]) -> None:
        self._unknowns, self._steps = unknowns, steps

    def solve(self, load: Array) -> Array:
        """Inverse of the matrix times load (unknowns,); zero where the nodes are held."""
        solution = np.zeros(self._unknowns)
        carried = np.array(load, dtype=np.float64)
        for front, factor, link in self._steps:
            part = blas.dtrsv(factor, carried[front.eliminated], lower=1)
            carried[front.rim] -= part @ link
            solution[front.eliminated] = part
        for front, factor, link in reversed(self._steps):
            part = solution[front.eliminated] - link @ solution[front.rim]
            solution[front.eliminated] = blas.dtrsv(factor, part, lower=1, trans=1)
        return solution

    def compliance(self, loads: sparse.csr_array) -> Array:
        """loads.T times the inverse of the matrix times loads (unknowns, k), symmetric."""
        return _products(self._steps, loads, 0)


def _products(steps: Iterable[Step], columns: sparse.csr_array, first: int) -> Array:
    """columns.T @ inverse(matrix) @ columns[:, first:], of columns (unknowns, k).

    Columns that reach few elements cost little: each meets only the few fronts from where it acts
    to the last one.
    """
    product = np.zeros((columns.shape[1], columns.shape[1] - first))
    carried: dict[int, tuple[Index, Array]] = {}
    for number, (front, factor, link) in enumerate(steps):
        given = columns[front.eliminated]
        left = [(places, *carried.pop(child)) for child, places in front.children]
        met = [given.indices, *(earlier for _, earlier, _ in left)]
        active = np.unique(np.concatenate(met)).astype(np.intp)
        total = np.zeros((len(front.unknowns), len(active)), order="F")
        total[: front.own] = given[:, active].toarray()
        for places, earlier, rest in left:
            total[np.ix_(places, np.searchsorted(active, earlier))] += rest
        part = blas.dtrsm(1.0, factor, total[: front.own], lower=1)
        begin = int(np.searchsorted(active, first))
        product[np.ix_(active, active[begin:] - first)] += part.T @ part[:, begin:]
        rest = total[front.own :]
        # In place: these are the largest arrays of all.
        rest -= link.T @ part
        carried[number] = active, rest
    return product


class RestInverse:
    """Inverse of a whole block's stiffness at rest, for E = 1 Pa, in single precision.

    The block's four parities are eliminated one by one on its quarter.  Every front keeps the
    inverse of its own matrix and its link to later ones, so that a solution is a row of dense
    products, as quick as memory gives them.  `use` the numbers of `build` before solving.
    """

    def __init__(self, quarter: BlockMesh) -> None:
        self._quarter = quarter
        lattice, nodes = quarter.lattice, quarter.element_nodes()
        self._dissections = [Dissection(lattice, nodes, p.free(lattice)) for p in PARITIES]
        whole = quarter.mirrored().lattice
        parts, steps, rims, first = [], [], [], 0
        for parity, dissection in zip(PARITIES, self._dissections, strict=True):
            order = np.concatenate([front.eliminated for front in dissection.fronts])
            place = np.empty(dissection.unknowns, dtype=np.intp)
            place[order] = first + np.arange(len(order))
            for front in dissection.fronts:
                steps.append((place[front.unknowns[0]], front.own, len(front.rim)))
                rims.append(place[front.rim])
            # From nodal values of the whole block to the sums that this parity sees.
            parts.append(parity.lattice_extension(whole).T.tocsr()[order])
            first += len(order)
        self._parts = sparse.vstack(parts, format="csr")
        self._back = self._parts.T.tocsr()
        self._steps, self._rims = np.array(steps, dtype=np.intp), np.concatenate(rims)
        self._room = np.zeros(self._steps[:, 1:].sum(axis=1).max(), dtype=np.float32)

    @property
    def size(self) -> int:
        """How many numbers `build` gives."""
        return int((self._steps[:, 1] * self._steps[:, 1:].sum(axis=1)).sum())

    def build(self, poisson: float, layer_ratio: float) -> Array:
        """All fronts' numbers, one front after the other, (size,)."""
        local = 4 * element_stiffness(self._quarter, poisson, layer_young=layer_ratio)
        kept: list[Array] = []
        with one_thread():
            for dissection in self._dissections:
                for front, factor, link in dissection.steps(local):
                    kept.append(cho_solve((factor, True), np.eye(front.own)).ravel())
                    kept.append(blas.dtrsm(1.0, factor, link, lower=1, trans_a=1).ravel())
        return np.concatenate(kept)

    def use(self, numbers: Array) -> None:
        """Solve with these numbers from now on."""
        self._numbers = numbers.astype(np.float32)

    def solve(self, load: Array) -> Array:
        """Displacement (nodes, 3) of a body of E = 1 Pa under a load (nodes, 3), to 1e-5 or so."""
        solution = (self._parts @ load.ravel()).astype(np.float32)
        _solve_at_rest(self._numbers, self._steps, self._rims, self._room, solution)
        moved = self._back @ solution.astype(np.float64)
        return np.asarray(moved.reshape(load.shape))


def _unknowns(nodes: Index) -> Index:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


@kernel
def _add_lower(total: NDArray[np.float64], part: NDArray[np.float64], places: Index) -> None:
    """Add the lower triangle of a symmetric part at the given places to that of the total."""
    for col in range(len(places)):
        if places[col] < 0:
            continue
        for row in range(col, len(places)):
            if places[row] >= 0:
                low = max(places[row], places[col])
                total[low, min(places[row], places[col])] += part[row, col]


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _solve_at_rest(  # noqa: C901 - two sweeps of plain loops
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
