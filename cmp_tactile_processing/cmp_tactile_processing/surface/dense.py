"""The dense surface: depth and displacement between the markers, on a regular grid.

Nodes are regular in material coordinates: node (x, y) is the point of the pattern that lies at
(x, y) where the pattern is undeformed, whatever has become of it since.  That serves mechanics:
`displacement` is a field over the undeformed surface.  For morphology, the shape of what touches,
`height_map` makes a map of z over x and y in space of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured import GridShape, Status, Surface, SurfaceGrid

# A gridline goes on across so many pitches without a known marker: a lost corner's two segments.
LONGEST_GAP = 2.0
# Of the polynomials beyond the known markers: a surface at rest is smooth and known well, and
# what noise a displacement has must not grow.
REST_DEGREE, DISPLACEMENT_DEGREE = 2, 1
# A whole number of spacings is one in spite of rounding.
ROUNDING = 1e-6
MOST_NODES = 4_000_000
# How far a node may lie off the mean of both directions, as a share of what their cubics bend.
FREEDOM = 0.25
# Of gridlines with gaps, those that were seen last.
KEPT_WEIGHTS = 256
# On a corner curves through rows and columns are the same.
TINY = 1e-12
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

    Raises GeometryError for lengths that make no grid, or one of more than four million nodes.
    """
    sides = [(n - 1) * pitch + 2 * margin for n in (shape.cols, shape.rows)]
    if not (0 < spacing <= min(sides) / 2 and 0 <= margin < np.inf):
        msg = (
            f"dense surface: found spacing {spacing:g} m and margin {margin:g} m, expected a "
            f"margin of at least 0 and a spacing above 0 and up to {min(sides) / 2:.3g} m"
        )
        raise GeometryError(msg)
    cols, rows = (2 * int(side / 2 / spacing + ROUNDING) + 1 for side in sides)
    if cols * rows > MOST_NODES:
        msg = f"dense surface: found {rows} x {cols} nodes, expected at most {MOST_NODES}"
        raise GeometryError(msg)
    return SurfaceGrid(rows, cols, ((cols - 1) * spacing, (rows - 1) * spacing))


