"""Places, statuses and deviations of virtual markers, from the fits of their segments."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    LANES,
    MARKER_BIAS_PX,
    Array,
    Fits,
    Index,
    Single,
    true_std,
)

# A marker farther than this from every measured column along the gridline is predicted, px.
NEAR_PX = 2.0
MISSING, MEASURED, PREDICTED = (int(status) for status in Status)


class Markers(NamedTuple):
    """position (a, b, n, 2) px, status (a, b, n), std (a, b, n): across the gridline, px."""

    position: Array
    status: NDArray[np.uint8]
    std: Array

    @classmethod
    def from_segment(cls, a: int, b: int, n: int) -> Markers:
        """Buffers for n markers on each of a x b segments."""
        status = np.empty((a, b, n), dtype=np.uint8)
        return cls(np.empty((a, b, n, 2)), status, np.empty((a, b, n)))


@kernel_part(forceinline=True)
def _is_near(columns: Single, count: int, s: int, t: float, near: float) -> bool:
    seen = column = 0
    block, lane = s // LANES, s % LANES
    while seen < count:
        if columns[block, 2, column, lane] > 0:
            seen += 1
            if abs(columns[block, 0, column, lane] - t) < near:
                return True
        column += 1
    return False


@kernel
def place_markers(
    curve: Array,
    counts: Index,
    columns: Single,
    fits: Fits,
    markers: Markers,
) -> None:
    """Fill the markers from the cubics (a, b, 4, 2), `measure`'s columns and `Fits`."""
    n = markers.std.shape[2]
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = c[1, 0] + c[2, 0] + c[3, 0]
            y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                markers.position[i, j] = math.nan
                markers.std[i, j] = math.nan
                markers.status[i, j] = MISSING
                continue
            s = i * curve.shape[1] + j
            axis = 1 if abs(y) > abs(x) else 0
            tilt = math.hypot(x, y) / max(abs(x), abs(y), 1e-9)
            near = NEAR_PX / max(abs(x), abs(y), 1e-9)
            for marker in range(n):
                t = (marker + 1) / (n + 1)
                for k in range(2):
                    value = ((c[3, k] * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
                    markers.position[i, j, marker, k] = value
                markers.position[i, j, marker, 1 - axis] += fits.mean[marker + 1, s]
                spread = fits.spread[marker + 1, s] / tilt**2
                markers.std[i, j, marker] = true_std(spread, MARKER_BIAS_PX)
                is_measured = _is_near(columns, counts[s], s, t, near)
                markers.status[i, j, marker] = MEASURED if is_measured else PREDICTED
