"""A plain drawing of the pattern at rest, as one view would show it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.nominal_grid import NominalGrid

__all__ = ["draw_nominal", "spoilt_pictures"]

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


def spoilt_pictures(picture: NDArray[np.uint8], nominal: NominalGrid) -> list[NDArray[np.uint8]]:
    """The picture with spots and salt, with parts hidden, with a board over it, and mirrored."""
    rows, cols = nominal.corners.shape[:2]
    across, down = nominal.corners[rows // 2, cols // 2].astype(int)
    spotted = picture.copy()
    x, y = np.rint(nominal.corners[1, 1]).astype(int)
    spotted[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = LIGHT
    spotted[::7, ::7] = 0
    covered, components, board = picture.copy(), picture.copy(), picture.copy()
    covered[:, across:] = (DARK + LIGHT) // 2
    width = max(int(2 * nominal.side_px), 1)
    components[max(down - width, 0) : down + width] = (DARK + LIGHT) // 2
    board[:, across:] = np.roll(picture, int(nominal.side_px) // 2, axis=0)[:, across:]
    return [spotted, covered, components, board, picture[::-1], picture[:, ::-1]]
