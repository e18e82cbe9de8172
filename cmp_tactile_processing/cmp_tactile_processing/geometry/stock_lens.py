"""A lens of the stock models that does as flat refracting layers and a lens do together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.lens import Lens

__all__ = ["fit_stock_lens"]


def fit_stock_lens(
    start: Lens,
    R_rect_raw: NDArray[np.float64],
    v_rect: NDArray[np.float64],
    q_raw: NDArray[np.float64],
) -> tuple[Lens, NDArray[np.float64]]:
    """Lens and rotation (3, 3) that take directions to pixels as a view with layers does.

    start, R_rect_raw: where to begin; the lens model stays.  v_rect (N, 3): directions of
    rectified pixels; q_raw (N, 2): the pixels of the view that they come from.  Least squares in
    px.
    """

    def unpacked(x: NDArray[np.float64]) -> tuple[Lens, NDArray[np.float64]]:
        fx, fy, cx, cy = start.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] * (1 + x[:4])
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        turn = Rotation.from_rotvec(x[4:7]).as_matrix()
        return Lens(start.model, matrix, start.distortion + x[7:]), turn @ R_rect_raw

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        lens, rotation = unpacked(x)
        off = lens.project(v_rect @ rotation) - q_raw
        # Outside the field of a lens that is tried: farther off than any that is in it.
        return np.where(np.isfinite(off), off, np.ptp(q_raw)).ravel()

    count = 7 + len(start.distortion)
    return unpacked(least_squares(residuals, np.zeros(count), method="lm", max_nfev=2000).x)
