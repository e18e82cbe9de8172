"""The markers in 3-D, as triangulation hands them to what comes after it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import GridShape

__all__ = ["MarkerFault", "Markers3D", "no_virtual_markers"]


class MarkerFault(IntEnum):
    """Why a marker has no position, or in a Surface no displacement."""

    NONE = 0
    NOT_SEEN = 1
    NOT_SEEN_LEFT = 2
    NOT_SEEN_RIGHT = 3
    NO_RAY = 4
    PARALLEL_RAYS = 5
    BEHIND_CAMERA = 6
    RAY_GAP = 7
    NO_REFERENCE = 8


@dataclass(frozen=True)
class Markers3D:
    """Markers in 3-D, gel frame, m; NaN where missing.

    position (rows, cols, 3), status and fault (rows, cols); covariance (rows, cols, 3, 3): of the
    position, m^2; ray_gap (rows, cols): length of the common normal, m, NaN for a monocular sensor.
    row_position (rows, cols-1, n, 3) and col_position (rows-1, cols, n, 3): virtual markers, each
    at its share of the material between its corners; row_status, col_status: measured where both
    views show where the gridline runs, predicted where that is interpolated between the corners;
    row_std, col_std: largest standard deviation across the gridline, m.
    """

    shape: GridShape
    position: NDArray[np.float64]
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


def no_virtual_markers(shape: GridShape) -> dict[str, NDArray[Any]]:
    """The fields of Markers3D for virtual markers where none is known."""
    return {
        "row_position": np.full((*shape.row_lines, 3), np.nan),
        "row_status": np.zeros(shape.row_lines, np.uint8),
        "row_std": np.full(shape.row_lines, np.nan),
        "col_position": np.full((*shape.col_lines, 3), np.nan),
        "col_status": np.zeros(shape.col_lines, np.uint8),
        "col_std": np.full(shape.col_lines, np.nan),
    }
