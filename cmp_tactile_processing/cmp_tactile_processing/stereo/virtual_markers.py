"""Virtual markers in 3-D: gridlines as curves, not as points that both views would share.

Where along its gridline a tracker puts a virtual marker is a convention: point k of one view is
not exactly the material point that point k of the other one is.  What a view measures is where the
gridline runs, that is, the plane through its ray that the gridline lies in.

- Along the gridline a marker lies at its share of the material between two corners, on a curve
  through the corners around it: always interpolated.
- Across it, where the gridline is well inclined to the epipolar plane, both views' planes alone
  determine it: measured.
- Where it runs nearly along the epipolar direction both planes are nearly the same one: they
  give one coordinate, and the curve the other, nearly the depth: predicted.  How far that may
  be off follows from the corners' covariances, from how the corners' curve bends, and from how far
  the planes lie beside it, here and on the gridlines around.

Across a gridline a marker has two coordinates u, v (`virtual_marker_curves`), of which each view
gives one combination.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import plain
from cmp_tactile_processing.geometry.refraction import RayBundle
from cmp_tactile_processing.measured import Grid, GridShape
from cmp_tactile_processing.sensor.parameters import TriangulationParameters
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_processing.stereo.line_planes import Limits, LinePlanes, View, place_lines
from cmp_tactile_processing.stereo.virtual_marker_curves import (
    Layout,
    LineCurves,
    Stencils,
    choose_stencils,
    fill_stencils,
    set_curves,
)


class SeenLines(NamedTuple):
    """Virtual markers as one view sees them, in the order of Grid.row_lines or Grid.col_lines.

    status (...,); std (...,) across the gridline, px, None where it is not known; rays: of the
    tracked points, N = number of virtual markers.
    """

    status: NDArray[np.uint8]
    std: NDArray[np.float64] | None
    rays: RayBundle

    @classmethod
    def rows(cls, grid: Grid, rays: RayBundle) -> SeenLines:
        """The row lines of a grid; rays: of `grid.row_lines`."""
        return cls(grid.row_line_status, grid.row_line_std, rays)

    @classmethod
    def cols(cls, grid: Grid, rays: RayBundle) -> SeenLines:
        """The column lines of a grid; rays: of `grid.col_lines`."""
        return cls(grid.col_line_status, grid.col_line_std, rays)


class LineNodes(NamedTuple):
    """The corners that the gridlines run through, gel frame.

    position (rows, cols, 3) m, of a monocular sensor on the known surface, z included; status
    (rows, cols); covariance (rows, cols, 3, 3) m^2, NaN where it is not known.
    """

    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    covariance: NDArray[np.float64]


class Lines3D(NamedTuple):
    """Virtual markers in 3-D: position (..., n, 3) m, status (..., n), std (..., n) m.

    std: largest standard deviation across the gridline.
    """

    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    std: NDArray[np.float64]


class LineTriangulator:
    """Places the virtual markers of frame after frame; its buffers are kept.

    surface: that a monocular sensor's markers lie on; None for two views.
    """

    def __init__(
        self,
        shape: GridShape,
        parameters: TriangulationParameters,
        surface: PatternSurface | None = None,
    ) -> None:
        rows, cols, n = shape.rows, shape.cols, shape.points_per_segment
        limits = parameters.max_ray_gap, parameters.corner_noise
        curvatures = _curvatures(surface)
        self._views = 2 if surface is None else 1
        self._rows = _Direction(Layout(rows, cols, cols - 1, 1, cols, 1, n), limits, curvatures)
        self._cols = _Direction(Layout(cols, rows, 1, cols, 1, cols, n), limits, curvatures)

    def rows(self, views: tuple[SeenLines, ...], corners: LineNodes) -> Lines3D:
        """Virtual markers (rows, cols-1, n) along the rows.

        views: left and right, or the only one; all of one frame.  A marker is measured where both
        views measured its gridline, at 30 degrees or more to the epipolar plane (a monocular
        sensor: where its view measured it), predicted where a coordinate across the gridline is
        interpolated between the corners or by a tracker, and missing where no view shows it or
        where it does not lie between two known corners that are at most two segments apart.
        """
        return self._rows.place(views[: self._views], corners)

    def cols(self, views: tuple[SeenLines, ...], corners: LineNodes) -> Lines3D:
        """Virtual markers (rows-1, cols, n) along the columns; as `rows`."""
        return self._cols.place(views[: self._views], corners)


class _Direction:
    """Buffers of all gridlines of one direction."""

    def __init__(self, layout: Layout, limits: Limits, surface: NDArray[np.float64]) -> None:
        self._layout, self._limits, self._surface = layout, limits, surface
        segments, n = layout.corners - 1, layout.markers
        self._curves = LineCurves.from_layout(layout)
        self._planes = LinePlanes.from_markers(layout.lines * segments * n)
        # The entries of complete gridlines first, then those of each gridline that lacks corners.
        self._stencils = Stencils.from_count((1 + layout.lines) * segments, n)
        self._entries = np.empty((layout.lines, segments), np.int64)
        fill_stencils(np.ones(layout.corners, np.bool_), 0, self._stencils)
        self._no_std = np.full(layout.lines * segments * n, np.nan)

    def place(self, views: tuple[SeenLines, ...], corners: LineNodes) -> Lines3D:
        shape = views[0].status.shape
        found = Lines3D(np.empty((*shape, 3)), np.empty(shape, np.uint8), np.empty(shape))
        if found.status.size == 0:
            return found
        position = plain(corners.position, np.float64).reshape(-1, 3)
        covariance = plain(corners.covariance, np.float64).reshape(-1, 3, 3)
        corner = (position, covariance)
        status = plain(corners.status, np.uint8).reshape(-1)
        choose_stencils(self._layout, position, status, self._entries, self._stencils)
        set_curves(self._layout, corner, self._entries, self._stencils, self._curves)
        place_lines(
            self._layout,
            (self._flat(views[0]), self._flat(views[-1]), self._limits, self._surface),
            self._curves,
            self._planes,
            (found.position.reshape(-1, 3), found.status.reshape(-1), found.std.reshape(-1)),
        )
        return found

    def _flat(self, view: SeenLines) -> View:
        rays = view.rays
        return (
            plain(view.status, np.uint8).reshape(-1),
            self._no_std if view.std is None else plain(view.std, np.float64).reshape(-1),
            rays.origin,
            rays.direction,
            rays.origin_by_pixel,
            rays.direction_by_pixel,
        )


def _curvatures(surface: PatternSurface | None) -> NDArray[np.float64]:
    """(3,) factors c of a surface's normal (c_x x, c_y y, 1 + c_z z) at a point; NaN for none."""
    if surface is None:
        return np.full(3, np.nan)
    if surface.type == "plane":
        return np.zeros(3)
    bent = [surface.axis != "x", surface.axis != "y", True]
    if surface.type == "sphere_cap":
        bent = [True] * 3
    return np.array(bent, np.float64) / surface.radius
