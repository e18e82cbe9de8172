"""The marker surface in 3-D, as the stages after triangulation see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import GridShape

__all__ = ["Surface"]


@dataclass(frozen=True)
class Surface:
    """Markers in 3-D, gel frame, m; position = reference + displacement; missing points NaN.

    reference, position, displacement (rows, cols, 3); status, fault (rows, cols): MarkerFault says
    why one is missing; covariance (rows, cols, 3, 3): of the displacement, m^2;
    ray_gap (rows, cols): length of the common normal of the two rays, m (NaN for one view);
    row_position (rows, cols-1, n, 3), col_position (rows-1, cols, n, 3): virtual markers, with
    row_status, col_status and row_std, col_std, m, as in Markers3D.
    reference_id: 0 for the nominal surface of the sensor description, then counting up.
    reference_stamp_ns: stamp of the last frame averaged into the reference, ns; 0 if nominal.
    """

    shape: GridShape
    reference: NDArray[np.float64]
    position: NDArray[np.float64]
    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    covariance: NDArray[np.float64]
    ray_gap: NDArray[np.float64]
    row_position: NDArray[np.float64]
    row_status: NDArray[np.uint8]
    row_std: NDArray[np.float64]
    col_position: NDArray[np.float64]
    col_status: NDArray[np.uint8]
    col_std: NDArray[np.float64]
    reference_id: int = 0
    reference_stamp_ns: int = 0
