"""The dense surface: depth and displacement between the markers, on a regular grid.

Nodes are regular in material coordinates: node (x, y) is the point of the pattern that lies at
(x, y) where the pattern is undeformed, whatever has become of it since.  That serves mechanics:
`displacement` is a field over the undeformed surface.  For morphology, the shape of what touches,
`height_map` makes a map of z over x and y in space of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured import GridShape, Status, Surface, SurfaceGrid
from cmp_tactile_processing.surface.dense_patches import UNKNOWN, fill_corners, lines_at, patches_at

Lines = tuple[NDArray[np.float64], NDArray[np.uint8]]

# A gridline goes on across so many pitches without a known marker: a lost corner's two segments.
LONGEST_GAP = 2.0
# Of the polynomials beyond the known markers: a surface at rest is smooth and known well, and
# what noise a displacement has must not grow.
REST_DEGREE, DISPLACEMENT_DEGREE = 2, 1
# A whole number of spacings is one in spite of rounding.
ROUNDING = 1e-6
MOST_NODES = 4_000_000

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
        self._reach = margin / pitch
        # In steps between the markers of a gridline, virtual ones included.
        self._steps = (
            _steps(grid.y, pitch, shape.rows, shape.points_per_segment),
            _steps(grid.x, pitch, shape.cols, shape.points_per_segment),
        )
        self._reference: NDArray[np.float64] | None = None
        self._nodes_at_rest = np.empty((grid.rows, grid.cols, 3))
        self._rows_at_rest = np.empty((*shape.row_lines, 3))
        self._cols_at_rest = np.empty((*shape.col_lines, 3))
        # What is compiled is compiled now, and not in the first frame.
        self._refer_to(np.full((*shape.corners, 3), np.nan))

    def interpolate(self, surface: Surface) -> DenseSurface:
        """The dense surface of a frame; GeometryError for another shape than was announced."""
        if surface.shape != self._shape:
            msg = f"surface: found {surface.shape}, expected {self._shape}"
            raise GeometryError(msg)
        self._refer_to(surface.reference)
        rows = _joined(
            (surface.displacement, surface.status),
            (surface.row_position - self._rows_at_rest, surface.row_status),
        )
        cols = _joined(
            (surface.displacement.swapaxes(0, 1), surface.status.T),
            (
                (surface.col_position - self._cols_at_rest).transpose(1, 0, 2, 3),
                surface.col_status.transpose(1, 0, 2),
            ),
        )
        corners = surface.displacement.copy(), surface.status.copy()
        segment = self._shape.points_per_segment + 1
        displacement, status = self._field(rows, cols, corners, segment, DISPLACEMENT_DEGREE)
        return DenseSurface(
            grid=self._grid,
            reference=self._nodes_at_rest,
            position=self._nodes_at_rest + displacement,
            displacement=displacement,
            status=status,
        )

    def _refer_to(self, reference: NDArray[np.float64]) -> None:
        """Nodes and virtual markers at rest, from the corners at rest."""
        known = self._reference
        if known is not None and np.array_equal(known, reference, equal_nan=True):
            return
        status = _known(reference)
        rows = reference.copy(), status.copy()
        cols = reference.swapaxes(0, 1).copy(), status.T.copy()
        corners = reference.copy(), status.copy()
        self._nodes_at_rest = self._field(rows, cols, corners, 1, REST_DEGREE)[0]
        self._rows_at_rest = _between(rows, self._shape.row_lines)
        along_cols = (self._shape.cols, self._shape.rows - 1, self._shape.points_per_segment)
        self._cols_at_rest = _between(cols, along_cols).transpose(1, 0, 2, 3)
        self._reference = reference.copy()

    def _field(
        self, rows: Lines, cols: Lines, corners: Lines, segment: int, degree: int
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Values and status at the nodes, of what is known along gridlines."""
        limits = segment, self._reach * segment, int(LONGEST_GAP * segment)
        finest = self._shape.points_per_segment + 1
        at_y, at_x = (steps / finest for steps in self._steps)
        if not corners[1].all():
            _bridge_corners(rows, cols, corners, limits)
        at_rows = _evaluated(rows, self._steps[1] / (finest // segment), limits, degree)
        at_cols = _evaluated(cols, self._steps[0] / (finest // segment), limits, degree)
        values = np.empty((self._grid.rows, self._grid.cols, 3))
        status = np.empty(values.shape[:2], np.uint8)
        patches_at(at_rows, at_cols, corners, (at_y, at_x, self._reach), values, status)
        return values, status


def _steps(
    axis: NDArray[np.float64], pitch: float, corners: int, between: int
) -> NDArray[np.float64]:
    """Places of nodes, in steps between markers; those on a marker, but for rounding, are on it."""
    steps = (axis / pitch + (corners - 1) / 2) * (between + 1)
    whole = np.rint(steps)
    return np.asarray(np.where(np.abs(steps - whole) < ROUNDING, whole, steps))


def _bridge_corners(
    rows: Lines, cols: Lines, corners: Lines, limits: tuple[int, float, int]
) -> None:
    """Corners that are lost between known markers, in place, also as points of both gridlines."""
    segment, _, longest = limits
    across = segment, 0.0, longest
    at_rows, at_cols = (
        _evaluated(lines, np.arange(0.0, lines[1].shape[1], segment), across, 0)
        for lines in (rows, cols)
    )
    fill_corners(at_rows, at_cols, *corners)
    rows[0][:, ::segment], rows[1][:, ::segment] = corners
    cols[0][:, ::segment], cols[1][:, ::segment] = corners[0].swapaxes(0, 1), corners[1].T


def _evaluated(
    lines: Lines, places: NDArray[np.float64], limits: tuple[int, float, int], degree: int
) -> Lines:
    values = np.empty((len(lines[0]), len(places), 3))
    rests_on = np.empty(values.shape[:2], np.uint8)
    lines_at(*lines, places, limits, degree, values, rests_on)
    return values, rests_on


def _joined(corners: Lines, between: Lines) -> Lines:
    """All points along each gridline, (lines, points, 3), and which of them are known."""
    lines, segments, n = between[1].shape
    values = np.empty((lines, segments * (n + 1) + 1, 3))
    known = np.empty(values.shape[:2], np.uint8)
    for whole, at_corner, inside in zip((values, known), corners, between, strict=True):
        whole[:, :: n + 1] = at_corner
        parts = whole[:, :-1].reshape(lines, segments, n + 1, *whole.shape[2:])
        parts[:, :, 1:] = inside
    known *= np.isfinite(values[..., 0]) & np.isfinite(values[..., 1])
    return values, known


def _between(lines: Lines, shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """Virtual markers (lines, segments, n, 3) of curves through corners alone."""
    count, segments, n = shape
    steps = np.arange(segments * (n + 1)) / (n + 1)
    points = _evaluated(lines, steps, (1, 0.0, int(LONGEST_GAP)), 0)[0]
    return points.reshape(count, segments, n + 1, 3)[:, :, 1:]


def _known(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """MEASURED where x and y are known."""
    seen = np.isfinite(points[..., :2]).all(axis=-1)
    return np.where(seen, Status.MEASURED, UNKNOWN).astype(np.uint8)


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
    origin, spacing = (grid.x[0], grid.y[0]), grid.spacing
    _draw(dense.position, dense.status, origin, spacing, height, status)
    height[status == DenseStatus.MISSING] = np.nan
    return HeightMap(grid, height, status)


@njit(cache=True, nogil=True)
def _draw(  # noqa: PLR0913, PLR0917 - nodes, raster, and what is drawn
    position: NDArray[np.float64],
    node_status: NDArray[np.uint8],
    origin: tuple[float, float],
    spacing: tuple[float, float],
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Each cell of nodes as two triangles, (x, y) in steps of the raster."""
    p = np.empty((4, 3))
    codes = np.empty(4, np.uint8)
    for i in range(position.shape[0] - 1):
        for j in range(position.shape[1] - 1):
            for k in range(4):
                a, b = i + k // 2, j + k % 2
                codes[k] = node_status[a, b]
                p[k, 0] = (position[a, b, 0] - origin[0]) / spacing[0]
                p[k, 1] = (position[a, b, 1] - origin[1]) / spacing[1]
                p[k, 2] = position[a, b, 2]
            for first in range(2):
                # Nodes 0, 1, 3 and 0, 3, 2 of the cell.
                second, third = (1, 3) if first == 0 else (3, 2)
                if codes[0] and codes[second] and codes[third]:
                    code = max(codes[0], codes[second], codes[third])
                    _draw_triangle(p[0], p[second], p[third], code, height, status)


@njit(cache=True, nogil=True)
def _draw_triangle(  # noqa: PLR0913, PLR0917 - three corners, and what is drawn
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    code: int,
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if twice_area == 0 or not np.isfinite(a[2] + b[2] + c[2]):
        return
    rows, cols = height.shape
    low_x = max(0, int(np.ceil(min(a[0], b[0], c[0]) - ON_BORDER)))
    high_x = min(cols - 1, int(np.floor(max(a[0], b[0], c[0]) + ON_BORDER)))
    low_y = max(0, int(np.ceil(min(a[1], b[1], c[1]) - ON_BORDER)))
    high_y = min(rows - 1, int(np.floor(max(a[1], b[1], c[1]) + ON_BORDER)))
    for y in range(low_y, high_y + 1):
        for x in range(low_x, high_x + 1):
            of_b = ((x - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (y - a[1])) / twice_area
            of_c = ((b[0] - a[0]) * (y - a[1]) - (x - a[0]) * (b[1] - a[1])) / twice_area
            if of_b < -ON_BORDER or of_c < -ON_BORDER or of_b + of_c > 1 + ON_BORDER:
                continue
            z = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
            if z > height[y, x]:
                height[y, x], status[y, x] = z, code
