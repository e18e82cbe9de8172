"""How far markers in 3-D, projected back, are from where the views show them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.measured.markers_3d import Markers3D

__all__ = ["reprojection_errors", "reprojection_rms"]


def reprojection_errors(markers: Markers3D, grid: Grid, view: ViewGeometry) -> NDArray[np.float64]:
    """(N, 2) px, seen minus projected, of the measured markers; none where depth is not known."""
    used = (markers.status == Status.MEASURED) & np.isfinite(markers.position).all(axis=-1)
    errors = grid.corners[used] - view.project(markers.position[used])
    return np.asarray(errors[np.isfinite(errors).all(axis=-1)])


def reprojection_rms(
    markers: Markers3D, grids: Mapping[str, Grid], views: Mapping[str, ViewGeometry]
) -> float:
    """Root mean square over both views and their x and y, px; NaN where depth is not known."""
    errors = [reprojection_errors(markers, grid, views[name]) for name, grid in grids.items()]
    every = np.concatenate(errors)
    return float(np.sqrt(np.mean(every**2))) if every.size else math.nan
