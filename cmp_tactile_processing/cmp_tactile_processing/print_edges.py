"""How far printed edges stray from the smooth curves that they should follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.print_lattice import SmoothLattice

__all__ = ["LineScatter", "line_places", "line_scatter", "raggedness"]

# Step along a gridline over which its direction is taken, checkers.
DIRECTION_STEP = 0.05


@dataclass(frozen=True)
class LineScatter:
    """Of the virtual markers (a, b, n) along one direction.

    across: px by which each lies beside its smooth curve, NaN where not measured; std: how much of
    that is noise, px; smooth (a, b, n, 2): its place on the curve, px.
    """

    across: NDArray[np.float64]
    std: NDArray[np.float64]
    smooth: NDArray[np.float64]

    def without(self, doubtful: NDArray[np.bool_]) -> LineScatter:
        """The same with doubtful markers (a, b, n) left out."""
        return LineScatter(np.where(doubtful, np.nan, self.across), self.std, self.smooth)


def line_places(
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

    The noise is taken to be none.
    """
    a, b, count = lines.shape[:3]
    smooth, normal = line_places(lattice, (a, b, count), along_rows)
    across = ((lines - smooth) * normal).sum(axis=-1)
    return LineScatter(across, np.zeros_like(across), smooth)


def raggedness(scatter: LineScatter) -> tuple[NDArray[np.float64], float, int]:
    """Rms straying per segment (a, b) with the noise's share removed, its total square, markers."""
    known = np.isfinite(scatter.across)
    square = np.where(known, scatter.across**2 - np.nan_to_num(scatter.std) ** 2, 0.0)
    count = known.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, square.sum(axis=-1) / count, np.nan)
    return np.sqrt(np.maximum(mean, 0)), float(square.sum()), int(count.sum())
