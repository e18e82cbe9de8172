"""The marker surface in 3-D, as the stages after triangulation see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import GridShape, Status
from cmp_tactile_processing.measured.markers_3d import Markers3D

__all__ = ["Surface"]


@dataclass(frozen=True)
class Surface(Markers3D):
    """Markers in 3-D with their displacement; position = reference + displacement.

    What Markers3D has, but for status, fault and covariance, which are of the displacement.
    reference, displacement (rows, cols, 3): gel frame, m; NaN where missing.
    reference_id: 0 for the nominal surface of the sensor description, then counting up.
    reference_stamp_ns: stamp of the last frame averaged into the reference, ns; 0 if nominal.
    """

    reference: NDArray[np.float64]
    displacement: NDArray[np.float64]
    reference_id: int = 0
    reference_stamp_ns: int = 0

    @classmethod
    def from_exact_points(
        cls,
        shape: GridShape,
        reference: NDArray[np.float64],
        corners: NDArray[np.float64],
        row_lines: NDArray[np.float64],
        col_lines: NDArray[np.float64],
    ) -> Surface:
        """A surface all points of which are known without error, gel frame, m."""
        return cls(
            shape=shape,
            reference=reference,
            position=corners,
            displacement=corners - reference,
            status=np.full(shape.corners, Status.MEASURED, np.uint8),
            fault=np.zeros(shape.corners, np.uint8),
            covariance=np.zeros((*shape.corners, 3, 3)),
            ray_gap=np.zeros(shape.corners),
            row_position=row_lines,
            row_status=np.full(shape.row_lines, Status.MEASURED, np.uint8),
            row_std=np.zeros(shape.row_lines),
            col_position=col_lines,
            col_status=np.full(shape.col_lines, Status.MEASURED, np.uint8),
            col_std=np.zeros(shape.col_lines),
        )
