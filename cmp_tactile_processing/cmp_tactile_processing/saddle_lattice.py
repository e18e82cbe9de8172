"""Gridline detector: saddle points of the image, joined to a lattice by the edges between them."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.corner_evidence import edge_evidence, ring_evidence
from cmp_tactile_processing.corner_graph import CornerGraph
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.prepared_image import PreparedImage
from cmp_tactile_processing.saddle_response import SaddleResponse

__all__ = ["SaddleLattice"]

# Room for candidates: this many for each corner of the pattern, and some for a bare image.
CANDIDATES_PER_CORNER, SPARE_CANDIDATES = 4, 400
# A saddle's least amplitude: share of the image's contrast (light may differ across the view), and
# standard deviations of the noise in the smoothed image.
LEAST_CONTRAST, LEAST_DEVIATIONS = 0.04, 5.0
# Least share of a ring's variance that is a corner's.  Sharp corners show 0.81, a corner of the
# housing or of the outermost checkers 0.3 to 0.5.
LEAST_QUALITY = 0.5
# A neighbour lies this near to where the nominal step leads, in steps.
REACH = 0.45
# An edge differs in grey by at least these shares of the amplitude of its corners.
LEAST_EDGE, WEAKEST_EDGE = 0.5, 0.0
# A corner whose neighbour is so much stronger lies on the outermost checkers' rim, where a grey
# margin takes the place of two of its four checkers.
LEAST_OF_NEIGHBOUR = 0.55
# Nominal steps are looked up on a lattice of this many px.
LOOKUP_PX = 8


class SaddleLattice:
    """Detector after section III's gridlines, found from their crossings instead of outlines.

    nominal: nominal grid in pixels of the prepared image; shape: that image's (height, width).
    """

    def __init__(self, nominal: NominalGrid, shape: tuple[int, int]) -> None:
        corners = nominal.corners[..., 0].size
        capacity = CANDIDATES_PER_CORNER * corners + SPARE_CANDIDATES
        self._response = SaddleResponse(shape, nominal.side_px, capacity)
        self._nearest = _nearest_corners(nominal, shape)
        self._row_step = nominal.row_step.reshape(-1, 2)
        self._col_step = nominal.col_step.reshape(-1, 2)
        self._buckets = _Buckets(shape, max(nominal.side_px, 4.0), capacity)

    def corner_graph(self, image: PreparedImage) -> CornerGraph:
        """Corners to half a pixel and their pointers; every corner is an inner one."""
        noise = image.noise / (2.0 * np.sqrt(np.pi) * max(image.smoothing_px, 0.5))
        threshold = max(LEAST_CONTRAST * image.contrast, LEAST_DEVIATIONS * noise, 0.5)
        position = self._response.candidates(image.smooth, threshold)[:, :2]
        cell = (position / LOOKUP_PX).astype(np.intp)
        nearest = self._nearest[cell[:, 1], cell[:, 0]]
        row_step, col_step = self._row_step[nearest], self._col_step[nearest]
        evidence = ring_evidence(image.smooth, position, row_step, col_step)
        good = (evidence[:, 1] > LEAST_QUALITY) & (np.abs(evidence[:, 0]) > threshold)
        position, evidence = position[good], evidence[good]
        row_step, col_step = _turned(row_step[good], col_step[good], evidence[:, 2])
        neighbour = self._buckets.linked(position, evidence[:, 0] > 0, row_step, col_step)
        _drop_without_edge(image.smooth, position, evidence[:, 0], neighbour, row_step, col_step)
        _drop_weak(np.abs(evidence[:, 0]), neighbour)
        return _connected(position, evidence[:, 0] > 0, neighbour)


def _nearest_corners(nominal: NominalGrid, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Index of the nominal corner nearest to the middle of each cell of LOOKUP_PX."""
    rows, cols = (-(-side // LOOKUP_PX) for side in shape)
    y, x = np.mgrid[:rows, :cols] * LOOKUP_PX + (LOOKUP_PX - 1) / 2
    nearest = nominal.tree.query(np.stack([x, y], axis=-1).reshape(-1, 2))[1]
    return np.asarray(nearest.reshape(rows, cols), dtype=np.intp)


def _turned(
    row_step: NDArray[np.float64], col_step: NDArray[np.float64], turn: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return cosine * row_step + sine * col_step, cosine * col_step - sine * row_step


def _drop_without_edge(  # noqa: PLR0913, PLR0917 - one array for each property of the corners
    smooth: NDArray[np.float32],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    neighbour: NDArray[np.intp],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
) -> None:
    """Remove pointers, in place, along which the image shows no edge of the right sign."""
    for towards, across in ((2, col_step), (1, row_step)):
        here = np.flatnonzero(neighbour[:, towards] >= 0)
        there = neighbour[here, towards]
        sides = (across[here] + across[there]) / 2
        edge = edge_evidence(smooth, position[here], position[there], sides)
        # Beyond an even corner the checker at (+, +) is dark.
        step = -np.sign(amplitude[here])[:, None] * edge
        expected = (np.abs(amplitude[here]) + np.abs(amplitude[there])) / 2
        absent = ~((step[:, 1] > LEAST_EDGE * expected) & (step[:, 0] > WEAKEST_EDGE * expected))
        neighbour[here[absent], towards] = -1
        neighbour[there[absent], (towards + 2) % 4] = -1


def _drop_weak(strength: NDArray[np.float64], neighbour: NDArray[np.intp]) -> None:
    """Remove the pointers, in place, of corners that are much weaker than a neighbour."""
    around = np.where(neighbour >= 0, strength[neighbour], 0.0).max(axis=1, initial=0.0)
    weak = strength < LEAST_OF_NEIGHBOUR * around
    neighbour[weak] = -1
    neighbour[weak[neighbour] & (neighbour >= 0)] = -1


def _connected(
    position: NDArray[np.float64], even: NDArray[np.bool_], neighbour: NDArray[np.intp]
) -> CornerGraph:
    """The graph of the corners that have a pointer."""
    kept = np.flatnonzero((neighbour >= 0).any(axis=1))
    index = np.full(len(position) + 1, -1, dtype=np.intp)
    index[kept] = np.arange(len(kept))
    return CornerGraph(
        position[kept], np.ones(len(kept), dtype=bool), even[kept], index[neighbour[kept]]
    )


class _Buckets:
    """Finds neighbours among points in an image; the work is linear in their number."""

    def __init__(self, shape: tuple[int, int], cell_px: float, capacity: int) -> None:
        self._cell = cell_px
        rows, cols = (int(side / cell_px) + 1 for side in shape)
        self._first = np.empty((rows, cols), dtype=np.intp)
        self._next = np.empty(capacity, dtype=np.intp)

    def linked(
        self,
        position: NDArray[np.float64],
        even: NDArray[np.bool_],
        row_step: NDArray[np.float64],
        col_step: NDArray[np.float64],
    ) -> NDArray[np.intp]:
        """Mutual pointers (n, 4) to neighbours of the other parity, in the order of STEPS."""
        pointer = np.full((len(position), 4), -1, dtype=np.intp)
        _fill(position, self._cell, self._first, self._next)
        _point(position, even, row_step, col_step, self._cell, self._first, self._next, pointer)
        _keep_mutual(pointer)
        return pointer


@njit(cache=True, nogil=True)
def _fill(
    position: NDArray[np.float64],
    cell: float,
    first: NDArray[np.intp],
    following: NDArray[np.intp],
) -> None:
    first[:] = -1
    for n in range(len(position)):
        row, col = int(position[n, 1] / cell), int(position[n, 0] / cell)
        following[n] = first[row, col]
        first[row, col] = n


@njit(cache=True, nogil=True)
def _point(  # noqa: PLR0913, PLR0917 - arrays of one structure
    position: NDArray[np.float64],
    even: NDArray[np.bool_],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    cell: float,
    first: NDArray[np.intp],
    following: NDArray[np.intp],
    pointer: NDArray[np.intp],
) -> None:
    """Point each corner to the nearest of the other parity around each of its four next places."""
    rows, cols = first.shape
    for n in range(len(position)):
        for towards in range(4):
            step = row_step[n] if towards % 2 == 0 else col_step[n]
            sign = -1.0 if towards in {0, 3} else 1.0
            x, y = position[n, 0] + sign * step[0], position[n, 1] + sign * step[1]
            reach = REACH * np.sqrt(step[0] ** 2 + step[1] ** 2)
            nearest = reach * reach
            top, bottom = max(int((y - reach) / cell), 0), min(int((y + reach) / cell), rows - 1)
            left, right = max(int((x - reach) / cell), 0), min(int((x + reach) / cell), cols - 1)
            for row in range(top, bottom + 1):
                for col in range(left, right + 1):
                    other = first[row, col]
                    while other >= 0:
                        gap = (position[other, 0] - x) ** 2 + (position[other, 1] - y) ** 2
                        if gap < nearest and even[other] != even[n]:
                            nearest = gap
                            pointer[n, towards] = other
                        other = following[other]


@njit(cache=True, nogil=True)
def _keep_mutual(pointer: NDArray[np.intp]) -> None:
    for n in range(len(pointer)):
        for towards in range(4):
            other = pointer[n, towards]
            if other >= 0 and pointer[other, (towards + 2) % 4] != n:
                pointer[n, towards] = -1
