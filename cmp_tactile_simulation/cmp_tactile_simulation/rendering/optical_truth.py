"""What is true of a rendered frame: where its corners and gridline points are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.mesh import BlockGeometry
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.measured import Grid, GridFault, GridShape, Status, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.renderer import BORDER, SurfaceMesh
from cmp_tactile_simulation.rendering.surface import (
    DeformedSurface,
    SplineSurface,
    first_meetings,
    surface_points,
)

# A marker is hidden where its ray first meets the surface further than this from it, m.
SAME_POINT_M = 1e-7
# Guesses this near to each other, in pixels, lead to the same meeting.
ALIKE_PIXELS = 2.0


class OpticalTruth:
    """What is true of the frames of one sensor.  Raises GeometryError for one without a block."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._pattern = sensor.pattern
        self._size = BlockGeometry.from_sensor(sensor).size[:2]
        self._numbers = _marker_numbers(sensor.pattern.shape)
        rest = DeformedSurface.rest(sensor.pattern).spline(self._size)
        self._meshes = {
            name: SurfaceMesh.from_view(view, rest) for name, view in build_views(sensor).items()
        }

    def grids(self, surface: DeformedSurface) -> dict[str, Grid]:
        """Exact gridlines of each view, px of the view, with its placement.

        Virtual markers divide a segment into equal parts of the undeformed pattern.  Points
        outside the view's part of the frame, and those that the surface itself hides, are missing.
        """
        spline = surface.spline(self._size)
        grids = {}
        for name, mesh in self._meshes.items():
            seen = _Sight(mesh, spline)
            corners, row_lines, col_lines = (
                seen.pixels(surface.material(i, j)) for i, j in self._numbers
            )
            reason = _reason(corners)
            grids[name] = Grid(
                shape=self._pattern.shape,
                corners=corners,
                corner_status=_status(corners),
                row_lines=row_lines,
                row_line_status=_status(row_lines),
                col_lines=col_lines,
                col_line_status=_status(col_lines),
                residual_px=0.0,
                reason=reason,
                placement=mesh.view.placement,
                fault=GridFault.PARTLY_HIDDEN if reason else GridFault.NONE,
                confidence=1.0,
            )
        return grids

    def surface(self, surface: DeformedSurface) -> Surface:
        """The markers in 3-D, gel frame, m; displacement is relative to the nominal surface."""
        shape, reference = self._pattern.shape, self._pattern.corners()
        corners, row_lines, col_lines = (surface.at(i, j) for i, j in self._numbers)
        return Surface.from_exact_points(shape, reference, corners, row_lines, col_lines)


def true_grids(sensor: SensorDescription, surface: DeformedSurface) -> dict[str, Grid]:
    """The grids of a single surface; OpticalTruth for many of one sensor."""
    return OpticalTruth(sensor).grids(surface)


def true_surface(sensor: SensorDescription, surface: DeformedSurface) -> Surface:
    """The markers of a single surface; OpticalTruth for many of one sensor."""
    return OpticalTruth(sensor).surface(surface)


def _marker_numbers(shape: GridShape) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Fractional rows and columns of corners, points on row lines, points on column lines."""
    rows, cols = np.arange(shape.rows), np.arange(shape.cols)
    part = np.arange(1, shape.points_per_segment + 1) / (shape.points_per_segment + 1)
    return [
        (rows[:, None] + np.zeros(shape.corners), cols + np.zeros(shape.corners)),
        (
            rows[:, None, None] + np.zeros(shape.row_lines),
            cols[:-1, None] + part + np.zeros(shape.row_lines),
        ),
        (
            rows[:-1, None, None] + part + np.zeros(shape.col_lines),
            cols[:, None] + np.zeros(shape.col_lines),
        ),
    ]


class _Sight:
    """What a view sees of a surface."""

    def __init__(self, mesh: SurfaceMesh, surface: SplineSurface) -> None:
        self._view: ViewGeometry = mesh.view
        self._surface = surface
        self._alike = ALIKE_PIXELS * mesh.pixel_m
        place = mesh.view.placement
        self._guesses = np.empty((place.height + 2 * BORDER, place.width + 2 * BORDER, 4))
        mesh.guesses(mesh.project(surface), (0, len(self._guesses)), self._guesses)

    def pixels(self, material: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the view of material points (..., 2) m; NaN where they are not seen.

        A point is seen where its ray meets the surface nowhere nearer: that is looked for from
        what the pixels around it show.
        """
        xy = material.reshape(-1, 2)
        q = self._view.project(surface_points(self._surface, np.ascontiguousarray(xy)))
        place = self._view.placement
        with np.errstate(invalid="ignore"):
            inside = (q > -0.5).all(axis=1) & (q < (place.width - 0.5, place.height - 0.5)).all(
                axis=1
            )
        found = np.full_like(q, np.nan)
        origins, directions = self._view.rays(q[inside])
        # The point itself first: most are seen.
        starts = np.concatenate([xy[inside][:, None], self._around(q[inside])], axis=1)
        first = first_meetings(self._surface, origins, directions, starts, self._alike)
        off = np.linalg.norm(first - xy[inside], axis=1)
        found[inside] = np.where((off < SAME_POINT_M)[:, None], q[inside], np.nan)
        return found.reshape(material.shape)

    def _around(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Material points (n, 9, 2) that the pixel of each point and those around it show."""
        col, row = np.rint(q).astype(np.intp).T + BORDER
        near = np.arange(-1, 2)
        rows = (row[:, None, None] + near[:, None]).clip(0, self._guesses.shape[0] - 1)
        cols = (col[:, None, None] + near).clip(0, self._guesses.shape[1] - 1)
        return np.asarray(self._guesses[rows, cols, :2].reshape(len(q), 9, 2))


def _status(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    seen = np.isfinite(points[..., 0])
    return np.where(seen, Status.MEASURED, Status.MISSING).astype(np.uint8)


def _reason(corners: NDArray[np.float64]) -> str:
    missing = int(np.isnan(corners[..., 0]).sum())
    return f"{missing} corners hidden or outside the view" if missing else ""
