"""The markers in 3-D, as triangulation hands them to what comes after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.grid import GridShape

__all__ = ["Markers3D"]


@dataclass(frozen=True)
class Markers3D:
    """Markers in 3-D, gel frame, m; NaN where missing.

    position (rows, cols, 3), status (rows, cols); ray_gap (rows, cols): length of the common
    normal, m, NaN for a monocular sensor; row_position (rows, cols-1, n, 3) and col_position
    (rows-1, cols, n, 3): virtual markers.
    """

    shape: GridShape
    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    ray_gap: NDArray[np.float64]
    row_position: NDArray[np.float64]
    col_position: NDArray[np.float64]
