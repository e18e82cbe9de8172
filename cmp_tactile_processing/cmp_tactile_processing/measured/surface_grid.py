"""A regular grid of points over the block's top."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["SurfaceGrid", "interpolation_matrix"]


@dataclass(frozen=True)
class SurfaceGrid:
    """A regular grid centred on the gel frame's z axis; point (i, j) is number i * cols + j.

    extent: distance between the outermost points along x and y, m.
    """

    rows: int
    cols: int
    extent: tuple[float, float]

    @property
    def x(self) -> NDArray[np.float64]:
        """The columns' x, (cols,) m."""
        return np.linspace(-self.extent[0] / 2, self.extent[0] / 2, self.cols)

    @property
    def y(self) -> NDArray[np.float64]:
        """The rows' y, (rows,) m."""
        return np.linspace(-self.extent[1] / 2, self.extent[1] / 2, self.rows)

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance between neighbours along x and y, m."""
        return self.extent[0] / (self.cols - 1), self.extent[1] / (self.rows - 1)

    @property
    def points(self) -> NDArray[np.float64]:
        """All points in order, (rows * cols, 2) m."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return np.stack([x.ravel(), y.ravel()], axis=-1)


def interpolation_matrix(source: SurfaceGrid, target: SurfaceGrid) -> sparse.csr_array:
    """Bilinear interpolation from the points of one grid to those of another, (target, source).

    Points outside the source grid take the value at its edge.
    """
    rows, cols = _line(source.y, target.y), _line(source.x, target.x)
    matrix = sparse.csr_array(sparse.kron(rows, cols))
    matrix.eliminate_zeros()
    return matrix


def _line(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear interpolation along one axis, (target, source)."""
    return np.stack([np.interp(target, source, row) for row in np.eye(len(source))], axis=1)
