"""The surface that a reference stands for."""

from __future__ import annotations

import numpy as np

from cmp_tactile_processing.measured.grid import GridShape, Status
from cmp_tactile_processing.measured.markers_3d import MarkerFault
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.surface.displacement import Reference

__all__ = ["surface_at_rest"]


def surface_at_rest(reference: Reference, shape: GridShape) -> Surface:
    """The surface whose markers all are where the reference has them; no virtual markers.

    Its covariance is that of the reference's positions.
    """
    position = reference.position
    known = np.isfinite(position[..., :2]).all(axis=-1)
    return Surface(
        shape=shape,
        reference=position,
        position=position,
        displacement=position - position,
        status=np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8),
        fault=np.where(known, MarkerFault.NONE, MarkerFault.NO_REFERENCE).astype(np.uint8),
        covariance=reference.covariance,
        ray_gap=np.full(shape.corners, np.nan),
        row_position=np.full((*shape.row_lines, 3), np.nan),
        row_status=np.zeros(shape.row_lines, np.uint8),
        row_std=np.full(shape.row_lines, np.nan),
        col_position=np.full((*shape.col_lines, 3), np.nan),
        col_status=np.zeros(shape.col_lines, np.uint8),
        col_std=np.full(shape.col_lines, np.nan),
        reference_id=reference.id,
        reference_stamp_ns=reference.stamp_ns,
    )
