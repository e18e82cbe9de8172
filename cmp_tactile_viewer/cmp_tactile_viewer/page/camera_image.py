"""The camera image with what was found in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.drawing import draw_grid
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid
from cmp_tactile_viewer.snapshot import Snapshot

VIEWS = ("both views", "left view", "right view", "camera")
# Beside the scene there is no place for more.
LARGEST_PX = 640
BLACK = 24


def picture(snapshot: Snapshot, views: str, gridlines: bool) -> NDArray[np.uint8] | None:
    """RGB (H, W, 3) at most LARGEST_PX wide; None where nothing of it is known.

    views: one of VIEWS.  A grid without its image is drawn on black.
    """
    if views == VIEWS[3] or (snapshot.left is None and snapshot.right is None):
        return None if snapshot.frame is None else _rgb(_reduced(snapshot.frame)[0])
    shown = list(_shown(snapshot, views))
    if not shown:
        return None
    each_px = LARGEST_PX // len(shown)
    drawn = [_view(snapshot.frame, grid, gridlines, each_px) for grid in shown]
    height = max(len(image) for image in drawn)
    padded = [
        cv2.copyMakeBorder(image, 0, height - len(image), 0, 0, cv2.BORDER_CONSTANT)
        for image in drawn
    ]
    return _rgb(np.hstack(padded))


def _shown(snapshot: Snapshot, views: str) -> Iterator[Grid]:
    for name, grid in (("left", snapshot.left), ("right", snapshot.right)):
        if grid is not None and grid.placement is not None and views in (VIEWS[0], f"{name} view"):
            yield grid


def _view(
    frame: NDArray[np.uint8] | None, grid: Grid, gridlines: bool, width_px: int
) -> NDArray[np.uint8]:
    placement = grid.placement
    assert placement is not None  # noqa: S101  `_shown` leaves out those without
    if frame is None:
        view = np.full((placement.height, placement.width), BLACK, np.uint8)
    else:
        view = split_frame(frame, placement)
    small, scale = _reduced(view, width_px)
    if gridlines:
        return draw_grid(small, _scaled(grid, scale))
    return small if small.ndim == 3 else _bgr(small)


def _reduced(
    image: NDArray[np.uint8], width_px: int = LARGEST_PX
) -> tuple[NDArray[np.uint8], float]:
    """The image in at most that width, and by which factor."""
    scale = min(1.0, width_px / image.shape[1])
    if scale == 1.0:
        return image, scale
    size = width_px, max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False), scale


def _scaled(grid: Grid, scale: float) -> Grid:
    """The grid in a reduced image; a pixel's centre has whole coordinates."""

    def moved(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return (points + 0.5) * scale - 0.5

    return replace(
        grid,
        corners=moved(grid.corners),
        row_lines=moved(grid.row_lines),
        col_lines=moved(grid.col_lines),
    )


def _bgr(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)


def _rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(image, code).astype(np.uint8, copy=False)
