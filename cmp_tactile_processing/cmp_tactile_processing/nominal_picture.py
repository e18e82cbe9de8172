"""A plain drawing of the pattern at rest, as one view would show it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.nominal_grid import NominalGrid

__all__ = ["draw_nominal"]

DARK, LIGHT = 50, 190
# Places are drawn to so many binary digits of a pixel.
SHIFT = 4


def draw_nominal(
    nominal: NominalGrid, shape: tuple[int, int], dark_first: bool
) -> NDArray[np.uint8]:
    """Picture (height, width) uint8 of the nominal grid on a light or dark margin, without shading.

    dark_first: whether the checker outside corner (0, 0) is dark; the margin is of the other kind.
    """
    ring = np.pad(nominal.corners, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
    ground, ink = (LIGHT, DARK) if dark_first else (DARK, LIGHT)
    picture = np.full(shape, ground, dtype=np.uint8)
    rows, cols = ring.shape[:2]
    for i in range(rows - 1):
        for j in range(i % 2, cols - 1, 2):
            outline = ring[[i, i, i + 1, i + 1], [j, j + 1, j + 1, j]]
            fixed = np.rint(outline * 2**SHIFT).astype(np.int32)
            cv2.fillConvexPoly(picture, fixed, ink, cv2.LINE_AA, SHIFT)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), dtype=np.uint8)