def interpolate(surface: Surface, spacing: float, margin: float = 0.0) -> DenseSurface:
    """The dense surface with nodes so far apart, m; extrapolated by no more than the margin, m.

    For many surfaces of one sensor a SurfaceInterpolator does the same in less time.  Raises
    GeometryError where the lengths make no grid or the reference shows no pitch.
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
        self._shape, self._grid = shape, grid
        self._segment = shape.points_per_segment + 1
        counts = shape.rows, shape.cols
        axes = zip((grid.y, grid.x), counts, strict=True)
        places = [_on_markers(axis / pitch + (n - 1) / 2, self._segment) for axis, n in axes]
        fine = [_steps(n, self._segment) for n in counts]
        reach = margin / pitch
        self._displaced = _Patches(counts, self._segment, places, reach, DISPLACEMENT_DEGREE)
        self._rest = _Patches(counts, 1, places, reach, REST_DEGREE)
        self._markers_at_rest = [
            _Curve(_steps(n, 1), at, LONGEST_GAP, 0.0, REST_DEGREE)
            for n, at in zip(counts, fine, strict=True)
        ]
        self._reference: NDArray[np.float64] | None = None

    def interpolate(self, surface: Surface) -> DenseSurface:
        """The dense surface of a frame; GeometryError for another shape than was announced."""
        if surface.shape != self._shape:
            msg = f"surface: found {surface.shape}, expected {self._shape}"
            raise GeometryError(msg)
        self._refer_to(surface.reference)
        corners = _Points.from_status(surface.displacement, surface.status)
        rows = self._joined(corners, surface.row_position, surface.row_status, self._rows_at_rest)
        cols = self._joined(
            corners.turned(),
            surface.col_position.swapaxes(0, 1),
            surface.col_status.swapaxes(0, 1),
            self._cols_at_rest,
        )
        displacement, status = self._displaced.field(rows, cols, corners)
        return DenseSurface(
            grid=self._grid,
            reference=self._nodes_at_rest,
            position=self._nodes_at_rest + displacement,
            displacement=displacement,
            status=status,
        )

    def _refer_to(self, reference: NDArray[np.float64]) -> None:
        """Nodes and markers of all gridlines at rest, from the corners at rest."""
        known = self._reference
        if known is not None and np.array_equal(known, reference, equal_nan=True):
            return
        corners = _Points.from_status(reference, np.full(reference.shape[:2], Status.MEASURED))
        self._nodes_at_rest = self._rest.field(corners, corners.turned(), corners)[0]
        along_cols, along_rows = self._markers_at_rest
        self._rows_at_rest = along_rows.through(corners).values
        self._cols_at_rest = along_cols.through(corners.turned()).values
        self._reference = reference.copy()

    def _joined(
        self,
        corners: _Points,
        between: NDArray[np.float64],
        status: NDArray[np.uint8],
        at_rest: NDArray[np.float64],
    ) -> _Points:
        """Displacements of all markers along each gridline, virtual ones between the corners."""
        values = np.empty_like(at_rest)
        of = np.empty(values.shape[:2], np.uint8)
        values[:, :: self._segment], of[:, :: self._segment] = corners.values, corners.status
        inside = np.arange(values.shape[1]) % self._segment > 0
        shape = len(values), int(inside.sum())
        values[:, inside] = between.reshape(*shape, 3) - at_rest[:, inside]
        of[:, inside] = status.reshape(shape)
        return _Points.from_status(values, of)


@dataclass(frozen=True)
class _Points:
    """Points (lines, n, 3) along gridlines, m, and what they rest on (lines, n), a DenseStatus.

    NaN where a point is missing, and z where there is no depth.
    """

    values: NDArray[np.float64]
    status: NDArray[np.uint8]

    @classmethod
    def from_status(cls, values: NDArray[np.float64], status: NDArray[np.uint8]) -> _Points:
        """Of markers with their Status; a predicted one counts as interpolated."""
        seen = (status != Status.MISSING) & np.isfinite(values[..., :2]).all(axis=-1)
        found = np.where(status == Status.MEASURED, DenseStatus.MEASURED, DenseStatus.INTERPOLATED)
        return cls(values, np.where(seen, found, DenseStatus.MISSING).astype(np.uint8))

    def turned(self) -> _Points:
        """Lines along the other direction."""
        return _Points(self.values.swapaxes(0, 1), self.status.T)


@dataclass(frozen=True, eq=False)
class _Curve:
    """Cubics through the nearest known points of lines, evaluated at the same places on each.

    steps (n,): where points lie, places (m,): where values are wanted, in pitches.  Points that lie
    apart by more than `longest` belong to different curves; a curve goes on by `reach` beyond its
    ends, as a polynomial of some degree through points a pitch apart.  order: number of nearest
    points.
    """

    steps: NDArray[np.float64]
    places: NDArray[np.float64]
    longest: float
    reach: float
    degree: int
    order: int = 4

    @cached_property
    def _weights(self) -> Callable[[bytes], tuple[NDArray[np.float64], NDArray[np.uint8]]]:
        # Most lines have no gap, and others keep theirs for a while.
        return lru_cache(KEPT_WEIGHTS)(self._make_weights)

    def through(self, points: _Points) -> _Points:
        """Values at the places, (lines, m, 3)."""
        known = points.status != DenseStatus.MISSING
        if known.all():
            weights, states = self._weights(known[0].tobytes())
            values = np.tensordot(weights, points.values, (1, 1)).swapaxes(0, 1)
            return _Points(values, np.broadcast_to(states, values.shape[:2]))
        status = np.empty((len(known), len(self.places)), np.uint8)
        values = np.empty((*status.shape, 3))
        patterns, pattern_of = np.unique(known, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            lines = np.flatnonzero(pattern_of.ravel() == number)
            weights, states = self._weights(pattern.tobytes())
            found = points.values[np.ix_(lines, np.flatnonzero(pattern))]
            values[lines] = np.tensordot(weights, found, (1, 1)).swapaxes(0, 1)
            status[lines] = states
        values[status == DenseStatus.MISSING] = np.nan
        return _Points(values, status)

    def _make_weights(self, known: bytes) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Weights (m, known points) of the known points, and what each place rests on."""
        index = np.flatnonzero(np.frombuffer(known, np.bool_))
        steps = self.steps[index]
        weights = np.zeros((len(self.places), len(index)))
        status = np.zeros(len(self.places), np.uint8)
        nearest = np.full(len(self.places), self.reach + ROUNDING)
        for part in np.split(
            np.arange(len(index)), np.flatnonzero(np.diff(steps) > self.longest + ROUNDING) + 1
        ):
            if not len(part):
                continue
            low, high = steps[part[[0, -1]]]
            off = np.maximum(0.0, np.maximum(low - self.places, self.places - high))
            taken = (off == 0) | (off < nearest)
            nearest[taken] = off[taken]
            weights[taken] = 0.0
            weights[np.ix_(taken, part)] = _weights_through(
                steps[part], self.places[taken], self.order, self.degree
            )
            status[taken] = np.where(
                off[taken] > 0,
                DenseStatus.EXTRAPOLATED,
                _between(steps[part], self.places[taken]),
            )
        return weights, status


