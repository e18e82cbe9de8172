"""Gridline detector: saddle points of the image, joined to a lattice by the edges between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.corners.evidence import edge_evidence, ring_evidence
from cmp_tactile_processing.tracking.detector import CornerGraph, NominalGrid

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
# An edge differs in grey by at least this share of the amplitude of its corners.
LEAST_EDGE = 0.5
# A corner whose neighbour is so much stronger lies on the outermost checkers' rim, where a grey
# margin takes the place of two of its four checkers.
LEAST_OF_NEIGHBOUR = 0.55
# Nominal steps are looked up on a lattice of this many px.
LOOKUP_PX = 8

# Radius of the ring in sides of a checker: inside the four checkers, clear of their far corners.
RING_RADIUS = 0.3
# A candidate is the strongest response within this many sides.
SUPPRESSION_RADIUS = 0.28
# Share of the odd part (what differs on opposite sides, as at an edge) that is taken off.
ODD_WEIGHT = 1.0


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
        noise = image.smooth_noise
        threshold = max(LEAST_CONTRAST * image.contrast, LEAST_DEVIATIONS * noise, 0.5)
        position = self._response.candidates(image.smooth, threshold)
        row_step, col_step = np.empty_like(position), np.empty_like(position)
        _look_up(position, self._nearest, (self._row_step, self._col_step), (row_step, col_step))
        evidence = ring_evidence(image.smooth, position, row_step, col_step)
        count = _keep_corners(position, row_step, col_step, evidence, threshold)
        position, evidence = position[:count], evidence[:count]
        row_step, col_step = row_step[:count], col_step[:count]
        _turn(row_step, col_step, evidence)
        amplitude = evidence[:, 0].copy()
        even = amplitude > 0
        neighbour = self._buckets.linked(position, even, row_step, col_step)
        _drop_without_edge(image.smooth, position, amplitude, neighbour, (row_step, col_step))
        _drop_weak(amplitude, neighbour)
        return _connected(position, even, neighbour)


def _nearest_corners(nominal: NominalGrid, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Index of the nominal corner nearest to the middle of each cell of LOOKUP_PX."""
    rows, cols = (-(-side // LOOKUP_PX) for side in shape)
    y, x = np.mgrid[:rows, :cols] * LOOKUP_PX + (LOOKUP_PX - 1) / 2
    nearest = nominal.tree.query(np.stack([x, y], axis=-1).reshape(-1, 2))[1]
    return np.asarray(nearest.reshape(rows, cols), dtype=np.intp)


@kernel
def _look_up(
    position: NDArray[np.float64],
    nearest: NDArray[np.intp],
    nominal: tuple[NDArray[np.float64], NDArray[np.float64]],
    steps: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Nominal steps along i and along j, (n, 2) px each, at positions (n, 2) px."""
    for n in range(len(position)):
        index = nearest[int(position[n, 1]) // LOOKUP_PX, int(position[n, 0]) // LOOKUP_PX]
        for d in range(2):
            steps[0][n, d], steps[1][n, d] = nominal[0][index, d], nominal[1][index, d]


@kernel
def _keep_corners(
    position: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    evidence: NDArray[np.float64],
    threshold: float,
) -> int:
    """Move the rows of what rings show to be corners to the front; returns how many these are."""
    count = 0
    for n in range(len(position)):
        if evidence[n, 1] > LEAST_QUALITY and abs(evidence[n, 0]) > threshold:
            for array in (position, row_step, col_step):
                array[count, 0], array[count, 1] = array[n, 0], array[n, 1]
            for field in range(evidence.shape[1]):
                evidence[count, field] = evidence[n, field]
            count += 1
    return count


@kernel
def _turn(
    row_step: NDArray[np.float64], col_step: NDArray[np.float64], evidence: NDArray[np.float64]
) -> None:
    """Turn the steps in place by the turn that the rings show."""
    for n in range(len(row_step)):
        cosine, sine = np.cos(evidence[n, 2]), np.sin(evidence[n, 2])
        for d in range(2):
            along_i, along_j = row_step[n, d], col_step[n, d]
            row_step[n, d] = cosine * along_i + sine * along_j
            col_step[n, d] = cosine * along_j - sine * along_i


def _drop_without_edge(
    smooth: NDArray[np.float32],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    neighbour: NDArray[np.intp],
    steps: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Remove pointers, in place, along which the image shows no edge of the right sign."""
    ends = np.empty((3, 2 * len(position), 2))
    start, end, across = ends[:, : _set_edges(position, neighbour, *steps, ends)]
    edges = edge_evidence(smooth, start, end, across)
    _drop_absent(edges, amplitude, neighbour)


@kernel
def _set_edges(
    position: NDArray[np.float64],
    neighbour: NDArray[np.intp],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    ends: NDArray[np.float64],
) -> int:
    """Start, end and the step across, (3, m, 2), of the pointers along i, then of those along j."""
    count = 0
    for towards, step in ((2, col_step), (1, row_step)):
        for here in range(len(position)):
            there = neighbour[here, towards]
            if there < 0:
                continue
            for d in range(2):
                ends[0, count, d], ends[1, count, d] = position[here, d], position[there, d]
                ends[2, count, d] = (step[here, d] + step[there, d]) / 2
            count += 1
    return count


@kernel
def _drop_absent(
    edges: NDArray[np.float64], amplitude: NDArray[np.float64], neighbour: NDArray[np.intp]
) -> None:
    """Remove the pointers whose edge, in the order of `_set_edges`, is none."""
    count = 0
    for towards in (2, 1):
        for here in range(len(neighbour)):
            there = neighbour[here, towards]
            if there < 0:
                continue
            # Beyond an even corner the checker at (+, +) is dark.
            sign = -1.0 if amplitude[here] > 0 else 1.0
            least = LEAST_EDGE * (abs(amplitude[here]) + abs(amplitude[there])) / 2
            weakest, mean = sign * edges[count, 0], sign * edges[count, 1]
            count += 1
            if not (mean > least and weakest > 0.0):
                neighbour[here, towards] = -1
                neighbour[there, (towards + 2) % 4] = -1


@kernel
def _drop_weak(amplitude: NDArray[np.float64], neighbour: NDArray[np.intp]) -> None:
    """Remove the pointers, in place, of corners that are much weaker than a neighbour."""
    weak = np.empty(len(amplitude), dtype=np.bool_)
    for here in range(len(neighbour)):
        strongest = 0.0
        for there in neighbour[here]:
            if there >= 0:
                strongest = max(strongest, abs(amplitude[there]))
        weak[here] = abs(amplitude[here]) < LEAST_OF_NEIGHBOUR * strongest
    for here in range(len(neighbour)):
        for towards in range(4):
            there = neighbour[here, towards]
            if there >= 0 and (weak[here] or weak[there]):
                neighbour[here, towards] = -1


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
        self._per_cell = 1.0 / cell_px
        rows, cols = (int(side / cell_px) + 2 for side in shape)
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
        _fill(position, self._per_cell, self._first, self._next)
        _point(position, even, row_step, col_step, self._per_cell, self._first, self._next, pointer)
        _keep_mutual(pointer)
        return pointer


@kernel
def _fill(
    position: NDArray[np.float64],
    per_cell: float,
    first: NDArray[np.intp],
    following: NDArray[np.intp],
) -> None:
    first[:] = -1
    for n in range(len(position)):
        row, col = int(position[n, 1] * per_cell), int(position[n, 0] * per_cell)
        following[n] = first[row, col]
        first[row, col] = n


@kernel
def _point(  # noqa: PLR0913, PLR0917 - arrays of one structure
    position: NDArray[np.float64],
    even: NDArray[np.bool_],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    per_cell: float,
    first: NDArray[np.intp],
    following: NDArray[np.intp],
    pointer: NDArray[np.intp],
) -> None:
    """Point each corner to the nearest of the other parity around each of its four next places."""
    rows, cols = first.shape
    for n in range(len(position)):
        for towards in range(4):
            step = row_step[n] if towards % 2 == 0 else col_step[n]
            sign = -1.0 if towards % 3 == 0 else 1.0
            x, y = position[n, 0] + sign * step[0], position[n, 1] + sign * step[1]
            reach = REACH * np.sqrt(step[0] ** 2 + step[1] ** 2)
            nearest = reach * reach
            top, left = max(int((y - reach) * per_cell), 0), max(int((x - reach) * per_cell), 0)
            bottom = min(int((y + reach) * per_cell), rows - 1)
            right = min(int((x + reach) * per_cell), cols - 1)
            for row in range(top, bottom + 1):
                for col in range(left, right + 1):
                    other = first[row, col]
                    while other >= 0:
                        gap = (position[other, 0] - x) ** 2 + (position[other, 1] - y) ** 2
                        if gap < nearest and even[other] != even[n]:
                            nearest = gap
                            pointer[n, towards] = other
                        other = following[other]


@kernel
def _keep_mutual(pointer: NDArray[np.intp]) -> None:
    for n in range(len(pointer)):
        for towards in range(4):
            other = pointer[n, towards]
            if other >= 0 and pointer[other, (towards + 2) % 4] != n:
                pointer[n, towards] = -1


# Where in an image four checkers meet: the second circular harmonic around each pixel.


class SaddleResponse:
    """Candidates for corners in images of one size; buffers are kept from image to image.

    shape: (height, width) px; side_px: side of a checker; capacity: most candidates returned.
    """

    def __init__(self, shape: tuple[int, int], side_px: float, capacity: int) -> None:
        self._radius = max(round(RING_RADIUS * side_px), 1)
        self._reach = max(round(SUPPRESSION_RADIUS * side_px), 1)
        self._response = np.zeros(shape, dtype=np.float32)
        self._highest = np.empty((2, shape[1]), dtype=np.float32)
        self._found = np.empty((capacity, 2))

    def candidates(self, smooth: NDArray[np.float32], threshold: float) -> NDArray[np.float64]:
        """Local maxima of the response, (n, 2) px.

        smooth: (H, W) smoothed image.  threshold: least amplitude, grey levels.  The strongest
        `capacity` ones where there are more.
        """
        least = np.float32(8.0 * threshold * threshold)
        _respond(smooth, self._radius, self._response)
        while True:
            count = _local_maxima(self._response, self._reach, least, self._found, self._highest)
            if count <= len(self._found):
                break
            least *= np.float32(2.0)
        return np.array(self._found[:count])


@kernel(fastmath=True)
def _respond(smooth: NDArray[np.float32], radius: int, response: NDArray[np.float32]) -> None:
    """Even second harmonic of the ring's eight samples, less its odd part; 8 a^2 for a corner
    whose dark and light quadrants differ by a + a."""
    height, width = smooth.shape
    r, d = radius, max(round(radius * 0.7071), 1)
    count = width - 2 * r
    odd_weight = np.float32(ODD_WEIGHT)
    for y in range(r, height - r):
        # Slices that start at the first sample: indices from 0 let the loop be vectorised.
        north, south = smooth[y - r, r : r + count], smooth[y + r, r : r + count]
        west, east = smooth[y, :count], smooth[y, 2 * r : 2 * r + count]
        nw, ne = smooth[y - d, r - d : r - d + count], smooth[y - d, r + d : r + d + count]
        sw, se = smooth[y + d, r - d : r - d + count], smooth[y + d, r + d : r + d + count]
        out = response[y, r : r + count]
        for x in range(count):
            straight = east[x] + west[x] - north[x] - south[x]
            diagonal = ne[x] + sw[x] - nw[x] - se[x]
            odd = (east[x] - west[x]) ** 2 + (north[x] - south[x]) ** 2
            odd += (ne[x] - sw[x]) ** 2 + (nw[x] - se[x]) ** 2
            out[x] = straight * straight + diagonal * diagonal - odd_weight * odd


@kernel
def _local_maxima(
    response: NDArray[np.float32],
    reach: int,
    least: np.float32,
    found: NDArray[np.float64],
    highest: NDArray[np.float32],
) -> int:
    """Fills found (x, y at the parabolas' tops); returns how many there are.

    highest (2, W): scratch.  A block of (reach + 1)^2 pixels holds one maximum at most.
    """
    height, width = response.shape
    count = 0
    margin, block = reach + 1, reach + 1
    for top in range(margin, height - margin, block):
        bottom = min(top + block, height - margin)
        _highest_of_columns(response, top, bottom, highest[0])
        _highest_to_the_right(highest[0], block, highest[1])
        for left in range(margin, width - margin, block):
            right = min(left + block, width - margin)
            value = highest[1, left]
            if value < least or _is_outdone(highest[0], value, left, right, reach):
                continue
            x, y = _last_place(response, (top, bottom, left, right), value)
            if not _is_peak(response, x, y, reach, value):
                continue
            if count < len(found):
                row = response[y]
                found[count, 0] = x + _vertex(row[x - 1], value, row[x + 1])
                found[count, 1] = y + _vertex(response[y - 1, x], value, response[y + 1, x])
            count += 1
    return count


@kernel_part(fastmath=True)
def _highest_of_columns(
    response: NDArray[np.float32], top: int, bottom: int, highest: NDArray[np.float32]
) -> None:
    """Maximum of each column of some rows."""
    for x in range(len(highest)):
        highest[x] = response[top, x]
    for y in range(top + 1, bottom):
        row = response[y]
        for x in range(len(highest)):
            highest[x] = max(highest[x], row[x])


@kernel_part(fastmath=True)
def _highest_to_the_right(
    values: NDArray[np.float32], count: int, highest: NDArray[np.float32]
) -> None:
    """Maximum of each value and the following ones, `count` in all."""
    for x in range(len(values)):
        highest[x] = values[x]
    inner = highest[: len(values) - count]
    for shift in range(1, count):
        shifted = values[shift : shift + len(inner)]
        for x in range(len(inner)):
            inner[x] = max(inner[x], shifted[x])


@kernel_part
def _is_outdone(
    highest: NDArray[np.float32], value: np.float32, left: int, right: int, reach: int
) -> bool:
    """Whether the columns from left to right that reach a value are near a higher one, or none."""
    first, last = left, right - 1
    while first < right and highest[first] < value:
        first += 1
    while last > first and highest[last] < value:
        last -= 1
    outdone = first == right
    for x in range(last - reach, min(first + reach + 1, len(highest))):
        outdone |= highest[x] > value
    return outdone


@kernel_part
def _last_place(
    response: NDArray[np.float32], block: tuple[int, int, int, int], value: np.float32
) -> tuple[int, int]:
    """The last pixel (x, y) of a block (top, bottom, left, right) that has a value."""
    top, bottom, left, right = block
    for y in range(bottom - 1, top - 1, -1):
        for x in range(right - 1, left - 1, -1):
            if response[y, x] == value:
                return x, y
    return left, top


@kernel_part
def _is_peak(response: NDArray[np.float32], x: int, y: int, reach: int, value: np.float32) -> bool:
    if response[y - 1, x] > value or response[y + 1, x] >= value:
        return False
    for dy in range(-reach, reach + 1):
        line = response[y + dy]
        for dx in range(-reach, reach + 1):
            other = line[x + dx]
            if other > value or (other == value and (dy > 0 or (dy == 0 and dx > 0))):
                return False
    return True


@kernel_part
def _vertex(before: float, top: float, after: float) -> float:
    bend = before - 2.0 * top + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0
