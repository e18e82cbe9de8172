"""The dense surface: depth and displacement between the markers, on a regular grid.

Nodes are regular in material coordinates: node (x, y) is the point of the pattern that lies at
(x, y) where the pattern is undeformed, whatever has become of it since.  That serves mechanics:
`displacement` is a field over the undeformed surface; `height_map` serves morphology.

Curves through the markers of rows, and of columns, are splines.  Splines across the rows, and
across the columns, give two surfaces.  Their sum, less the surface of the corners alone that both
have in common, holds all curves (Gordon 1969).  Unknown markers are first filled by splines along
their gridlines; which nodes rest on such is determined apart, as the status.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import maximum_filter

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import GridShape, Status, Surface, SurfaceGrid

# A gridline goes on across so many pitches without a known marker: a lost corner's two segments.
LONGEST_GAP = 2.0
# Of the polynomials beyond the markers: a surface at rest is smooth and known well, and what noise
# a displacement has must not grow.
REST_DEGREE, DISPLACEMENT_DEGREE = 2, 1
# A whole number of spacings is one in spite of rounding.
ROUNDING = 1e-6
MOST_NODES = 4_000_000
# How far a node may lie off the mean of both directions, as a share of what their cubics bend.
FREEDOM = 0.15
# On a corner curves through rows and columns are the same.
TINY = 1e-12
# In place of MISSING, where the worst counts.
UNKNOWN = 9

# A point this far outside of a triangle, as a share of it, still lies on its border.
ON_BORDER = 1e-9


class DenseStatus(IntEnum):
    """What a node rests on.

    MEASURED: the four corners of its cell are measured, and no gridline around it has a gap.
    INTERPOLATED: a corner of its cell is predicted or lost, and the gridline goes on beyond.
    EXTRAPOLATED: beyond the outermost known markers, or in a hole between them, within the margin.
    """

    MISSING = 0
    MEASURED = 1
    INTERPOLATED = 2
    EXTRAPOLATED = 3


@dataclass(frozen=True)
class DenseSurface:
    """The marker surface on a regular grid of material points, gel frame, m; missing ones NaN.

    grid: material coordinates x and y of the nodes.  reference, position, displacement
    (rows, cols, 3): position = reference + displacement, z NaN for a monocular sensor; reference
    is known at nodes that are missing, too.  status (rows, cols): DenseStatus.
    """

    grid: SurfaceGrid
    reference: NDArray[np.float64]
    position: NDArray[np.float64]
    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]


def grid_over(shape: GridShape, pitch: float, spacing: float, margin: float = 0.0) -> SurfaceGrid:
    """Nodes so far apart over the pattern and a margin around it, m, one of them at x = y = 0.

    Raises InputError for lengths that make no grid, or one of more than four million nodes.
    """
    sides = [(n - 1) * pitch + 2 * margin for n in (shape.cols, shape.rows)]
    if not (0 < spacing <= min(sides) / 2 and 0 <= margin < np.inf):
        msg = (
            f"dense surface: found spacing {spacing:g} m and margin {margin:g} m, expected a "
            f"margin of at least 0 and a spacing above 0 and up to {min(sides) / 2:.3g} m"
        )
        raise InputError(msg)
    cols, rows = (2 * int(side / 2 / spacing + ROUNDING) + 1 for side in sides)
    if cols * rows > MOST_NODES:
        msg = f"dense surface: found {rows} x {cols} nodes, expected at most {MOST_NODES}"
        raise InputError(msg)
    return SurfaceGrid(rows, cols, ((cols - 1) * spacing, (rows - 1) * spacing))


def interpolate(surface: Surface, spacing: float, margin: float = 0.0) -> DenseSurface:
    """The dense surface with nodes so far apart, m; extrapolated by no more than the margin, m.

    For many surfaces of one sensor a SurfaceInterpolator does the same in less time.  Raises
    InputError where the lengths make no grid or the reference shows no pitch.
    """
    pitch = _pitch_of(surface.reference)
    grid = grid_over(surface.shape, pitch, spacing, margin)
    return SurfaceInterpolator(surface.shape, pitch, grid, margin).interpolate(surface)


class SurfaceInterpolator:
    """Makes dense surfaces on one grid; what depends on the reference alone is kept.

    pitch: of the pattern, m.  margin: how far to extrapolate, m, beyond the outermost markers and
    into holes.  Errs by the fourth power of the pitch where the displacement is smooth and all
    markers are seen; beside a step narrower than a checker it is off by up to a fifth of the
    step.  A lost marker changes the cells around it, and hardly those next to them.

    Virtual markers are displaced from where the reference, a smooth surface through its corners,
    has them: what print defects shift between corners is seen as displacement.
    """

    def __init__(
        self, shape: GridShape, pitch: float, grid: SurfaceGrid, margin: float = 0.0
    ) -> None:
        self._shape, self._grid, self._margin = shape, grid, margin
        self._segment = shape.points_per_segment + 1
        # Along columns and rows, in pitches.
        self._corners = [np.arange(n, dtype=np.float64) for n in shape.corners]
        self._markers = [
            np.arange((n - 1) * self._segment + 1) / self._segment for n in shape.corners
        ]
        self._places = [
            _on_markers(axis / pitch + (n - 1) / 2, self._segment)
            for axis, n in zip((grid.y, grid.x), shape.corners, strict=True)
        ]
        self._patches = _Patches(self._corners, self._markers, self._places)
        self._reference: NDArray[np.float64] | None = None

    def interpolate(self, surface: Surface) -> DenseSurface:
        """The dense surface of a frame; InputError for another shape than was announced."""
        if surface.shape != self._shape:
            msg = f"surface: found {surface.shape}, expected {self._shape}"
            raise InputError(msg)
        self._refer_to(surface.reference)
        moved, col_position = surface.displacement, surface.col_position.swapaxes(0, 1)
        rows = self._lines(moved, surface.row_position, self._rows_at_rest)
        cols = self._lines(moved.swapaxes(0, 1), col_position, self._cols_at_rest)
        row_status = self._line_status(surface.status, surface.row_status)
        col_status = self._line_status(surface.status.T, surface.col_status.swapaxes(0, 1))
        known = row_status > 0, col_status > 0
        bridged = (
            _between(self._markers[1], known[0], self._corners[1]),
            _between(self._markers[0], known[1], self._corners[0]).T,
        )
        displacement = self._patches.field(*self._filled(rows, cols, known, bridged))
        status = self._node_status(row_status, col_status, bridged)
        displacement[status == DenseStatus.MISSING] = np.nan
        return DenseSurface(
            grid=self._grid,
            reference=self._nodes_at_rest,
            position=self._nodes_at_rest + displacement,
            displacement=displacement,
            status=status,
        )

    def _refer_to(self, reference: NDArray[np.float64]) -> None:
        """Nodes and markers of all gridlines at rest, from the corners at rest."""
        before = self._reference
        if before is not None and np.array_equal(before, reference, equal_nan=True):
            return
        known, turned = np.isfinite(reference[..., 0]), reference.swapaxes(0, 1)
        by_rows = _filled_along(self._corners[1], reference, known)
        by_cols = _filled_along(self._corners[0], turned, known.T)
        corners = _mean_of_known(by_rows, by_cols.swapaxes(0, 1))
        to_nodes, to_markers = (
            [_spline(*each, REST_DEGREE) for each in zip(self._corners, places, strict=True)]
            for places in (self._places, self._markers)
        )
        self._nodes_at_rest = _weighted(to_nodes[0], _weighted(to_nodes[1], corners))
        self._rows_at_rest = to_markers[1] @ corners
        self._cols_at_rest = to_markers[0] @ corners.swapaxes(0, 1)
        self._reference = reference.copy()

    def _lines(
        self,
        corners: NDArray[np.float64],
        between: NDArray[np.float64],
        at_rest: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Displacements (lines, markers, 3), m, of all markers along each gridline."""
        values = np.empty_like(at_rest)
        values[:, :: self._segment] = corners
        inside = np.arange(values.shape[1]) % self._segment > 0
        values[:, inside] = between.reshape(len(values), -1, 3) - at_rest[:, inside]
        return values

    def _line_status(
        self, corners: NDArray[np.uint8], between: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """DenseStatus (lines, markers) of markers; a predicted one counts as interpolated."""
        status = np.empty((len(corners), (corners.shape[1] - 1) * self._segment + 1), np.uint8)
        status[:, :: self._segment] = corners
        inside = np.arange(status.shape[1]) % self._segment > 0
        status[:, inside] = between.reshape(len(corners), -1)
        known = np.where(status == Status.MEASURED, DenseStatus.MEASURED, DenseStatus.INTERPOLATED)
        return np.where(status == Status.MISSING, DenseStatus.MISSING, known).astype(np.uint8)

    def _filled(
        self,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        known: tuple[NDArray[np.bool_], NDArray[np.bool_]],
        bridged: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rows and columns with some value for every marker; lost corners are the same in both.

        known: markers of rows and of columns.  bridged: see `_node_status`.
        """
        known_rows, known_cols = known
        if known_rows.all() and known_cols.all():
            return rows, cols
        step, (along_cols, along_rows) = slice(None, None, self._segment), self._markers
        by_rows = _filled_along(along_rows, rows, known_rows)[:, step]
        by_cols = _filled_along(along_cols, cols, known_cols)[:, step].swapaxes(0, 1)
        # A curve that goes on beyond its end is taken only where there is no better one.
        by_rows[(bridged[0] == 0) & (bridged[1] > 0)] = np.nan
        by_cols[(bridged[1] == 0) & (bridged[0] > 0)] = np.nan
        corners = _mean_of_known(by_rows, by_cols)
        found = np.isfinite(corners[..., 0])
        rows[:, step], known_rows[:, step] = corners, found
        cols[:, step], known_cols[:, step] = corners.swapaxes(0, 1), found.T
        filled = (
            _filled_along(along_rows, rows, known_rows),
            _filled_along(along_cols, cols, known_cols),
        )
        for values in filled:
            values[np.isnan(values[..., 0])] = 0.0
        return filled

    def _node_status(
        self,
        rows: NDArray[np.uint8],
        cols: NDArray[np.uint8],
        bridged: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    ) -> NDArray[np.uint8]:
        """Status (ny, nx): the worst of the gridlines and corners around each node.

        bridged: what curves along rows and along columns rest on at the corners.
        """
        step, (along_cols, along_rows) = slice(None, None, self._segment), self._markers
        corners = rows[:, step].copy()
        lost = corners == DenseStatus.MISSING
        corners[lost & (np.maximum(*bridged) > 0)] = DenseStatus.INTERPOLATED
        rows[:, step], cols[:, step] = corners, corners.T
        on_rows = _between(along_rows, rows > 0, self._places[1])
        on_cols = _between(along_cols, cols > 0, self._places[0])
        status = self._worst_around(on_rows, on_cols, corners)
        size = [2 * int(self._margin / spacing + ROUNDING) + 1 for spacing in self._grid.spacing]
        within = maximum_filter(status > 0, size=size[::-1])
        status[(status == DenseStatus.MISSING) & within] = DenseStatus.EXTRAPOLATED
        return status

    def _worst_around(
        self, rows: NDArray[np.uint8], cols: NDArray[np.uint8], corners: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """rows (rows, nx) and cols (cols, ny): of the gridlines at the nodes."""
        rows, cols, corners = (np.where(a == 0, UNKNOWN, a) for a in (rows, cols, corners))
        around = []
        for at, n in zip(self._places, self._shape.corners, strict=True):
            low, high = (end(at).clip(0, n - 1).astype(np.intp) for end in (np.floor, np.ceil))
            around.append((low, high))
        worst = np.zeros((len(self._places[0]), len(self._places[1])), np.uint8)
        for i in around[0]:
            worst = np.maximum(worst, rows[i])
            for j in around[1]:
                worst = np.maximum(worst, corners[np.ix_(i, j)])
        for j in around[1]:
            worst = np.maximum(worst, cols[j].T)
        return np.where(worst == UNKNOWN, DenseStatus.MISSING, worst).astype(np.uint8)


class _Patches:
    """The surface between gridlines, at nodes (Gordon's, held where it would ring).

    It is the most accurate where the displacement is smooth.  Beside an edge it rings: it is held
    near the mean of the surfaces of rows and of columns, in which each counts the more, the nearer
    its gridlines are.
    """

    def __init__(
        self,
        corners: Sequence[NDArray[np.float64]],
        markers: Sequence[NDArray[np.float64]],
        places: Sequence[NDArray[np.float64]],
    ) -> None:
        """Of corners, markers and nodes along columns and rows, in pitches."""
        degree = DISPLACEMENT_DEGREE
        fine, coarse = zip(markers, places, strict=True), list(zip(corners, places, strict=True))
        self._segment = (len(markers[0]) - 1) // (len(corners[0]) - 1)
        self._along = [_spline(steps, at, degree) for steps, at in fine]
        self._across = [_spline(steps, at, degree) for steps, at in coarse]
        self._straight = [_spline(steps, at, degree, order=1) for steps, at in coarse]
        off_rows, off_cols = (np.sin(np.pi * at) ** 2 + TINY for at in places)
        self._share = (off_cols / (off_cols + off_rows[:, None]))[..., None]

    def field(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (ny, nx, 3) at the nodes, of those (lines, markers, 3) along gridlines."""
        corners = rows[:, :: self._segment]
        on_rows, on_cols = _weighted(self._along[1], rows), _weighted(self._along[0], cols)
        by_rows, straight_rows = (
            _weighted(weights[0], on_rows) for weights in (self._across, self._straight)
        )
        by_cols, straight_cols = (
            _weighted(weights[1], on_cols).swapaxes(0, 1)
            for weights in (self._across, self._straight)
        )
        by_corners = _weighted(self._across[0], _weighted(self._across[1], corners))
        bend = np.abs(by_rows - straight_rows) + np.abs(by_cols - straight_cols)
        mean = by_cols + self._share * (by_rows - by_cols)
        values = by_rows + by_cols - by_corners
        return np.asarray(np.clip(values, mean - FREEDOM * bend, mean + FREEDOM * bend))


def _spline(
    steps: NDArray[np.float64], places: NDArray[np.float64], degree: int, order: int = 3
) -> NDArray[np.float64]:
    """Weights (places, steps) of the values at the steps in their spline at the places.

    Beyond the steps, of the line (degree 1) or parabola (2) through points a pitch apart.
    """
    spline = make_interp_spline(steps, np.eye(len(steps)), min(order, len(steps) - 1))
    nearest = places.clip(steps[0], steps[-1])
    apart = min(1.0, (steps[-1] - steps[0]) / degree)
    beyond = (np.abs(places - nearest) / apart)[:, None]
    inward = apart * np.sign(nearest - places)
    first, second = spline(nearest), spline(nearest + inward)
    weights: NDArray[np.float64] = first + beyond * (first - second)
    if degree > 1:
        third = spline(nearest + 2 * inward)
        weights += beyond * (beyond + 1) / 2 * (first - 2 * second + third)
    return weights


def _weighted(weights: NDArray[np.float64], lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (places, lines, 3) by weights (places, steps) of those (lines, steps, 3)."""
    return np.asarray(np.tensordot(weights, lines, (1, 1)))


def _filled_along(
    steps: NDArray[np.float64], lines: NDArray[np.float64], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Values (lines, steps, 3) with splines along lines in place of what is not known.

    NaN stays where a line has less than two known points.
    """
    filled = np.where(known[..., None], lines, np.nan)
    for line in np.flatnonzero(~known.all(axis=1) & (known.sum(axis=1) > 1)):
        at = known[line]
        weights = _spline(steps[at], steps[~at], DISPLACEMENT_DEGREE)
        filled[line, ~at] = weights @ lines[line, at]
    return filled


def _mean_of_known(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of two fields; NaN where both are."""
    return (np.where(np.isnan(a), b, a) + np.where(np.isnan(b), a, b)) / 2


def _between(
    steps: NDArray[np.float64], known: NDArray[np.bool_], places: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """What curves through known points (lines, steps) rest on, (lines, places).

    MEASURED between points that are a pitch apart at most, INTERPOLATED across longer gaps.
    """
    last = len(steps) - 1
    numbers = np.arange(len(steps))
    before = np.maximum.accumulate(np.where(known, numbers, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, numbers, last + 1)[:, ::-1], axis=1)[:, ::-1]
    low = before[:, (np.searchsorted(steps, places, "right") - 1).clip(0)]
    high = after[:, np.searchsorted(steps, places).clip(max=last)]
    gap = steps[high.clip(max=last)] - steps[low.clip(0)]
    is_within = (low >= 0) & (high <= last) & (places >= steps[0]) & (places <= steps[-1])
    near = np.where(gap <= 1 + ROUNDING, DenseStatus.MEASURED, DenseStatus.INTERPOLATED)
    is_bridged = is_within & (gap <= LONGEST_GAP + ROUNDING)
    return np.where(is_bridged, near, DenseStatus.MISSING).astype(np.uint8)


def _on_markers(places: NDArray[np.float64], segment: int) -> NDArray[np.float64]:
    """Places in pitches; those on a marker, but for rounding, are on it."""
    markers = np.rint(places * segment) / segment
    return np.where(np.abs(markers - places) < ROUNDING, markers, places)


def _pitch_of(reference: NDArray[np.float64]) -> float:
    """Mean step between neighbouring corners at rest along both axes, m."""
    steps = np.concatenate(
        [np.diff(reference[..., 0], axis=1).ravel(), np.diff(reference[..., 1], axis=0).ravel()]
    )
    steps = steps[np.isfinite(steps)]
    pitch = float(steps.mean()) if len(steps) else float("nan")
    if not pitch > 0:
        msg = "dense surface: found no pitch in the reference, expected corners regular in x and y"
        raise InputError(msg)
    return pitch


@dataclass(frozen=True)
class HeightMap:
    """Height of the deformed surface over places in space, gel frame, m; NaN where not known.

    grid: x and y of the places.  height (rows, cols); status (rows, cols): DenseStatus, the worst
    of the three nodes around.
    """

    grid: SurfaceGrid
    height: NDArray[np.float64]
    status: NDArray[np.uint8]


def height_map(dense: DenseSurface, grid: SurfaceGrid | None = None) -> HeightMap:
    """Height over a grid of places, by default over the x and y that the nodes have at rest.

    Linear between the dense surface's nodes: errs by the square of their spacing.  Where folds lie
    above each other, the outermost counts.  All missing for a monocular sensor.
    """
    grid = grid or dense.grid
    height = np.full((grid.rows, grid.cols), -np.inf)
    status = np.zeros(height.shape, np.uint8)
    corners, codes = _triangles(dense)
    corners[..., :2] = (corners[..., :2] - (grid.x[0], grid.y[0])) / grid.spacing
    low = np.ceil(corners[..., :2].min(axis=1) - ON_BORDER).astype(np.intp)
    size = np.floor(corners[..., :2].max(axis=1) + ON_BORDER).astype(np.intp) - low + 1
    for dx, dy in np.ndindex(*size.max(axis=0, initial=0)):
        reaching = np.flatnonzero((size > (dx, dy)).all(axis=1))
        _draw(corners[reaching], low[reaching] + (dx, dy), codes[reaching], height, status)
    height[status == DenseStatus.MISSING] = np.nan
    return HeightMap(grid, height, status)


def _triangles(dense: DenseSurface) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Two triangles (n, 3, 3) of known nodes for each cell, m; the worst status of the nodes."""
    nodes = np.arange(dense.status.size).reshape(dense.status.shape)
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
    corners = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    status, position = dense.status.ravel()[corners], dense.position.reshape(-1, 3)[corners]
    known = (status > 0).all(axis=1) & np.isfinite(position[..., 2]).all(axis=1)
    return position[known], status[known].max(axis=1)


def _draw(
    corners: NDArray[np.float64],
    pixel: NDArray[np.intp],
    codes: NDArray[np.uint8],
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Draw one pixel, (x, y), of each triangle where it lies within; in steps of the raster."""
    a, b, c = (corners[:, k] for k in range(3))
    ab, ac, ap = b - a, c - a, pixel - a[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        twice_area = ab[:, 0] * ac[:, 1] - ac[:, 0] * ab[:, 1]
        of_b = (ap[:, 0] * ac[:, 1] - ac[:, 0] * ap[:, 1]) / twice_area
        of_c = (ab[:, 0] * ap[:, 1] - ap[:, 0] * ab[:, 1]) / twice_area
    rows, cols = pixel[:, 1], pixel[:, 0]
    within = (of_b >= -ON_BORDER) & (of_c >= -ON_BORDER) & (of_b + of_c <= 1 + ON_BORDER)
    within &= (rows >= 0) & (cols >= 0) & (rows < height.shape[0]) & (cols < height.shape[1])
    z, at = (a[:, 2] + of_b * ab[:, 2] + of_c * ac[:, 2])[within], (rows[within], cols[within])
    np.maximum.at(height, at, z)
    top = z >= height[at]
    status[at[0][top], at[1][top]] = codes[within][top]
