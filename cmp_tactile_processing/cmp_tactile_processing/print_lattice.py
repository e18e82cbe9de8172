"""Where the print lies in an image: a smooth map from grid numbers to pixels, and its inverse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import BSpline

__all__ = ["PrintPlaces", "SmoothLattice", "places_in_image"]

# A knot about every so many checkers, and at most so many spans: the print at rest bends little,
# and the fit must average over enough corners to leave out a damaged one.
CHECKERS_PER_KNOT, MOST_SPANS = 3, 10
ROBUST_ROUNDS = 6
# A corner that lies so many typical deviations off counts half as much.
HALF_WEIGHT = 2.5
# Keeps the weights finite where corners are exact, px.
LEAST_DEVIATION_PX = 0.01
# Penalty of the spline's coefficients' third differences, so that hidden parts do not run wild.
SMOOTHNESS = 1e-4
# A checker is taken to pieces of a quarter of its side, within which the map is bilinear.
PIECES = 4


@dataclass(frozen=True)
class SmoothLattice:
    """A spline from grid numbers (i, j) to pixels that damaged corners do not pull along.

    rows, cols: knots and degree per direction; coefficients (m, n, 2) px; deviation_px: typical
    distance of a measured corner from it, per coordinate.
    """

    rows: tuple[NDArray[np.float64], int]
    cols: tuple[NDArray[np.float64], int]
    coefficients: NDArray[np.float64]
    deviation_px: float

    @classmethod
    def through(cls, corners: NDArray[np.float64]) -> SmoothLattice:
        """Robust least squares through corners (rows, cols, 2) px; NaN where not measured."""
        rows, cols = (_knots(count) for count in corners.shape[:2])
        basis_i = _basis(rows, np.arange(corners.shape[0]))
        basis_j = _basis(cols, np.arange(corners.shape[1]))
        known = np.isfinite(corners[..., 0])
        i, j = np.nonzero(known)
        size = basis_i.shape[1], basis_j.shape[1]
        design = (basis_i[i][:, :, None] * basis_j[j][:, None, :]).reshape(len(i), -1)
        target = corners[known]
        penalty = SMOOTHNESS * _roughness(*size)
        weight, solution, typical = np.ones(len(i)), np.zeros((design.shape[1], 2)), 0.0
        for _ in range(ROBUST_ROUNDS):
            weighted = design * weight[:, None]
            solution = np.linalg.solve(design.T @ weighted + penalty, weighted.T @ target)
            distance = np.linalg.norm(target - design @ solution, axis=1)
            # Median of the length of a two-dimensional normal deviate: 1.177 standard deviations.
            typical = max(float(np.median(distance)) / 1.177, LEAST_DEVIATION_PX)
            weight = 1 / (1 + (distance / (HALF_WEIGHT * typical)) ** 2) ** 2
        return cls(rows, cols, solution.reshape(*size, 2), typical)

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (m, n, 2) at all pairs of rows i (m,) and columns j (n,), fractional or not."""
        basis_i, basis_j = _basis(self.rows, i), _basis(self.cols, j)
        return np.asarray(np.einsum("ma,nb,abd->mnd", basis_i, basis_j, self.coefficients))


@dataclass(frozen=True)
class PrintPlaces:
    """Each pixel's place on the print.

    number (H, W, 2): row and column, corner (i, j) at (i, j), NaN beside the print.
    checker (H, W): +1 and -1 on checkers of either colour, +1 where floor(i) + floor(j) is even;
    what lies between is the share of either colour in a pixel on an edge.
    """

    number: NDArray[np.float32]
    checker: NDArray[np.float32]


def places_in_image(
    lattice: SmoothLattice, corners: tuple[int, int], shape: tuple[int, int]
) -> PrintPlaces:
    """Places on the print, with its outermost checkers, of the pixels of an image (H, W)."""
    first = -1.0
    i, j = (first + np.arange((count + 1) * PIECES + 1) / PIECES for count in corners)
    number = np.full((*shape, 2), np.nan, dtype=np.float32)
    checker = np.zeros(shape, dtype=np.float32)
    _fill_places(lattice.at(i, j), first, number, checker)
    return PrintPlaces(number, checker)


