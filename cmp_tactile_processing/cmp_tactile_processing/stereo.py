"""The triangulation stage: markers in 3-D from two views, or from one and the known surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.grid import Grid, Status
from cmp_tactile_processing.markers_3d import MarkerFault, Markers3D
from cmp_tactile_processing.optics import ViewGeometry, build_views
from cmp_tactile_processing.pattern import PatternSurface
from cmp_tactile_processing.sensor_description import SensorDescription

__all__ = ["StereoRig", "common_normal", "surface_intersection"]

# Rays that meet at a smaller angle than this (its sine squared) have no usable common normal.
PARALLEL_SINE2 = 1e-6


class StereoRig:
    """The two views of a sensor, or the one of a monocular sensor with its known surface."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor = sensor
        self._views = build_views(sensor)

    @property
    def views(self) -> dict[str, ViewGeometry]:
        """Geometry of the views by name."""
        return self._views

    @property
    def baseline(self) -> float:
        """Distance of the two camera centres in m; NaN for a monocular sensor."""
        if len(self._views) < 2:
            return float("nan")
        left, right = self._views["left"], self._views["right"]
        return float(np.linalg.norm(right.centre - left.centre))

    def triangulate(self, left: Grid | None, right: Grid | None) -> Markers3D:
        """Markers in 3-D from the grids of both views in one frame.

        A marker is measured where both views measured it, predicted where one of them predicted
        it.  A monocular sensor takes its one grid (the other is None) and gives the point of the
        known surface on the marker's ray, with z NaN.  Virtual markers k of both views are taken
        for the same material point.  Raises GeometryError for a grid of another shape or a
        missing one.
        """
        grids = {"left": left, "right": right}
        seen = [self._checked(name, grids[name]) for name in self._views]
        position, gap = self._points([grid.corners for grid in seen])
        codes = np.stack([grid.corner_status for grid in seen])
        status = np.where((codes == Status.MISSING).any(axis=0), Status.MISSING, codes.max(axis=0))
        status[~np.isfinite(position[..., :2]).all(axis=-1)] = Status.MISSING
        position[status == Status.MISSING] = np.nan
        rows = self._points([grid.row_lines for grid in seen])[0]
        cols = self._points([grid.col_lines for grid in seen])[0]
        return Markers3D(
            shape=self._sensor.pattern.shape,
            position=position,
            status=status.astype(np.uint8),
            fault=np.where(status == Status.MISSING, MarkerFault.NOT_SEEN, 0).astype(np.uint8),
            covariance=np.full((*status.shape, 3, 3), np.nan),
            ray_gap=gap,
            row_position=rows,
            row_status=np.isfinite(rows[..., 0]).astype(np.uint8),
            row_std=np.full(rows.shape[:-1], np.nan),
            col_position=cols,
            col_status=np.isfinite(cols[..., 0]).astype(np.uint8),
            col_std=np.full(cols.shape[:-1], np.nan),
        )

    def _checked(self, name: str, grid: Grid | None) -> Grid:
        shape = self._sensor.pattern.shape
        if grid is None:
            msg = f"{name} grid: found none, expected one of {shape.rows} x {shape.cols} corners"
            raise GeometryError(msg)
        if grid.shape != shape:
            msg = f"{name} grid: found {grid.shape}, expected {shape}"
            raise GeometryError(msg)
        return grid

    def _points(
        self, pixels: list[NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rays = [view.rays(q) for view, q in zip(self._views.values(), pixels, strict=True)]
        if len(rays) == 2:
            (o_left, v_left), (o_right, v_right) = rays
            return common_normal(o_left, v_left, o_right, v_right)
        position = surface_intersection(*rays[0], self._sensor.pattern.surface)
        position[..., 2] = np.nan
        return position, np.full(position.shape[:-1], np.nan)


def common_normal(
    o_left: NDArray[np.float64],
    v_left: NDArray[np.float64],
    o_right: NDArray[np.float64],
    v_right: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Midpoint and length of the common normal of pairs of rays (paper, IV.A, eq. 1-3).

    o_* (..., 3): ray origins, m.  v_* (..., 3): unit directions.  Returns points (..., 3) and
    lengths (...), m; NaN where the rays are parallel, meet behind an origin, or are NaN.
    """
    between = o_right - o_left
    cosine = (v_left * v_right).sum(axis=-1)
    along_left = (between * v_left).sum(axis=-1)
    along_right = (between * v_right).sum(axis=-1)
    sine2 = 1 - cosine**2
    with np.errstate(invalid="ignore", divide="ignore"):
        t_left = (along_left - cosine * along_right) / sine2
        t_right = (cosine * along_left - along_right) / sine2
        bad = ~((sine2 > PARALLEL_SINE2) & (t_left > 0) & (t_right > 0))
    p_left = o_left + t_left[..., None] * v_left
    p_right = o_right + t_right[..., None] * v_right
    midpoint = (p_left + p_right) / 2
    gap = np.linalg.norm(p_right - p_left, axis=-1)
    midpoint[bad], gap[bad] = np.nan, np.nan
    return midpoint, gap


def surface_intersection(
    origins: NDArray[np.float64], directions: NDArray[np.float64], surface: PatternSurface
) -> NDArray[np.float64]:
    """Point of the undeformed marker surface on each ray from below, (..., 3) m, gel frame.

    NaN where a ray misses the surface or is NaN.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        if surface.type == "plane":
            t = -origins[..., 2] / directions[..., 2]
        else:
            # The circle or sphere about (0, 0, -R), left by a ray through its upper half.
            curved = (
                [0, 1, 2] if surface.type == "sphere_cap" else [{"x": 1, "y": 0}[surface.axis], 2]
            )
            o, d = (origins + [0.0, 0.0, surface.radius])[..., curved], directions[..., curved]
            a, b = (d * d).sum(axis=-1), (o * d).sum(axis=-1)
            c = (o * o).sum(axis=-1) - surface.radius**2
            t = (-b + np.sqrt(b * b - a * c)) / a
        points = origins + t[..., None] * directions
        points[~((t > 0) & (points[..., 2] >= -surface.radius))] = np.nan
    return np.asarray(points)
