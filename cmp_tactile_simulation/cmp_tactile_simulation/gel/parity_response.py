"""The response of a whole surface, put together from that of a mirror-symmetric quarter."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, mirrored_response
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid

__all__ = ["ParityResponse"]


class ParityResponse:
    """Displacement of nodes and markers of a block under forces on its nodes.

    nodes, markers: the grids, N and M points.
    of_nodes, of_markers: (4, 3 n, 3 n) and (4, 3 m, 3 n) m/N, per parity the response of the
    quarter grids to unit parts on the quarter's nodes; of_nodes is symmetric in each parity.
    """

    def __init__(
        self,
        nodes: SurfaceGrid,
        markers: SurfaceGrid,
        of_nodes: NDArray[np.float64],
        of_markers: NDArray[np.float64],
    ) -> None:
        self._of_nodes, self._of_markers = of_nodes, of_markers
        self._nodes, self._markers = nodes, markers
        self._image, self._sign = _images(_extensions(nodes))

    def compliance(self, active: NDArray[np.intp]) -> NDArray[np.float64]:
        """Displacement of the nodes `active` (k,) for unit forces on them, (3 k, 3 k) m/N."""
        rows = (3 * self._image[active][:, None] + np.arange(3)).ravel()
        signs = self._sign[:, active].reshape(len(PARITIES), -1)
        return np.asarray(_gather(self._of_nodes, rows, signs))

    def of_nodes(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the nodes (N, 3) m under forces (N, 3) N on them."""
        return self._apply(self._of_nodes, self._nodes, force)

    def of_markers(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of the markers (M, 3) m under forces (N, 3) N on the nodes."""
        return self._apply(self._of_markers, self._markers, force)

    def _apply(
        self, responses: NDArray[np.float64], target: SurfaceGrid, force: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        # Reading memory is what takes the time; threads only wait for one another on loaded cores.
        with one_blas_thread():
            moved = mirrored_response(responses, self._nodes, target, force.ravel())
        return moved.reshape(-1, 3)


def _extensions(grid: SurfaceGrid) -> list[sparse.csr_array]:
    return [parity.extension(grid.rows, grid.cols) for parity in PARITIES]


def _images(
    extensions: list[sparse.csr_array],
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number in the quarter of each point's image (N,), and the signs there (4, N, 3).

    A sign is 0 where a point is its own image and the component odd.
    """
    total = sum(abs(matrix) for matrix in extensions).tocsr()
    image = total.indices[total.indptr[:-1:3]] // 3
    sign = np.stack([np.asarray(matrix.sum(axis=1)).reshape(-1, 3) for matrix in extensions])
    return image.astype(np.intp), sign


@njit(cache=True, nogil=True)
def _gather(
    response: NDArray[np.float64], row: NDArray[np.intp], sign: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Entry (i, j): sum over parities of sign[p, i] sign[p, j] response[p, row[i], row[j]]."""
    count = len(row)
    gathered = np.zeros((count, count))
    for i in range(count):
        out = gathered[i]
        for parity in range(4):
            one, signs = response[parity, row[i]], sign[parity]
            for j in range(count):
                out[j] += signs[i] * signs[j] * one[row[j]]
    return gathered