def _knots(count: int) -> tuple[NDArray[np.float64], int]:
    degree = int(np.clip(count - 2, 1, 3))
    spans = int(np.clip(round((count - 1) / CHECKERS_PER_KNOT), 1, MOST_SPANS))
    spans = max(1, min(spans, count - 1 - degree))
    inner = np.linspace(0, count - 1, spans + 1)
    ends = np.zeros(degree), np.full(degree, float(count - 1))
    return np.concatenate([ends[0], inner, ends[1]]), degree


def _basis(axis: tuple[NDArray[np.float64], int], x: NDArray[np.float64]) -> NDArray[np.float64]:
    knots, degree = axis
    count = len(knots) - degree - 1
    spline = BSpline(knots, np.eye(count), degree, extrapolate=True)
    return np.asarray(spline(np.asarray(x, dtype=np.float64)))


def _roughness(rows: int, cols: int) -> NDArray[np.float64]:
    """Squared third differences of (rows, cols) coefficients along both directions."""
    parts = []
    for count in (rows, cols):
        difference = np.diff(np.eye(count), n=min(3, count - 1), axis=0)
        parts.append(difference.T @ difference)
    return np.kron(parts[0], np.eye(cols)) + np.kron(np.eye(rows), parts[1])


@njit(cache=True, nogil=True)
def _fill_places(
    nodes: NDArray[np.float64],
    first: float,
    number: NDArray[np.float32],
    checker: NDArray[np.float32],
) -> None:
    """Fill number and checker from the map's pixels at nodes (m, n, 2), 1 / PIECES apart."""
    height, width = checker.shape
    for a in range(nodes.shape[0] - 1):
        for b in range(nodes.shape[1] - 1):
            corner = nodes[a, b]
            along_i, along_j = nodes[a + 1, b] - corner, nodes[a, b + 1] - corner
            twist = nodes[a + 1, b + 1] - corner - along_i - along_j
            low = np.empty(2)
            high = np.empty(2)
            for d in range(2):
                ends = nodes[a : a + 2, b : b + 2, d]
                low[d], high[d] = ends.min(), ends.max()
            if not (high[0] - low[0] < width and high[1] - low[1] < height):
                continue
            for y in range(max(0, int(np.ceil(low[1]))), min(height - 1, int(high[1])) + 1):
                for x in range(max(0, int(np.ceil(low[0]))), min(width - 1, int(high[0])) + 1):
                    s = t = 0.5
                    det = 0.0
                    to_row = to_col = 0.0
                    for _ in range(4):
                        ix, iy = along_i[0] + t * twist[0], along_i[1] + t * twist[1]
                        jx, jy = along_j[0] + s * twist[0], along_j[1] + s * twist[1]
                        rx = x - corner[0] - s * along_i[0] - t * jx
                        ry = y - corner[1] - s * along_i[1] - t * jy
                        det = ix * jy - iy * jx
                        if det == 0.0:
                            break
                        s += (rx * jy - ry * jx) / det
                        t += (ix * ry - iy * rx) / det
                        # Distance of the gridlines, px, of rows and of columns.
                        to_row = abs(det) / np.hypot(jx, jy) * PIECES
                        to_col = abs(det) / np.hypot(ix, iy) * PIECES
                    if det == 0.0 or not (-1e-6 <= s <= 1 + 1e-6 and -1e-6 <= t <= 1 + 1e-6):
                        continue
                    i, j = first + (a + s) / PIECES, first + (b + t) / PIECES
                    row, col = np.round(i), np.round(j)
                    number[y, x, 0], number[y, x, 1] = i, j
                    ramp = min(1.0, max(-1.0, 2 * (i - row) * to_row))
                    ramp *= min(1.0, max(-1.0, 2 * (j - col) * to_col))
                    checker[y, x] = ramp if int(row + col) % 2 == 0 else -ramp
