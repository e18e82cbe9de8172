"""How far printed edges stray from the smooth curves that they should follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.print_inspection.lattice import SmoothLattice

__all__ = ["LineScatter", "line_scatter", "overall_raggedness"]

# Step along a gridline over which its direction is taken, checkers.
DIRECTION_STEP = 0.05


@dataclass(frozen=True)
class LineScatter:
    """Of the virtual markers (a, b, n) along one direction.

    across: px by which each lies beside its smooth curve, NaN where not measured; std: how much of
    that is noise, px; smooth (a, b, n, 2): its place on the curve, px; doubtful: markers that say
    nothing about the edge.
    """

    across: NDArray[np.float64]
    std: NDArray[np.float64]
    smooth: NDArray[np.float64]
    doubtful: NDArray[np.bool_]

    @property
    def telling(self) -> NDArray[np.bool_]:
        """Markers (a, b, n) that tell how the edge strays."""
        return np.isfinite(self.across) & ~self.doubtful

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of telling markers in each segment (a, b)."""
        return np.asarray(self.telling.sum(axis=-1), dtype=np.int64)

    @property
    def raggedness(self) -> NDArray[np.float64]:
        """Rms straying in each segment (a, b) without the noise's share, px; NaN where unknown."""
        total, count = self.square().sum(axis=-1), self.count
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(np.maximum(np.where(count > 0, total / count, np.nan), 0))

    def square(self, with_noise: bool = False) -> NDArray[np.float64]:
        """Square of each telling marker's straying (a, b, n), px^2; 0 for the others."""
        noise = 0.0 if with_noise else np.nan_to_num(self.std) ** 2
        return np.where(self.telling, self.across**2 - noise, 0.0)


def overall_raggedness(scatters: Sequence[LineScatter], with_noise: bool = False) -> float:
    """Rms straying over all telling markers, px; NaN without any."""
    count = sum(int(scatter.count.sum()) for scatter in scatters)
    total = sum(float(scatter.square(with_noise).sum()) for scatter in scatters)
    return float(np.sqrt(max(total / count, 0.0))) if count else float("nan")


def _line_places(
    lattice: SmoothLattice, lines: tuple[int, int, int], along_rows: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (a, b, n, 2) px on the smooth curves of the virtual markers and the unit normals.

    lines: shape (a, b, n) of an array of markers, as GridShape tells it.
    """
    share = (np.arange(lines[2]) + 1.0) / (lines[2] + 1)
    first, second = (np.arange(count, dtype=np.float64) for count in lines[:2])
    i, j = (first, _between(second, share)) if along_rows else (_between(first, share), second)
    step = (0.0, DIRECTION_STEP) if along_rows else (DIRECTION_STEP, 0.0)
    place = lattice.at(i, j)
    along = lattice.at(i + step[0], j + step[1]) - lattice.at(i - step[0], j - step[1])
    length = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / length
    if along_rows:
        return place.reshape(*lines, 2), normal.reshape(*lines, 2)
    split = lines[0], lines[2], lines[1], 2
    return (
        np.ascontiguousarray(place.reshape(split).swapaxes(1, 2)),
        np.ascontiguousarray(normal.reshape(split).swapaxes(1, 2)),
    )


def _between(start: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((start[:, None] + share).ravel())


def line_scatter(
    lattice: SmoothLattice, lines: NDArray[np.float64], along_rows: bool
) -> LineScatter:
    """Scatter of virtual markers lines (a, b, n, 2) px, NaN where not measured.

    No noise is taken off, and no marker is taken for doubtful.
    """
    a, b, count = lines.shape[:3]
    smooth, normal = _line_places(lattice, (a, b, count), along_rows)
    across = ((lines - smooth) * normal).sum(axis=-1)
    return LineScatter(across, np.zeros_like(across), smooth, np.zeros(across.shape, bool))
