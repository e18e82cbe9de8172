"""Whether fitted corners look like those around them: bends, rings and edges, compared."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.corners.evidence import edge_evidence

__all__ = [
    "LEAST_ENCLOSED_QUALITY",
    "LEAST_QUALITY",
    "WEAKEST_ENCLOSED",
    "WEAKEST_RING",
    "compare",
    "find_edges",
    "measure_bends",
]

Float = NDArray[np.float64]

# Where the rim of something that hides the gel crosses a gridline, there is a saddle too.  It is
# weaker or stronger than those around it, or its contours run askew of the gridlines.  Of corners
# in sight, 99.9 % stay within 0.73 to 1.2 of their neighbours' strength, even at noise of 16 grey
# levels or on a worn print, and 99.9 % below a skew of 0.2 (0.48 on the worn print).
WEAKEST_SADDLE, STRONGEST_SADDLE = 0.65, 1.4
LARGEST_SKEW = 0.4
# The rings reach farther than the fit: least share of their variance that is a corner's, and their
# strength relative to the corners around.
LEAST_QUALITY = 0.45
WEAKEST_RING, STRONGEST_RING = 0.6, 1.5
# An edge to a neighbour differs in grey by this share of the corner's amplitude.
LEAST_EDGE = 0.4
# A corner all of whose neighbours are known is no rim's: on a ragged or spotted print it may look
# less like its neighbours.
WEAKEST_ENCLOSED, LEAST_ENCLOSED_QUALITY = 0.35, 0.25


def find_edges(
    smooth: NDArray[np.float32],
    position: Float,
    steps: tuple[Float, Float],
    sign: Float,
    amplitude: Float,
) -> NDArray[np.bool_]:
    """Whether at least half of the edges to known neighbours, and one, are there, (rows, cols).

    position (rows, cols, 2) px; steps: along i and along j, (rows, cols, 2) px each; sign (rows,
    cols): of corners as they should be; amplitude (rows, cols): of the rings, times the sign.
    """
    rows, cols = amplitude.shape
    ends = np.empty((3, 2 * rows * cols - rows - cols, 2))
    _set_edges(position, *steps, ends)
    has_edges = np.empty((rows, cols), dtype=np.bool_)
    _count_edges(edge_evidence(smooth, *ends), sign, amplitude, has_edges)
    return has_edges


@njit(cache=True, nogil=True)
def _set_edges(position: Float, row_step: Float, col_step: Float, ends: Float) -> None:
    """Start, end and the step across (3, m, 2) of all edges along i, then of those along j."""
    count = 0
    for di, dj, across in ((1, 0, col_step), (0, 1, row_step)):
        for i in range(position.shape[0] - di):
            for j in range(position.shape[1] - dj):
                for d in range(2):
                    ends[0, count, d] = position[i, j, d]
                    ends[1, count, d] = position[i + di, j + dj, d]
                    ends[2, count, d] = across[i, j, d]
                count += 1


@njit(cache=True, nogil=True)
def _count_edges(edges: Float, sign: Float, amplitude: Float, has_edges: NDArray[np.bool_]) -> None:
    """Judge corners by their edges (m, 2) in the order of `_set_edges`."""
    rows, cols = amplitude.shape
    known, seen = np.zeros((2, rows, cols), dtype=np.int64)
    count = 0
    for di, dj in ((1, 0), (0, 1)):
        for i in range(rows - di):
            for j in range(cols - dj):
                edge = edges[count, 1]
                count += 1
                if not np.isfinite(edge):
                    continue
                # Beyond an even corner the checker at (+, +) is dark.
                least = LEAST_EDGE * (amplitude[i, j] + amplitude[i + di, j + dj]) / 2
                is_edge = -sign[i, j] * edge > least
                known[i, j] += 1
                known[i + di, j + dj] += 1
                seen[i, j] += is_edge
                seen[i + di, j + dj] += is_edge
    for i in range(rows):
        for j in range(cols):
            has_edges[i, j] = seen[i, j] >= 1 and 2 * seen[i, j] >= known[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _curvature(hessian: Float, x: float, y: float) -> float:
    """Second derivative along a direction."""
    bend = hessian[0] * x * x + 2 * hessian[1] * x * y + hessian[2] * y * y
    return float(bend / (x * x + y * y))


@njit(cache=True, nogil=True)
def measure_bends(
    hessian: Float, row_step: Float, col_step: Float, sign: Float, bends: Float
) -> None:
    """Fill bends (2, rows, cols): down along the dark checkers' diagonal, and along gridlines.

    hessian (rows * cols, 3): xx, xy, yy; row_step, col_step (rows, cols, 2) px; sign (rows, cols)
    of corners as they should be.
    """
    rows, cols = sign.shape
    for i in range(rows):
        for j in range(cols):
            here = hessian[i * cols + j]
            a, b = row_step[i, j, 0], row_step[i, j, 1]
            c, d = col_step[i, j, 0], col_step[i, j, 1]
            down = _curvature(here, a - c, b - d) - _curvature(here, a + c, b + d)
            bends[0, i, j] = sign[i, j] * down
            bends[1, i, j] = max(abs(_curvature(here, a, b)), abs(_curvature(here, c, d)))


@njit(cache=True, nogil=True, error_model="numpy")
def compare(
    bends: Float,
    rings: tuple[Float, Float],
    around: tuple[Float, Float],
    alike: NDArray[np.bool_],
    similar: NDArray[np.bool_],
) -> None:
    """Fill in which corners (rows, cols) look like those around them, or at least similar.

    bends: see `measure_bends`; rings: amplitude, positive as it should be, and quality; around:
    usual bend and ring amplitude there.
    """
    strength, usual, ring, usual_ring = bends[0], around[0], rings[0], around[1]
    for i in range(alike.shape[0]):
        for j in range(alike.shape[1]):
            relative, relative_ring = strength[i, j] / usual[i, j], ring[i, j] / usual_ring[i, j]
            quality = rings[1][i, j]
            alike[i, j] = (
                WEAKEST_SADDLE < relative < STRONGEST_SADDLE
                and WEAKEST_RING < relative_ring < STRONGEST_RING
                and quality > LEAST_QUALITY
                and bends[1, i, j] < LARGEST_SKEW * strength[i, j]
            )
            similar[i, j] = relative_ring > WEAKEST_ENCLOSED and quality > LEAST_ENCLOSED_QUALITY