def _between(steps: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.uint8]:
    """MEASURED between known points that are a pitch apart at most, else INTERPOLATED."""
    after = np.searchsorted(steps, places).clip(0, len(steps) - 1)
    near = (steps[after] == places) | (steps[after] - steps[after - 1] <= 1 + ROUNDING)
    return np.where(near, DenseStatus.MEASURED, DenseStatus.INTERPOLATED).astype(np.uint8)


def _weights_through(
    steps: NDArray[np.float64], places: NDArray[np.float64], order: int, degree: int
) -> NDArray[np.float64]:
    """Weights (places, steps) of polynomials through so many nearest points.

    Beyond the ends of a degree of its own, and through points a pitch apart.
    """
    count = min(order, len(steps))
    first = (np.searchsorted(steps, places) - count // 2).clip(0, len(steps) - count)
    chosen = first[:, None] + np.arange(count)
    weights = np.zeros((len(places), len(steps)))
    np.put_along_axis(weights, chosen, _lagrange(steps[chosen], places), axis=1)
    for beyond, inward in (
        (places < steps[0], steps - steps[0]),
        (places > steps[-1], steps[-1] - steps),
    ):
        apart = min(1.0, inward.max() / degree)
        through = np.unique([np.abs(inward - k * apart).argmin() for k in range(degree + 1)])
        weights[beyond] = 0.0
        weights[np.ix_(beyond, through)] = _lagrange(steps[None, through], places[beyond])
    return weights


def _lagrange(nodes: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (n, m) of the polynomial through nodes (n or 1, m) at places (n,)."""
    weights = np.ones((len(places), nodes.shape[1]))
    for a, b in np.ndindex(nodes.shape[1], nodes.shape[1]):
        if a != b:
            weights[:, a] *= (places - nodes[:, b]) / (nodes[:, a] - nodes[:, b])
    return weights


class _Patches:
    """The surface between gridlines, at nodes (Gordon's, held where it would ring).

    Cubics across the rows, and across the columns, give two surfaces.  Their sum, less the surface
    of the corners alone that both have in common, holds all curves and is the most accurate where
    the displacement is smooth.  Beside an edge it rings: it is held near the mean of the two, in
    which each counts the more, the nearer its gridlines are.
    """

    def __init__(
        self,
        counts: tuple[int, int],
        segment: int,
        places: Sequence[NDArray[np.float64]],
        reach: float,
        degree: int,
    ) -> None:
        """counts: rows and columns.  places: of the nodes, along columns and rows, in pitches."""
        self._counts, self._segment, self._places = counts, segment, places
        both = list(zip(counts, places, strict=True))
        self._along = [_Curve(_steps(n, segment), at, LONGEST_GAP, reach, degree) for n, at in both]
        self._across, self._straight = (
            [_Curve(_steps(n, 1), at, 1.0, reach, degree, order) for n, at in both]
            for order in (4, 2)
        )
        self._bridges = [
            _Curve(_steps(n, segment), _steps(n, 1), LONGEST_GAP, 0.0, degree) for n in counts
        ]
        off_rows, off_cols = (np.sin(np.pi * at) ** 2 + TINY for at in places)
        self._share = (off_cols / (off_cols + off_rows[:, None]))[..., None]

    def field(
        self, rows: _Points, cols: _Points, corners: _Points
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Values (ny, nx, 3) and status at the nodes, of what is known along gridlines.

        cols: columns as lines.
        """
        if not corners.status.all():
            rows, cols, corners = self._bridged(rows, cols, corners)
        on_rows, on_cols = self._along[1].through(rows), self._along[0].through(cols)
        by_rows = self._across[0].through(on_rows.turned()).turned()
        by_cols = self._across[1].through(on_cols.turned())
        by_corners = self._across[0].through(self._across[1].through(corners).turned()).turned()
        bend = np.abs(by_rows.values - self._straight[0].through(on_rows.turned()).turned().values)
        bend += np.abs(by_cols.values - self._straight[1].through(on_cols.turned()).values)
        mean = by_cols.values + self._share * (by_rows.values - by_cols.values)
        values = by_rows.values + by_cols.values - by_corners.values
        values = np.clip(values, mean - FREEDOM * bend, mean + FREEDOM * bend)
        no_rows, no_cols = by_rows.status == 0, by_cols.status == 0
        status = self._status(on_rows.status, on_cols.status, corners.status)
        if not status.all():
            in_part = np.isnan(values[..., 0])
            values[in_part] = mean[in_part]
            values[no_rows], values[no_cols] = by_cols.values[no_rows], by_rows.values[no_cols]
            status[status == 0] = DenseStatus.EXTRAPOLATED
            status[no_rows & no_cols] = DenseStatus.MISSING
        return values, status

    def _bridged(
        self, rows: _Points, cols: _Points, corners: _Points
    ) -> tuple[_Points, _Points, _Points]:
        """The same with corners that are lost between known markers, as the mean of both curves."""
        lost = corners.status == DenseStatus.MISSING
        both = self._bridges[1].through(rows), self._bridges[0].through(cols).turned()
        found = np.stack([points.status > 0 for points in both])
        total = sum(np.where(f[..., None], p.values, 0.0) for f, p in zip(found, both, strict=True))
        lost &= found.any(axis=0)
        values, status = corners.values.copy(), corners.status.copy()
        values[lost] = (total / np.maximum(found.sum(axis=0), 1)[..., None])[lost]
        status[lost] = DenseStatus.INTERPOLATED
        bridged = _Points(values, status)
        joined = []
        for line, part in ((rows, bridged), (cols, bridged.turned())):
            values, status = line.values.copy(), line.status.copy()
            values[:, :: self._segment], status[:, :: self._segment] = part.values, part.status
            joined.append(_Points(values, status))
        return joined[0], joined[1], bridged

    def _status(
        self, rows: NDArray[np.uint8], cols: NDArray[np.uint8], corners: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """The worst of the gridlines and corners around each node, MISSING where one is unknown.

        rows (rows, nx) and cols (cols, ny): of the gridlines at the nodes.
        """
        rows, cols, corners = (np.where(a == 0, UNKNOWN, a) for a in (rows, cols, corners))
        around = []
        for at, n in zip(self._places, self._counts, strict=True):
            low = np.floor(at).clip(0, n - 1).astype(np.intp)
            around.append((low, np.ceil(at).clip(0, n - 1).astype(np.intp)))
        worst = np.zeros((len(self._places[0]), len(self._places[1])), np.uint8)
        for i in around[0]:
            worst = np.maximum(worst, rows[i])
            for j in around[1]:
                worst = np.maximum(worst, corners[np.ix_(i, j)])
        for j in around[1]:
            worst = np.maximum(worst, cols[j].T)
        return np.where(worst == UNKNOWN, 0, worst).astype(np.uint8)


def _steps(count: int, segment: int) -> NDArray[np.float64]:
    """Where markers of a gridline with so many corners lie, in pitches."""
    return np.arange((count - 1) * segment + 1) / segment


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
        raise GeometryError(msg)
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
